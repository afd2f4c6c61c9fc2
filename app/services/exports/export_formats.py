"""Tables as files: every column is defined once, and files, dictionary and documentation follow from that.

What all files have in common: UTF-8, times in UTC (ISO 8601), unknown is empty (null), and five columns at the end that
say where the row comes from. Nothing in a CSV file is a formula to a spreadsheet (csv_cells).
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session

from app.db import Base, now
from app.domain.studies import Deviation, Study
from app.services.exports.csv_cells import csv_line, json_text, moment
from app.services.exports.paging import EVERYTHING, Key, KeyedRows, Window

NOT_LOCKED = "not locked"


class ColumnKind(StrEnum):
    """Type of a column."""

    TEXT = "text"
    INTEGER = "integer"
    NUMBER = "number"
    BOOLEAN = "boolean"
    TIME = "time"
    JSON = "json"


@dataclass(frozen=True)
class Column:
    """One column: what it is called, what is in it, and what that means."""

    name: str
    kind: ColumnKind
    meaning: str
    unit: str = ""
    allowed: str = ""


@dataclass(frozen=True)
class Table:
    """One table of an export; ``keyed_rows`` yields values in the order of the columns, each with its key."""

    name: str
    meaning: str
    columns: Sequence[Column]
    keyed_rows: Callable[[Session, Study, Window], KeyedRows]
    made_of: Sequence[type[Base]]
    """The database's tables whose rows, old or new, decide which rows there are and which of them count."""
    grows_by: type[Base] | None = None
    """The database's table of which each row here is one, taken away only with the person; its id ends the key."""

    def rows(self, session: Session, study: Study) -> Iterator[Sequence[Any]]:
        """Everything, in the order of the columns."""
        return (values for _, values in self.keyed_rows(session, study, EVERYTHING))

    @property
    def all_columns(self) -> Sequence[Column]:
        """The table's own columns and those that every table ends with."""
        return (*self.columns, *PROVENANCE)


@dataclass(frozen=True)
class RowProvenance:
    """Where rows come from; stands in every row, so that a file that gets lost can still be told apart."""

    study: str
    lock_hash: str
    deviations: str
    software_version: str
    exported_at: datetime

    @property
    def values(self) -> Sequence[Any]:
        """In the order of PROVENANCE."""
        return (self.study, self.lock_hash, self.deviations, self.software_version, self.exported_at)


PROVENANCE = (
    Column("study", ColumnKind.TEXT, "Short name of the study, as in its address."),
    Column(
        "lock_hash",
        ColumnKind.TEXT,
        "SHA-256 of the locked settings, plan and planned tests.",
        allowed=f"64 hexadecimal digits, or “{NOT_LOCKED}”",
    ),
    Column(
        "deviations",
        ColumnKind.TEXT,
        "Changes after locking, each with its time and reason; the table deviations has what was changed.",
        allowed="“none”, or time: reason, joined by “ | ”",
    ),
    Column("software_version", ColumnKind.TEXT, "Version of PbARL Studio that wrote the file."),
    Column("exported_at", ColumnKind.TIME, "When the file was written."),
)


def provenance_of(session: Session, study: Study, exported_at: datetime | None = None) -> RowProvenance:
    """Of an export that is made now, or at another moment."""
    deviations = session.scalars(select(Deviation).where(Deviation.study_id == study.id).order_by(Deviation.id)).all()
    return RowProvenance(
        study=study.slug,
        lock_hash=study.lock_hash or NOT_LOCKED,
        deviations=" | ".join(f"{moment(each.at)}: {each.reason}" for each in deviations) or "none",
        software_version=software_version(),
        exported_at=exported_at or now(),
    )


@cache
def software_version() -> str:
    """The installed version of this project."""
    try:
        return version("pbarl-studio")
    except PackageNotFoundError:
        return "unknown"


def csv_lines(table: Table, session: Session, study: Study, provenance: RowProvenance) -> Iterator[str]:
    """The file, line by line. Cells that would run as formulas are defused."""
    yield csv_line(column.name for column in table.all_columns)
    for values in _complete(table, session, study, provenance):
        yield csv_line(values)


def json_lines(table: Table, session: Session, study: Study, provenance: RowProvenance) -> Iterator[str]:
    """The file, line by line: one object per row, every value as it is stored."""
    for record in records(table, session, study, provenance):
        yield json_text(record) + "\n"


def records(table: Table, session: Session, study: Study, provenance: RowProvenance) -> Iterator[dict[str, Any]]:
    """The rows as plain values by column."""
    return (record for _, record in keyed_records(table, session, study, provenance, EVERYTHING))


def keyed_records(
    table: Table, session: Session, study: Study, provenance: RowProvenance, window: Window
) -> Iterator[tuple[Key, dict[str, Any]]]:
    """The rows that are wanted as plain values by column, each with its key."""
    names = [column.name for column in table.all_columns]
    for key, values in table.keyed_rows(session, study, window):
        if window.since and key[-1] <= window.since:
            continue
        whole = (*values, *provenance.values)
        yield key, {name: _plain(value) for name, value in zip(names, whole, strict=True)}


def dictionary(tables: Iterable[Table]) -> list[dict[str, str]]:
    """Every column of every table as a row of the data dictionary."""
    return [
        {
            "table": table.name,
            "column": column.name,
            "type": column.kind.value,
            "unit": column.unit,
            "allowed": column.allowed,
            "meaning": column.meaning,
        }
        for table in tables
        for column in table.all_columns
    ]


def dictionary_csv(tables: Iterable[Table]) -> str:
    """The data dictionary as a table of its own."""
    rows = dictionary(tables)
    return "".join([csv_line(rows[0]), *(csv_line(row.values()) for row in rows)])


def dictionary_markdown(tables: Sequence[Table]) -> str:
    """The data dictionary for people: docs/protocol.md is this."""
    parts = [_HEAD]
    for table in tables:
        parts += [f"## {table.name}", table.meaning, _markdown_table(table.columns)]
    return "\n\n".join([*parts, "## Last columns of every table", _markdown_table(PROVENANCE)]) + "\n"


_HEAD = f"""\
# Data dictionary

Every table and column of a study's export, with type, unit and meaning. Each table can be downloaded as CSV or JSONL
while the study runs. One zip file has all of them as CSV, JSONL and Parquet, with this dictionary, the report's figures
and the preference pairs as arrays (`docs/arrays.md`).

This page is generated from `app/services/exports/tables/` by `python -m app dictionary`; a test fails when it
is out of date.

* Files are UTF-8 without a byte order mark; CSV has a header line, commas, and double quotes where needed.
* Times are UTC in ISO 8601. Unknown is empty in CSV and `null` elsewhere, never 0.
* `json` columns hold JSON text in CSV and Parquet, and the value itself in JSONL.
* In CSV, an apostrophe stands wherever a spreadsheet would begin a formula in a text (before `=`, `+`, `-`, `@` at its
  start, and after a line break, a semicolon or a tab), because participants write some of these texts; line breaks are
  `\\n`, and control characters are replaced (U+FFFD). JSONL and Parquet have texts as they are.
* Participants are known by codes. Of somebody who has withdrawn only a tombstone is left: the code, and when.
* Until a study is unblinded, letters stand for the methods of the evaluation everywhere, and the same letter can be
  another method for another participant.
* Every row ends with study, lock hash ("{NOT_LOCKED}" if there is none), deviations, software version and time."""


def _markdown_table(columns: Sequence[Column]) -> str:
    lines = ["| column | type | unit | allowed | meaning |", "|---|---|---|---|---|"]
    lines += [f"| `{c.name}` | {c.kind} | {c.unit} | {c.allowed} | {c.meaning} |" for c in columns]
    return "\n".join(lines)


def _complete(table: Table, session: Session, study: Study, provenance: RowProvenance) -> Iterator[Sequence[Any]]:
    for values in table.rows(session, study):
        yield (*values, *provenance.values)


def _plain(value: Any) -> Any:
    return moment(value) if isinstance(value, datetime) else value
