"""Empty databases of the newest schema, made once and copied: making the tables takes longer than most tests.

They are files of SQLite, or databases on the PostgreSQL server that TEST_DATABASE_URL names (tests/on_postgresql.py).
"""

import os
import sqlite3
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from functools import cache
from pathlib import Path
from typing import Any
from uuid import uuid4

import psycopg
import pytest
from sqlalchemy import Connection, Dialect, Engine, Pool, create_engine, event, make_url, text
from sqlalchemy.util import LRUCache

from app import upgrading
from app.db import Database, sqlite
from app.settings import Settings

SERVER = os.environ.get("TEST_DATABASE_URL")


@cache
def _empty() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        settings = Settings(_env_file=None, data_dir=Path(folder), database_url=None)
        upgrading.upgrade(settings)
        path = sqlite.file_of(settings.sqlalchemy_url)
        assert path is not None
        with closing(sqlite3.connect(path)) as connection:
            connection.execute("PRAGMA journal_mode=WAL")  # as every program's first connection leaves it
            connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        return path.read_bytes()


def leave_files_to_the_system() -> None:
    """Nothing that this process writes is forced to the disk: no test cuts the power, and waiting for the disk is slow.

    Programs that tests start write as they always do.
    """
    make = sqlite.engine

    def unsynced(url: str, patience_s: float, *, writes: bool, log_pages: int) -> Engine:
        engine = make(url, patience_s, writes=writes, log_pages=log_pages)
        event.listen(engine, "connect", lambda connection, _: connection.execute("PRAGMA synchronous=OFF"))
        return engine

    sqlite.engine = unsynced
    pytest.MonkeyPatch().setattr(os, "fsync", lambda _descriptor: None)


def share_compiled_statements() -> None:
    """One dialect and one cache for all SQLite engines of this process, as if they were the one that a server has.

    Each test has engines of its own, and would spend a quarter of its time on compiling the same statements anew.
    """
    make, cache = sqlite.engine, LRUCache[Any, Any](2000)
    dialect: Dialect | None = None

    def sharing(url: str, patience_s: float, *, writes: bool, log_pages: int) -> Engine:
        nonlocal dialect
        engine = make(url, patience_s, writes=writes, log_pages=log_pages)
        engine.dialect = dialect = dialect or engine.dialect
        engine.update_execution_options(compiled_cache=cache)
        return engine

    sqlite.engine = sharing


def make_tables(database: Database) -> None:
    """Give a database its tables, unless it has them, as those on PostgreSQL do."""
    path = sqlite.file_of(database.url)
    if path is not None and not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(_empty())


def environment(directory: Path, **settings: str) -> dict[str, str]:
    """That of a program with its files there, and its database there or on the server that the test was lent one on."""
    ours = {name: value for name, value in os.environ.items() if name != "DATABASE_URL" or SERVER is not None}
    return {**ours, "DATA_DIR": str(directory), **settings}


@contextmanager
def lent(folder: Path, *, with_tables: bool = True) -> Iterator[str]:
    """The address of a database that nobody has used: in the folder, or on the PostgreSQL server and dropped after."""
    if SERVER is None:
        yield f"sqlite:///{folder / 'studio.sqlite3'}"
        return
    template = _template() if with_tables else "template0"
    name = f"studio_{uuid4().hex}"
    with _administering() as connection:
        # Faster than copying by way of the log, as long as the template is small and nothing is synced.
        connection.execute(text(f"CREATE DATABASE {name} TEMPLATE {template} STRATEGY file_copy"))
    try:
        yield _address(name)
    finally:
        with _administering() as connection:
            connection.execute(text(f"DROP DATABASE {name} WITH (FORCE)"))


def tables_with(marks: Sequence[bytes], url: str) -> list[str]:
    """Tables and indices of a PostgreSQL database whose files hold one of these, as they lie on the server's disk."""
    if sqlite.file_of(url) is not None:
        return []
    found = []
    engine = create_engine(url, isolation_level="AUTOCOMMIT")
    with engine.connect() as connection:
        connection.execute(text("CHECKPOINT"))
        for name, content in connection.execute(text(_CONTENTS)):
            if any(mark in bytes(content) for mark in marks):
                found.append(str(name))
    engine.dispose()
    return found


_CONTENTS = """
    SELECT oid::regclass::text, pg_read_binary_file(pg_relation_filepath(oid)) FROM pg_class
    WHERE relkind IN ('r', 'i', 't', 'm') AND relnamespace <> 'pg_catalog'::regnamespace AND NOT relisshared
    AND pg_relation_filepath(oid) IS NOT NULL
"""


@contextmanager
def all_closed() -> Iterator[None]:
    """In the end, closes connections that programs run in this process have left, as their own end would have done."""
    left: list[psycopg.Connection[Any]] = []

    def note(connection: Any, _record: object) -> None:
        if isinstance(connection, psycopg.Connection):
            left.append(connection)

    event.listen(Pool, "connect", note)
    yield
    event.remove(Pool, "connect", note)
    for connection in left:
        connection.close()


@cache
def _template() -> str:
    """A database with all tables, one for each process of the suite, so that none waits for another's."""
    name = f"template_{uuid4().hex}"
    with _administering() as connection:
        connection.execute(text(f"CREATE DATABASE {name} TEMPLATE template0"))
    with tempfile.TemporaryDirectory() as folder:
        upgrading.upgrade(Settings(_env_file=None, data_dir=Path(folder), database_url=_address(name)))
    return name


@contextmanager
def _administering() -> Iterator[Connection]:
    engine = create_engine(SERVER or "", isolation_level="AUTOCOMMIT")
    with engine.connect() as connection:
        yield connection
    engine.dispose()


def _address(name: str) -> str:
    return make_url(SERVER or "").set(database=name).render_as_string(hide_password=False)
