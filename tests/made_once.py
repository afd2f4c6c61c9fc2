"""What many tests begin with: made once in a process, then its rows and files are copied into their empty studios.

A study with everything in it takes hundreds of statements of the ORM; copying it takes one for each table.
"""

from collections.abc import Callable, Hashable, Iterable
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any, Concatenate, ParamSpec, TypeVar

from sqlalchemy import Table, func, select, text
from sqlalchemy.orm import Session

from app.db import Base, UtcDateTime, now
from app.domain.people import AuditEvent
from app.services import audit
from app.storage import ArtefactStore
from tests import stored_files

P = ParamSpec("P")
Made = TypeVar("Made")


@dataclass(frozen=True)
class Copy:
    """What was made in an empty studio, and when."""

    returned: Any
    rows: dict[Table, list[dict[str, Any]]]
    """As SQLite holds them."""
    files: list[bytes]
    at: datetime

    def paste(self, session: Session, store: ArtefactStore) -> None:
        """Make it again, as if at this moment; only the audit log keeps its times, for it holds hashes of them."""
        for content in self.files:
            store.put(content)
        later = now() - self.at
        session.execute(text("PRAGMA defer_foreign_keys=ON"))
        for table, rows in self.rows.items():
            times = [column.name for column in table.columns if isinstance(column.type, UtcDateTime)]
            if table.name == AuditEvent.__tablename__:
                times = []
            names = [*table.columns.keys()]
            marks = ", ".join(f":{name}" for name in names)
            session.connection().exec_driver_sql(
                f'INSERT INTO "{table.name}" ({", ".join(names)}) VALUES ({marks})',  # noqa: S608  (our own names)
                [row | {name: _moved(row[name], later) for name in times if row[name]} for row in rows],
            )


_COPIES: dict[Hashable, Copy] = {}


def made_once(
    make: Callable[Concatenate[Session, ArtefactStore, P], Made],
    session: Session,
    store: ArtefactStore,
    *about: P.args,
    **more: P.kwargs,
) -> Made:
    """What ``make`` returns, which must be no rows. It is called where no copy fits, as on PostgreSQL.

    A copy fits where all tables that it has rows of are empty, for it has their ids.
    """
    if session.get_bind().dialect.name != "sqlite":
        return make(session, store, *about, **more)
    kind = make, repr((about, more))
    copy = _COPIES.get(kind)
    if copy is not None and not any(counts(session, copy.rows).values()):
        copy.paste(session, store)
        made: Made = copy.returned
        return made
    before, files = counts(session, Base.metadata.sorted_tables), stored_files.names(store)
    made = make(session, store, *about, **more)
    session.flush()
    if session.info.get(audit._PENDING):
        audit._append(session)  # else it would be recorded at the end of the transaction, and not be copied
    after = counts(session, Base.metadata.sorted_tables)
    changed = [table for table, count in after.items() if count != before[table]]
    if not files and not any(before[table] for table in changed):
        rows = {table: _rows(session, table) for table in changed}
        _COPIES[kind] = Copy(made, rows, [*stored_files.everything(store)], now())
    return made


def _rows(session: Session, table: Table) -> list[dict[str, Any]]:
    found = session.connection().exec_driver_sql(f'SELECT * FROM "{table.name}"')  # noqa: S608  (our own name)
    return [dict(row) for row in found.mappings()]


def _moved(time: str, by: timedelta) -> str:
    return (datetime.fromisoformat(time) + by).isoformat(" ", "microseconds")


def counts(session: Session, tables: Iterable[Table]) -> dict[Table, int]:
    """How many rows each has."""
    counted = [select(func.count()).select_from(table).scalar_subquery() for table in tables]
    return dict(zip(tables, session.execute(select(*counted)).one(), strict=True))
