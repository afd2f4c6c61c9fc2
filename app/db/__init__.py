"""The database: sessions that read or write.

A reading session never blocks a writer; a writing session holds the lock from its start.

On SQLite a transaction that begins by reading and then writes can fail with "database is locked" whatever the timeout;
BEGIN IMMEDIATE takes the lock first, so writers queue instead (of 100 racing clients: 1561 failures without, 0 with).
On PostgreSQL an advisory lock does the same, and participants who write nothing but rows of their own share it.
"""

import logging
import sqlite3
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, ClassVar

from sqlalchemy import (
    JSON,
    DateTime,
    Dialect,
    Engine,
    MetaData,
    TypeDecorator,
    func,
    select,
    text,
)
from sqlalchemy.exc import OperationalError
from sqlalchemy.orm import DeclarativeBase, Session, sessionmaker

from app.db import sqlite
from app.db.sqlite import BUSY_TIMEOUT_S
from app.errors import OncePerMinute

SAME_TIME = timedelta(seconds=1)
WRITING, NAMES, AUDITING = 1_347_310_157, 1_347_310_158, 1_347_310_159
"""Advisory locks of PostgreSQL: of whoever writes, of names, of the audit log. Numbers that no other program uses."""

complaints = logging.getLogger("app.database")
"""For whoever could not reach the database and will try again, perhaps twice a second."""
complaints.addFilter(OncePerMinute())


class UtcDateTime(TypeDecorator[datetime]):
    """An aware UTC time; SQLite would forget the zone."""

    impl = DateTime(timezone=True)
    cache_ok = True

    def process_bind_param(self, value: datetime | None, dialect: Dialect) -> datetime | None:
        """Refuse naive times, store the rest as UTC."""
        if value is None:
            return None
        if value.tzinfo is None:
            raise ValueError("Times are stored with their zone; use datetime.now(UTC).")
        return value.astimezone(UTC)

    def process_result_value(self, value: datetime | None, dialect: Dialect) -> datetime | None:
        """In UTC, whatever zone the database answers in."""
        if value is None:
            return None
        return value.replace(tzinfo=UTC) if value.tzinfo is None else value.astimezone(UTC)


class Base(DeclarativeBase):
    """Base of every table; constraints have predictable names so that migrations can change them."""

    metadata = MetaData(
        naming_convention={
            "ix": "ix_%(column_0_N_label)s",
            "uq": "uq_%(table_name)s_%(column_0_N_name)s",
            "ck": "ck_%(table_name)s_%(constraint_name)s",
            "fk": "fk_%(table_name)s_%(column_0_name)s_%(referred_table_name)s",
            "pk": "pk_%(table_name)s",
        }
    )
    type_annotation_map: ClassVar[dict[Any, Any]] = {datetime: UtcDateTime, dict[str, Any]: JSON}


class _Clock:
    """The database's clock on PostgreSQL, else this machine's: leases of different machines are compared.

    Asked of the server whenever somebody begins to write, which is many times a minute. Small differences are none:
    time should not jump to and fro.
    """

    def __init__(self) -> None:
        self.ahead = timedelta()

    def follow(self, theirs: datetime) -> None:
        """Note what the server's clock says at this moment."""
        ahead = theirs - datetime.now(UTC)
        if abs(ahead - self.ahead) > SAME_TIME:
            self.ahead = timedelta() if abs(ahead) <= SAME_TIME else ahead


_clock = _Clock()


def now() -> datetime:
    """The current time by the clock that all machines of this studio share, aware, in UTC."""
    return datetime.now(UTC) + _clock.ahead


class Database:
    """Sessions on one database. Use as ``with database.writing() as session`` or ``reading()``."""

    def __init__(self, url: str, *, keeps_log_short: bool = False) -> None:
        """``keeps_log_short``: whoever opens it calls keep_log_short() now and then, so no commit needs to."""
        self.url = url
        self.is_sqlite = url.startswith("sqlite")
        if self.is_sqlite:
            pages = sqlite.LONGEST_LOG_PAGES if keeps_log_short else sqlite.USUAL_LOG_PAGES
            self.writer = sqlite.engine(url, BUSY_TIMEOUT_S, writes=True, log_pages=pages)
            self.reader = sqlite.engine(url, BUSY_TIMEOUT_S, writes=False, log_pages=pages)
        else:
            from app.db import postgresql  # its driver takes a tenth of a second to load

            self.writer = postgresql.engine(url, BUSY_TIMEOUT_S)
            self.reader = self.writer.execution_options(isolation_level="REPEATABLE READ")
        self._write = sessionmaker(self.writer, expire_on_commit=False)
        self._read = sessionmaker(self.reader, expire_on_commit=False)

    @contextmanager
    def writing(self, *, own_rows: bool = False) -> Iterator[Session]:
        """One transaction that may write: committed at the end, rolled back if anything is raised.

        Nobody else writes meanwhile. ``own_rows`` is the exception on PostgreSQL, for a participant whose row the
        caller locks first and who changes nothing but rows of their own: others of the kind may do so side by side.
        """
        with self._write() as session, session.begin():
            if not self.is_sqlite:
                lock = func.pg_advisory_xact_lock_shared if own_rows else func.pg_advisory_xact_lock
                _, theirs = session.execute(select(lock(WRITING), func.clock_timestamp())).one()
                _clock.follow(theirs)
            yield session

    @contextmanager
    def alongside(self) -> Iterator[Session]:
        """One transaction that may write, while others do: for rows that nothing else depends on. Not on SQLite."""
        with self._write() as session, session.begin():
            yield session

    @contextmanager
    def reading(self) -> Iterator[Session]:
        """One consistent snapshot; what is changed in it is not kept."""
        with self._read() as session:
            yield session

    def keep_log_short(self) -> None:
        """Copy SQLite's write-ahead log into the database as far as nobody reads it, in nobody's way.

        A commit that has to do so takes a quarter of a second on a slow disk.
        """
        if (path := sqlite.file_of(self.url)) is not None:
            sqlite.shorten_log(path)

    def forget_erased(self) -> bool:
        """Let no byte of erased rows stay in the database's files; False when it was too busy and must be asked again.

        PostgreSQL's own log forgets them later, when it is recycled; its archive and backups when they are deleted.
        """
        path = sqlite.file_of(self.url)
        if path is None:
            from app.db import postgresql

            return postgresql.rewrite_tables(self.writer, BUSY_TIMEOUT_S)
        return sqlite.rewrite(path)

    @contextmanager
    def claiming(self, name: str) -> Iterator[bool]:
        """Claim a name for this process until the block ends; False when another has it. With SQLite files do that."""
        if self.is_sqlite:
            yield True
            return
        with self.writer.connect().execution_options(isolation_level="AUTOCOMMIT") as connection:
            key = (NAMES, func.hashtext(name))
            claimed = connection.scalar(select(func.pg_try_advisory_lock(*key)))
            try:
                yield bool(claimed)
            finally:
                if claimed:
                    with suppress(OperationalError):  # the server has gone meanwhile, and the name with it
                        connection.execute(select(func.pg_advisory_unlock(*key)))
                connection.invalidate()

    def watch(self) -> "Watch":
        """Tells from now on whether anybody has written."""
        path = sqlite.file_of(self.url)
        return _SnapshotWatch(self.writer) if path is None else _FileWatch(path)

    def dispose(self) -> None:
        """Close every pooled connection."""
        self.writer.dispose()
        self.reader.dispose()


class Watch(ABC):
    """Whether anybody has written to a database since it was last asked, for almost nothing."""

    _seen: object = None

    def changed(self) -> bool:
        """True at the first call and after every committed change by any process. Call it from one thread."""
        before = self._seen
        try:
            self._seen = self._look()
        except (sqlite3.OperationalError, OperationalError):  # whoever looks closer will see what is wrong
            return True
        return self._seen != before

    @abstractmethod
    def _look(self) -> object:
        """What differs after a change."""

    @abstractmethod
    def close(self) -> None:
        """Let go of what it asks with."""


class _FileWatch(Watch):
    """Asks SQLite for its counter of changes."""

    def __init__(self, path: Path) -> None:
        # A connection of its own that never writes: the counter leaves out what its own connection has written.
        self._connection = sqlite3.connect(path, isolation_level=None)

    def _look(self) -> object:
        return self._connection.execute("PRAGMA data_version").fetchone()

    def close(self) -> None:
        self._connection.close()


class _SnapshotWatch(Watch):
    """Asks PostgreSQL which transactions would be seen: two equal snapshots show the same rows.

    The server's other databases count as well, so it may say yes too often, and never no too often.
    """

    def __init__(self, engine: Engine) -> None:
        self._engine = engine.execution_options(isolation_level="AUTOCOMMIT")

    def _look(self) -> object:
        with self._engine.connect() as connection:
            return connection.scalar(text("SELECT pg_current_snapshot()::text"))

    def close(self) -> None:
        """It has no connection of its own."""
