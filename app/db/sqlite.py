"""Connections to SQLite, and upkeep of its files."""

import os
import sqlite3
import time
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

from sqlalchemy import Connection, Engine, create_engine, event, make_url
from sqlalchemy.exc import OperationalError

BUSY_TIMEOUT_S = 15
READING_S = 1.0
"""Whoever reads for longer is no page, but a backup or a program that copies the log."""
LOOK_AGAIN_S = 0.003
TAKE_THE_LOCK = "BEGIN IMMEDIATE"
USUAL_LOG_PAGES, LONGEST_LOG_PAGES = 1000, 20_000
"""Of the write-ahead log, before a commit copies them into the database: as usual, and where others do it first."""
_FILE = "file"
"""What a connection remembers: which file it has opened."""


def file_of(url: str) -> Path | None:
    """The file of an SQLite database; None for any other."""
    parts = make_url(url)
    return Path(parts.database) if parts.get_backend_name() == "sqlite" and parts.database else None


def engine(url: str, patience_s: float, *, writes: bool, log_pages: int) -> Engine:
    """Connections whose transactions hold the lock from their start if they write, and wait so long for it."""
    connections = create_engine(url, connect_args={"timeout": patience_s, "check_same_thread": False})
    path = file_of(url)

    @event.listens_for(connections, "connect")
    def prepare(connection: Any, record: Any) -> None:
        connection.isolation_level = None  # the driver must not begin transactions of its own
        for pragma in ("journal_mode=WAL", "synchronous=FULL", "foreign_keys=ON", "mmap_size=0"):
            connection.execute(f"PRAGMA {pragma}")
        connection.execute(f"PRAGMA wal_autocheckpoint={log_pages}")
        record.info[_FILE] = _identity(path)

    @event.listens_for(connections, "begin")
    def start(connection: Connection) -> None:
        _require_same(connection, _identity(path))
        if writes:
            _take_the_lock(connection, patience_s)
        else:
            connection.exec_driver_sql("BEGIN")

    return connections


def fits_its_log(path: Path) -> bool:
    """Whether database and log, if it has left one, make a whole. Writes nothing, whatever the log holds.

    SQLite takes in any log whose own sums are right, another database's as well.
    """
    log = path.with_name(f"{path.name}-wal")
    if not log.exists() or log.stat().st_size == 0:
        return True
    try:
        with closing(sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True)) as connection:
            found: tuple[str] = connection.execute("PRAGMA integrity_check(1)").fetchone()
            return found == ("ok",)
    except sqlite3.DatabaseError as error:
        return isinstance(error, sqlite3.OperationalError)  # away, locked or forbidden, which others say in words


def _take_the_lock(connection: Connection, patience_s: float) -> None:
    """Begin to write, as soon as whoever writes has finished.

    SQLite's own waiting looks again every 25 to 100 ms, which is many answers long.
    """
    ours: Any = connection.connection.dbapi_connection
    give_up_at_s = time.monotonic() + patience_s
    ours.execute("PRAGMA busy_timeout=0")
    try:
        while time.monotonic() < give_up_at_s:
            try:
                ours.execute(TAKE_THE_LOCK)
            except sqlite3.OperationalError as error:
                if error.sqlite_errorcode & 0xFF != sqlite3.SQLITE_BUSY:  # the rest says why it is
                    break
                time.sleep(LOOK_AGAIN_S)
            else:
                return
        connection.exec_driver_sql(TAKE_THE_LOCK)  # so that what it raises is SQLAlchemy's
    finally:
        ours.execute(f"PRAGMA busy_timeout={round(1000 * patience_s)}")


def _identity(path: Path | None) -> tuple[int, int] | None:
    """Device and number of the file; None when there is none."""
    if path is None:
        return None
    try:
        known = path.stat()
    except OSError:
        return None
    return known.st_dev, known.st_ino


def _require_same(connection: Any, present: tuple[int, int] | None) -> None:
    """Raises OperationalError when the file was deleted or replaced: what is written to it now would be lost.

    SQLite goes on with the file it has opened, which nobody else will ever see.
    """
    opened = connection.info[_FILE]
    if opened in (None, present):
        return
    if present is not None:
        connection.invalidate()  # the next connection opens what is there now
    raise OperationalError("BEGIN", None, sqlite3.OperationalError("unable to open: the file was deleted or replaced"))


def shorten_log(path: Path) -> None:
    """Copy the write-ahead log into the database as far as nobody reads it, in nobody's way."""
    with suppress(sqlite3.OperationalError):  # busy, or gone: then no empty one is made in its place
        address = f"{path.resolve().as_uri()}?mode=rw"
        with closing(sqlite3.connect(address, uri=True, isolation_level=None)) as connection:
            connection.execute("PRAGMA wal_checkpoint(PASSIVE)")


def rewrite(path: Path) -> bool:
    """Write a SQLite database anew, without what freed pages and the write-ahead log remember. False while it is busy.

    Deleting alone leaves the bytes where they were; VACUUM copies only what is alive, and the log is cut to nothing.
    Where somebody reads all the time, nothing is copied: nobody could save anything meanwhile.
    """
    with closing(sqlite3.connect(path, timeout=BUSY_TIMEOUT_S, isolation_level=None)) as connection:
        try:
            connection.execute("PRAGMA secure_delete=ON")
            if not _cut_log(connection, READING_S):
                return False
            connection.execute("VACUUM")
            return _cut_log(connection, BUSY_TIMEOUT_S)
        except sqlite3.OperationalError:
            return False


def _cut_log(connection: sqlite3.Connection, patience_s: float) -> bool:
    """Copy the write-ahead log into the database and cut it to nothing. False when somebody reads for longer than that;
    meanwhile nobody can write."""
    connection.execute(f"PRAGMA busy_timeout={round(1000 * patience_s)}")
    busy, *_ = connection.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchone()
    connection.execute(f"PRAGMA busy_timeout={round(1000 * BUSY_TIMEOUT_S)}")
    return not busy


def copy(path: Path, target: Path) -> None:
    """A consistent copy of a SQLite database, whoever writes to it meanwhile; for its owner only.

    VACUUM INTO and not the backup API: the copy is one snapshot either way, but this leaves out freed pages, in which
    erased rows may still stand. Raises sqlite3.DatabaseError.
    """
    os.close(os.open(target, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600))  # SQLite fills an empty file as it is
    with closing(sqlite3.connect(path, timeout=BUSY_TIMEOUT_S, isolation_level=None)) as connection:
        connection.execute("VACUUM INTO ?", (str(target),))
    with target.open("rb") as stream:
        os.fsync(stream.fileno())
