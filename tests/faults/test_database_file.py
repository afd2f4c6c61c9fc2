"""The database's file is damaged, deleted, replaced, or its log is: nothing is acknowledged that is not kept."""

import os
import shutil
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from uuid import uuid4

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import func, select

from app.__main__ import main, migrate
from app.db import Database
from app.domain.preferences import LabelEvent
from app.settings import Settings
from app.storage import ArtefactStore
from app.upgrading import DatabaseLost, LogDoesNotFit
from tests import factories
from tests.app.conftest import TakingPart
from tests.databases import make_tables

pytestmark = pytest.mark.sqlite("about its files")


@pytest.fixture
def file(settings: Settings) -> Path:
    return settings.data_dir / "studio.sqlite3"


def deleted(file: Path) -> None:
    file.unlink()


def replaced_by_an_empty_one(file: Path) -> None:
    other = file.with_name("other")
    other.touch()
    other.rename(file)


@pytest.mark.parametrize("loss", [deleted, replaced_by_an_empty_one], ids=lambda loss: loss.__name__)
def test_no_answer_is_acknowledged_into_a_file_that_is_no_longer_there(
    taking_part: TakingPart, file: Path, loss: Callable[[Path], None]
) -> None:
    """SQLite goes on with the file it has opened, which nobody will ever find again."""
    first, second = taking_part.queries[:2]
    taking_part.turn()
    assert taking_part.answer(first).status_code == 200
    with closing(sqlite3.connect(file)) as connection:
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    kept = file.with_name("kept")
    os.link(file, kept)
    loss(file)
    uuid = uuid4()
    for _ in range(3):
        answer = taking_part.answer(second, uuid=uuid)
        assert answer.status_code == 503
        assert "Nothing was saved" in answer.json()["detail"]
    taking_part.database.dispose()
    for ending in ("-wal", "-shm"):
        file.with_name(file.name + ending).unlink(missing_ok=True)
    kept.replace(file)
    assert taking_part.answer(second, uuid=uuid).status_code == 200
    assert [len(taking_part.events(query)) for query in (first, second)] == [1, 1]


def test_pages_on_a_damaged_database_say_so_and_acknowledge_nothing(
    taking_part: TakingPart, experimenter: TestClient, file: Path
) -> None:
    taking_part.turn()
    taking_part.database.dispose()
    with closing(sqlite3.connect(file)) as connection:
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    size = file.stat().st_size
    with file.open("r+b") as stream:  # all but the first page, with which it can be opened
        stream.seek(4096)
        stream.write(os.urandom(size - 4096))
    browser = TestClient(taking_part.browser.app, raise_server_exceptions=False, cookies=taking_part.browser.cookies)
    taking_part.browser = browser
    answer = taking_part.answer(taking_part.queries[0])
    assert answer.status_code == 503
    assert "Nothing was saved" in answer.json()["detail"]
    experimenter = TestClient(experimenter.app, raise_server_exceptions=False, cookies=experimenter.cookies)
    page = experimenter.get("/studies")
    assert page.status_code == 503
    assert "tell the experimenter" in page.text or "backup" in page.text
    assert experimenter.get("/health").status_code == 503


@pytest.fixture
def crashed(settings: Settings, tmp_path: Path) -> Iterator[Settings]:
    """A copy of a studio as a power cut left it: answers 1 to 5 in the file, 6 to 10 only in its log."""
    database, store = Database(settings.sqlalchemy_url), ArtefactStore.of(settings)
    make_tables(database)
    with database.writing() as session:
        study = factories.make_study(session)
        participant, _ = factories.make_participant(session, study)
        queries = factories.make_queries(session, store, participant, 10)
    for number, query in enumerate(queries):
        if number == 5:
            with closing(sqlite3.connect(settings.data_dir / "studio.sqlite3")) as connection:
                connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        with database.writing() as session:
            factories.make_label(session, query)
    copy = settings.model_copy(update={"data_dir": tmp_path / "crashed", "database_url": None})
    shutil.copytree(settings.data_dir, copy.data_dir, ignore=shutil.ignore_patterns("crashed"))
    yield copy
    database.dispose()


def log_cut_short(log: Path) -> None:
    os.truncate(log, log.stat().st_size - 5000)


def log_overwritten_in_the_middle(log: Path) -> None:
    with log.open("r+b") as stream:
        stream.seek(log.stat().st_size // 2)
        stream.write(os.urandom(5000))


def log_overwritten(log: Path) -> None:
    log.write_bytes(os.urandom(log.stat().st_size))


def log_deleted(log: Path) -> None:
    log.unlink()


LOGS = [log_cut_short, log_overwritten_in_the_middle, log_overwritten, log_deleted]


@pytest.mark.parametrize("damage", LOGS, ids=lambda damage: damage.__name__)
def test_with_a_damaged_log_the_database_is_as_it_was_before_the_damage(
    crashed: Settings, damage: Callable[[Path], None]
) -> None:
    damage(crashed.data_dir / "studio.sqlite3-wal")
    migrate(crashed)
    database = Database(crashed.sqlalchemy_url)
    with database.writing() as session:
        count = session.scalar(select(func.count(LabelEvent.id))) or 0
        assert 5 <= count < 10, "what was in the file is there, and what the log has lost is not there by halves"
        last = session.scalars(select(LabelEvent.query_id).order_by(LabelEvent.id)).all()
        assert list(last) == sorted(last), "the first of them, without gaps"
        assert session.connection().exec_driver_sql("PRAGMA integrity_check").scalar() == "ok"
    database.dispose()


def test_a_log_that_a_power_cut_left_whole_is_taken_in(crashed: Settings) -> None:
    database = Database(crashed.sqlalchemy_url)
    with database.reading() as session:
        assert session.scalar(select(func.count(LabelEvent.id))) == 10
    database.dispose()


def test_a_studio_whose_database_is_gone_does_not_begin_anew_over_its_files(
    settings: Settings, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """An empty database refers to no file, and what nothing refers to is cleared away."""
    monkeypatch.setenv("DATA_DIR", str(settings.data_dir))
    migrate(settings)
    kept = ArtefactStore.of(settings).put(b"somebody's bundle")
    file = settings.data_dir / "studio.sqlite3"
    for loss in (deleted, replaced_by_an_empty_one):
        file.touch()
        loss(file)
        for command in ("migrate", "up", "link"):
            assert main([command]) == 1
            assert "Restore it from a backup" in capsys.readouterr().out
        assert ArtefactStore.of(settings).has(kept)


def test_a_log_without_its_database_is_kept(crashed: Settings) -> None:
    shutil.rmtree(crashed.data_dir / "artefacts")
    deleted(crashed.data_dir / "studio.sqlite3")
    log = crashed.data_dir / "studio.sqlite3-wal"
    before = log.read_bytes()
    with pytest.raises(DatabaseLost):
        migrate(crashed)
    assert log.read_bytes() == before


def test_a_log_of_another_database_is_not_taken_in(crashed: Settings, tmp_path: Path) -> None:
    """SQLite would: the sums in it are right."""
    file, other = crashed.data_dir / "studio.sqlite3", tmp_path / "another.sqlite3"
    with closing(sqlite3.connect(other, isolation_level=None)) as connection:
        connection.execute("CREATE TABLE theirs (text TEXT)")
        connection.executemany("INSERT INTO theirs VALUES (?)", [("x" * 400,)] * 500)
        connection.execute("PRAGMA journal_mode=WAL")
        connection.execute("UPDATE theirs SET text = upper(text)")
        shutil.copy(f"{other}-wal", f"{file}-wal")
    before = file.read_bytes(), Path(f"{file}-wal").read_bytes()
    with pytest.raises(LogDoesNotFit, match="move it away"):
        migrate(crashed)
    assert (file.read_bytes(), Path(f"{file}-wal").read_bytes()) == before
