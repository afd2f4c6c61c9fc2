"""What a database says of itself, whatever its schema: read without the program's own classes, which know the newest.

A backup is often made just before an upgrade, by either version, and restored by a newer one.
"""

import re
import sqlite3
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from pathlib import Path

from app.db.sqlite import BUSY_TIMEOUT_S
from app.services.participants.withdrawal import ARTEFACT_COLUMNS

Identity = str
"""A participant or study for good: row id, seed and time of creation, such as
``participant/3/1763811000/2026-11-22 11:30:00.000000``. After a restore, ids alone are given again to others."""
_SHA256 = re.compile(r"\b[0-9a-f]{64}\b")


@contextmanager
def reading(path: Path, *, still: bool = False) -> Iterator[sqlite3.Connection]:
    """One snapshot. ``still``: nobody else has the file open, and nothing is to be written beside it."""
    mode = "mode=ro&immutable=1" if still else "mode=ro"
    address = f"{path.resolve().as_uri()}?{mode}"
    with closing(sqlite3.connect(address, uri=True, timeout=BUSY_TIMEOUT_S, isolation_level=None)) as connection:
        connection.execute("PRAGMA trusted_schema=OFF")
        connection.execute("BEGIN")
        yield connection


@contextmanager
def reading_after_writers(path: Path) -> Iterator[sqlite3.Connection]:
    """What holds once everybody who is writing now has ended: files are deleted before the rows that name them."""
    address = f"{path.resolve().as_uri()}?mode=rw"
    with closing(sqlite3.connect(address, uri=True, timeout=BUSY_TIMEOUT_S, isolation_level=None)) as connection:
        connection.execute("BEGIN IMMEDIATE")
        yield connection
        connection.execute("ROLLBACK")


def revision(connection: sqlite3.Connection) -> str:
    """Of the schema; empty without one."""
    if not _columns(connection, "alembic_version"):
        return ""
    found = connection.execute("SELECT version_num FROM alembic_version").fetchone()
    return "" if found is None else str(found[0])


def row_counts(connection: sqlite3.Connection) -> dict[str, int]:
    """Rows of each table."""
    tables = connection.execute("SELECT name FROM sqlite_master WHERE type = 'table' AND name NOT LIKE 'sqlite_%'")
    return {
        name: connection.execute(f"SELECT count(*) FROM {_quoted(name)}").fetchone()[0]  # noqa: S608  (names cannot be parameters; quoted or ours)
        for name in sorted(name for (name,) in tables)
    }


def complaint(connection: sqlite3.Connection) -> str | None:
    """What is wrong inside the file; None when it is sound."""
    (verdict,) = connection.execute("PRAGMA integrity_check(1)").fetchone()
    if verdict != "ok":
        return str(verdict)
    dangling = connection.execute("PRAGMA foreign_key_check").fetchone()
    return None if dangling is None else f"a row of {dangling[0]} refers to a row of {dangling[2]} that is not there"


def artefacts(connection: sqlite3.Connection) -> set[str]:
    """The files that rows name."""
    named: set[str] = set()
    for column in ARTEFACT_COLUMNS:
        table = column.class_.__tablename__
        if column.key in _columns(connection, table):
            rows = connection.execute(f"SELECT DISTINCT {_quoted(column.key)} FROM {_quoted(table)}")  # noqa: S608  (names cannot be parameters; quoted or ours)
            named |= {sha256 for (sha256,) in rows if sha256 is not None and _SHA256.fullmatch(sha256)}
    if "figures" in _columns(connection, "report"):
        for (figures,) in connection.execute("SELECT figures FROM report"):
            named |= set(_SHA256.findall(figures))
    return named


def present(connection: sqlite3.Connection) -> dict[Identity, int]:
    """Participants and studies of which there may be more than a tombstone, with their row ids."""
    return _identities(connection, {"participant": "erased_at", "study": "erased_at"}, set_already=False)


def erased(connection: sqlite3.Connection) -> dict[Identity, int]:
    """Those of whom the last trace in the studio is erased."""
    return _identities(connection, {"participant": "erased_at", "study": "erased_at"}, set_already=True)


def gone(connection: sqlite3.Connection) -> dict[Identity, int]:
    """Participants who have withdrawn and studies that were deleted, erased already or not."""
    return _identities(connection, {"participant": "withdrawn_at", "study": "deleted_at"}, set_already=True)


def _identities(
    connection: sqlite3.Connection, time_columns: Mapping[str, str], *, set_already: bool
) -> dict[Identity, int]:
    found: dict[Identity, int] = {}
    for table, column in time_columns.items():
        columns = _columns(connection, table)
        if not columns or (set_already and column not in columns):
            continue
        where = f"{column} IS {'NOT ' if set_already else ''}NULL" if column in columns else "true"
        identity = f"'{table}/' || id || '/' || seed || '/' || created_at"
        found |= connection.execute(f"SELECT {identity}, id FROM {table} WHERE {where}").fetchall()  # noqa: S608  (names cannot be parameters; quoted or ours)
    return found


def _columns(connection: sqlite3.Connection, table: str) -> set[str]:
    return {name for (name,) in connection.execute("SELECT name FROM pragma_table_info(?)", (table,))}


def _quoted(name: str) -> str:
    return '"' + name.replace('"', '""') + '"'
