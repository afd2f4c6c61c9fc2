"""Who waits for whom: everybody for a writer, and only on PostgreSQL not participants for each other."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from sqlalchemy import select, text
from sqlalchemy.exc import OperationalError

from app.db import Database, sqlite
from app.settings import Settings
from tests import databases
from tests.waiting import until


@pytest.fixture
def impatient(database: Database, settings: Settings, monkeypatch: pytest.MonkeyPatch) -> Iterator[Database]:
    """Another program's way to the database; it gives up at once."""
    monkeypatch.setattr("app.db.BUSY_TIMEOUT_S", 0.05)
    other = Database(settings.sqlalchemy_url)
    yield other
    other.dispose()


def may_write(database: Database, *, own_rows: bool) -> bool:
    try:
        with database.writing(own_rows=own_rows) as session:
            session.scalar(select(1))
    except OperationalError:
        return False
    return True


@pytest.mark.parametrize("own_rows", [False, True])
def test_nobody_writes_beside_a_writer(database: Database, impatient: Database, own_rows: bool) -> None:
    with database.writing() as session:
        session.scalar(select(1))  # SQLite takes its lock with the first statement
        assert not may_write(impatient, own_rows=own_rows)
    assert may_write(impatient, own_rows=own_rows)


def test_a_writer_waits_for_those_who_write_their_own_rows(database: Database, impatient: Database) -> None:
    with database.writing(own_rows=True) as session:
        session.scalar(select(1))
        assert not may_write(impatient, own_rows=False)
    assert may_write(impatient, own_rows=False)


@pytest.mark.skipif(databases.SERVER is None, reason="SQLite has one writer at a time")
def test_those_who_write_their_own_rows_do_not_wait_for_each_other(database: Database, impatient: Database) -> None:
    with database.writing(own_rows=True) as session:
        session.scalar(select(1))
        assert may_write(impatient, own_rows=True)


def test_a_name_is_claimed_by_one_at_a_time(database: Database, settings: Settings) -> None:
    other = Database(settings.sqlalchemy_url)
    with database.claiming("worker-1") as first, other.claiming("worker-1") as second, other.claiming("other") as third:
        assert (first, second, third) == (True, database.is_sqlite, True)
    with other.claiming("worker-1") as again:
        assert again
    other.dispose()


@pytest.mark.sqlite("about its write-ahead log")
def test_no_commit_copies_the_log_while_somebody_else_keeps_it_short(database: Database) -> None:
    path = sqlite.file_of(database.url)
    assert path is not None
    served = Database(database.url, keeps_log_short=True)
    before = path.stat().st_size
    with served.writing() as session:
        session.execute(text("CREATE TABLE filler (content BLOB)"))
    for _ in range(3):
        with served.writing() as session:
            session.execute(text("INSERT INTO filler VALUES (zeroblob(4000000))"))
    assert path.stat().st_size == before
    served.keep_log_short()
    assert path.stat().st_size > before + 12_000_000
    served.dispose()
    path.unlink()
    served.keep_log_short()
    assert not path.exists(), "a lost database is to be noticed"


@pytest.mark.sqlite("about its write-ahead log")
def test_nothing_is_rewritten_while_a_program_reads_all_the_time(database: Database) -> None:
    def free_pages() -> int:
        with database.reading() as session:
            return int(session.scalar(text("PRAGMA freelist_count")) or 0)

    for statement in ("CREATE TABLE filler (content BLOB)", "INSERT INTO filler VALUES (zeroblob(400000))"):
        with database.writing() as session:
            session.execute(text(statement))
    with database.reading() as copying:
        copying.scalar(text("SELECT count(*) FROM filler"))
        with database.writing() as session:
            session.execute(text("DROP TABLE filler"))
        assert not database.forget_erased()
        assert free_pages() > 0, "whoever wants to save an answer would have waited for that"
    assert database.forget_erased()
    assert free_pages() == 0


@pytest.mark.skipif(databases.SERVER is None, reason="a file of SQLite holds one database")
def test_rows_are_erased_from_files_though_somebody_writes_in_another_database_of_the_server(
    database: Database, impatient: Database, settings: Settings, tmp_path: Path
) -> None:
    """Whose transaction is older than the erasure: what our own could still see by it would be copied as well."""
    for statement in ("CREATE TABLE filler (content text)", "INSERT INTO filler VALUES ('erase-me')"):
        with database.writing() as session:
            session.execute(text(statement))
    with databases.lent(tmp_path, with_tables=False) as elsewhere:
        other = Database(elsewhere)
        with other.writing() as writing:
            writing.scalar(text("SELECT pg_current_xact_id()"))
            with database.writing() as session:
                session.execute(text("DELETE FROM filler"))
            assert not impatient.forget_erased()
        other.dispose()
    assert until(database.forget_erased)
    assert databases.tables_with([b"erase-me"], settings.sqlalchemy_url) == []
