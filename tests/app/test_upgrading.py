"""An old database is brought to the newest schema wholly or not at all, with everything that is in it."""

import multiprocessing
import os
import shutil
import signal
import sqlite3
import stat
import threading
from collections import namedtuple
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy as sa
from alembic import command
from alembic.script import ScriptDirectory
from sqlalchemy import Engine, event

from app import upgrading
from app.db import Database
from app.errors import AppError
from app.settings import Settings

Rows = dict[str, list[tuple[Any, ...]]]
OLDEST = "0001"


pytestmark = pytest.mark.sqlite("about the file and the copies made of it")


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    return Settings(_env_file=None, data_dir=tmp_path, database_url=None)


@pytest.fixture
def path(settings: Settings) -> Path:
    """A database of the first version with three rows in every table."""
    command.upgrade(upgrading._config(settings), OLDEST)
    path = settings.data_dir / "studio.sqlite3"
    fill(path)
    return path


def fill(path: Path) -> None:
    engine = sa.create_engine(f"sqlite:///{path}")
    tables = sa.MetaData()
    tables.reflect(engine)
    with engine.begin() as connection:
        for table in tables.sorted_tables:
            if table.name != "alembic_version":
                connection.execute(table.insert(), [row_of(table, number) for number in (1, 2, 3)])
    engine.dispose()


def row_of(table: sa.Table, number: int) -> dict[str, Any]:
    """Something that fits: numbers point at the row of that number, texts are told apart by theirs."""
    row = {column.name: value_of(column, number) for column in table.columns}
    if table.name == "browser_session":  # one person's
        row["experimenter_id"] = None
    if table.name == "query":  # of two clips
        row["right_clip_id"] = number % 3 + 1
    return row


def value_of(column: sa.Column[Any], number: int) -> Any:
    if isinstance(column.type, sa.JSON):
        return {"number": number}
    kind = column.type.python_type
    if kind is str:
        return f"{column.name} {number}"[-(getattr(column.type, "length", None) or 99) :]
    if kind is datetime:
        return datetime(2026, 1, number, tzinfo=UTC)
    return kind(number)


def contents(path: Path) -> Rows:
    """Every row of every table of the first version, in the columns it had then."""
    with closing(sqlite3.connect(path)) as connection:
        return {
            table: connection.execute(f"SELECT {', '.join(columns)} FROM {table} ORDER BY 1").fetchall()  # noqa: S608
            for table, columns in COLUMNS.items()
        }


COLUMNS: dict[str, list[str]] = {}


@pytest.fixture
def before(path: Path) -> Rows:
    """What is in the database before it is upgraded."""
    with closing(sqlite3.connect(path)) as connection:
        names = [name for (name,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")]
        COLUMNS.clear()
        for name in set(names) - {"alembic_version"}:
            COLUMNS[name] = [f'"{row[1]}"' for row in connection.execute(f"PRAGMA table_info({name})")]
    rows = contents(path)
    assert len(rows) > 10
    assert all(len(each) == 3 for each in rows.values())
    return rows


def revision(path: Path) -> str:
    with closing(sqlite3.connect(path)) as connection:
        found: str = connection.execute("SELECT version_num FROM alembic_version").fetchone()[0]
        return found


def newest(settings: Settings) -> str:
    return ScriptDirectory.from_config(upgrading._config(settings)).get_current_head() or ""


def die_at(number: int, settings: Settings) -> None:
    """Upgrade in a process of its own, which is killed outright before the statement of this number."""
    seen = 0

    @event.listens_for(Engine, "before_cursor_execute")
    def count(*_: object) -> None:
        nonlocal seen
        seen += 1
        if seen == number:
            os.kill(os.getpid(), signal.SIGKILL)

    upgrading.upgrade(settings)


def killed_at(number: int, settings: Settings) -> bool:
    """False when the upgrade had ended before that statement."""
    process = multiprocessing.get_context("fork").Process(target=die_at, args=(number, settings))
    process.start()
    process.join()
    assert process.exitcode in (0, -signal.SIGKILL)
    return process.exitcode != 0


def test_an_upgrade_keeps_every_row_and_leaves_a_copy_for_its_owner(
    settings: Settings, path: Path, before: Rows
) -> None:
    upgrading.upgrade(settings)
    assert revision(path) == newest(settings)
    assert contents(path) == before
    (copy,) = upgrading.copies(path)
    assert revision(copy) == OLDEST
    assert contents(copy) == before
    assert stat.S_IMODE(copy.stat().st_mode) == 0o600


def test_a_killed_upgrade_leaves_the_database_as_it_was_and_is_made_up_for_by_the_next(
    settings: Settings, path: Path, before: Rows
) -> None:
    original = path.with_name("original")
    shutil.copy(path, original)
    kills = 0
    for number in range(1, 1000, 31):  # every kind of statement comes far more often than that
        if not killed_at(number, settings):
            break
        kills += 1
        assert revision(path) == OLDEST
        assert contents(path) == before
        if kills % 4 == 0:
            upgrading.upgrade(settings)
            assert revision(path) == newest(settings)
            assert contents(path) == before
            shutil.copy(original, path)
    assert kills > 10
    upgrading.upgrade(settings)
    assert revision(path) == newest(settings)
    assert contents(path) == before
    assert len(upgrading.copies(path)) == upgrading.KEPT_COPIES


def test_a_first_start_that_is_killed_is_made_up_for_by_the_next(settings: Settings) -> None:
    for number in (1, 5, 20, 60, 120):
        assert killed_at(number, settings)
    upgrading.upgrade(settings)
    assert revision(settings.data_dir / "studio.sqlite3") == newest(settings)


def test_two_programs_that_upgrade_at_once_do_it_once(settings: Settings, path: Path, before: Rows) -> None:
    fork = multiprocessing.get_context("fork")
    together = [fork.Process(target=upgrading.upgrade, args=(settings,)) for _ in range(4)]
    for process in together:
        process.start()
    for process in together:
        process.join()
    assert [process.exitcode for process in together] == [0] * 4
    assert contents(path) == before
    assert len(upgrading.copies(path)) == 1


def test_alembic_itself_may_be_run_by_two_at_once(settings: Settings, path: Path, before: Rows) -> None:
    fork, config = multiprocessing.get_context("fork"), upgrading._config(settings)
    together = [fork.Process(target=command.upgrade, args=(config, "head")) for _ in range(4)]
    for process in together:
        process.start()
    for process in together:
        process.join()
    assert [process.exitcode for process in together] == [0] * 4
    assert contents(path) == before


def test_a_database_of_a_newer_version_is_left_alone_and_explained(settings: Settings, path: Path) -> None:
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("UPDATE alembic_version SET version_num = 'f00f'")
        connection.commit()
    with pytest.raises(upgrading.NewerDatabase, match=r"newer version of this program.*Install.*f00f"):
        upgrading.upgrade(settings)
    assert upgrading.copies(path) == []


def test_tables_that_a_killed_earlier_version_left_without_a_number_are_explained(settings: Settings) -> None:
    with closing(sqlite3.connect(settings.data_dir / "studio.sqlite3")) as connection:
        connection.execute("CREATE TABLE study (id INTEGER)")
    with pytest.raises(upgrading.UnfinishedDatabase, match=r"move .*studio\.sqlite3 away"):
        upgrading.upgrade(settings)


def test_half_an_upgrade_that_an_earlier_version_left_is_explained(
    settings: Settings, path: Path, before: Rows
) -> None:
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("CREATE TABLE api_token (id INTEGER)")
    with pytest.raises(upgrading.UpgradeFailed, match=r"restore the database.*table api_token already exists"):
        upgrading.upgrade(settings)
    assert revision(path) == OLDEST
    assert contents(path) == before


def test_rows_that_refer_to_nothing_are_explained(settings: Settings, path: Path) -> None:
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("DELETE FROM study WHERE id = 2")
        connection.commit()
    with pytest.raises(AppError, match=r"not upgraded.*participant"):
        upgrading.upgrade(settings)
    assert revision(path) == OLDEST


@pytest.mark.parametrize("first_byte", [0, 4096 * 3])
def test_a_damaged_database_is_left_alone_and_explained(settings: Settings, path: Path, first_byte: int) -> None:
    size = path.stat().st_size
    with path.open("r+b") as stream:
        stream.seek(first_byte)
        stream.write(os.urandom(size - first_byte))
    damaged = path.read_bytes()
    with pytest.raises(upgrading.DamagedDatabase):
        upgrading.upgrade(settings)
    assert path.read_bytes() == damaged
    assert upgrading.copies(path) == []


def test_without_space_for_a_copy_nothing_is_upgraded(
    settings: Settings, path: Path, before: Rows, monkeypatch: pytest.MonkeyPatch
) -> None:
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(shutil, "disk_usage", lambda _path: usage(2**30, 2**30 - 2**20, 2**20))
    with pytest.raises(upgrading.NoSpaceToUpgrade, match=r"Free \d+ MiB"):
        upgrading.upgrade(settings)
    assert revision(path) == OLDEST
    assert contents(path) == before


def test_the_copy_holds_what_was_committed_while_others_write(settings: Settings, path: Path) -> None:
    stop = threading.Event()
    written: list[None] = []

    def write() -> None:
        database = Database(settings.sqlalchemy_url)
        while not stop.is_set():
            with database.writing() as session:
                session.execute(sa.text("UPDATE study SET name = :name"), {"name": f"name {len(written)}"})
            written.append(None)
        database.dispose()

    writer = threading.Thread(target=write)
    writer.start()
    while len(written) < 20:
        threading.Event().wait(0.01)
    upgrading._copy(path, "0002")
    stop.set()
    writer.join()
    (copy,) = upgrading.copies(path)
    with closing(sqlite3.connect(copy)) as connection:
        assert connection.execute("PRAGMA integrity_check").fetchone() == ("ok",)
        names = connection.execute("SELECT DISTINCT name FROM study").fetchall()
    assert len(names) == 1, "all of a transaction or nothing"
