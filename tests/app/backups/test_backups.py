"""A backup is the whole studio as it was at one moment, or it is not there."""

import multiprocessing
import os
import resource
import shutil
import signal
import sqlite3
import stat
import threading
from collections import namedtuple
from collections.abc import Callable
from contextlib import closing
from functools import partial
from itertools import count
from pathlib import Path

import pytest
from sqlalchemy import text

from app.__main__ import main
from app.db import Database, now
from app.domain.studies import Participant
from app.files import lost as lost_files
from app.services.backups import layout, making, restoring
from app.services.backups.making import BackupFailed, BackupUnderWay, OfPostgresql
from app.services.participants import withdrawal
from app.settings import Settings
from app.storage import ArtefactStore
from tests import backed_up, stored_files
from tests.waiting import PATIENCE_S


@pytest.fixture
def directory(tmp_path: Path) -> Path:
    return tmp_path / "backups"


def in_a_process(act: Callable[[], object]) -> int:
    """The exit code of a process that does it: the number of the signal, negative, that killed it."""

    def quietly() -> None:
        os.umask(0o077)
        try:
            act()
        except BackupFailed:
            os._exit(3)

    process = multiprocessing.get_context("fork").Process(target=quietly)
    process.start()
    process.join()
    assert process.exitcode is not None
    return process.exitcode


def before_each_step(monkeypatch: pytest.MonkeyPatch, act: Callable[[], None]) -> None:
    """A step is a file that is opened or gets its name, or a flush to disk."""

    def noticed(function: Callable[..., object]) -> Callable[..., object]:
        def notice(*arguments: object, **named: object) -> object:
            act()
            return function(*arguments, **named)

        return notice

    monkeypatch.setattr(os, "open", noticed(os.open))
    monkeypatch.setattr(os, "fsync", noticed(os.fsync))
    monkeypatch.setattr(Path, "rename", noticed(Path.rename))


def die_at(number: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Be killed outright before the step of this number."""
    steps = count(1)

    def die() -> None:
        if next(steps) == number:
            os.kill(os.getpid(), signal.SIGKILL)

    before_each_step(monkeypatch, die)


def counted_steps(act: Callable[[], object]) -> int:
    """How many steps it takes, undisturbed."""
    steps: list[None] = []
    with pytest.MonkeyPatch.context() as monkeypatch:
        before_each_step(monkeypatch, lambda: steps.append(None))
        act()
    return len(steps)


def test_a_backup_holds_every_row_and_every_file_and_is_for_its_owner_alone(
    settings: Settings, database: Database, people: list[Participant], directory: Path
) -> None:
    (settings.data_dir / "signing.key").write_bytes(b"secret")
    (settings.data_dir / "engine.sqlite3").write_bytes(b"made anew at the next start")
    backup = making.make(settings, directory)
    assert backed_up.rows(backup.folder / "studio.sqlite3") == backed_up.rows(settings.data_dir / "studio.sqlite3")
    there = backed_up.artefacts(settings.data_dir)
    assert len(there) > 30
    assert backed_up.artefacts(backup.folder) == there == {name: name for name in there}
    assert [path.name for path in (backup.folder / "beside").iterdir()] == ["signing.key"]
    assert backup.manifest.rows["participant"] == len(people)
    assert backup.manifest.missing == []
    modes = {(path.is_dir(), stat.S_IMODE(path.stat().st_mode)) for path in [directory, *directory.rglob("*")]}
    assert modes == {(True, 0o700), (False, 0o600)}
    assert restoring.verify(settings, backup.folder) == backup


def test_backups_share_what_they_have_in_common_and_each_is_whole_without_the_others(
    settings: Settings, database: Database, people: list[Participant], directory: Path
) -> None:
    first = making.make(settings, directory)
    second = making.make(settings, directory)
    shared = [path for path in second.folder.glob("artefacts/*/*") if path.stat().st_nlink == 2]
    assert len(shared) == len(first.manifest.artefacts) > 0
    making.erase(first.folder)
    assert layout.folders_in(directory) == [second.folder]
    restoring.verify(settings, second.folder)


def test_a_file_that_has_decayed_in_an_earlier_backup_is_copied_anew(
    settings: Settings, database: Database, people: list[Participant], directory: Path
) -> None:
    first = making.make(settings, directory)
    decayed = next(first.folder.glob("artefacts/*/*"))
    decayed.write_bytes(decayed.read_bytes()[::-1])
    restoring.verify(settings, making.make(settings, directory).folder)
    with pytest.raises(layout.BackupRefused, match="damaged"):
        restoring.verify(settings, first.folder)


def test_a_file_that_the_studio_has_lost_is_taken_from_an_earlier_backup_or_said_to_be_missing(
    settings: Settings, database: Database, store: ArtefactStore, people: list[Participant], directory: Path
) -> None:
    making.make(settings, directory)
    lost, damaged = sorted(backed_up.artefacts(settings.data_dir))[:2]
    stored_files.lose(store, lost)
    stored_files.overwrite(store, damaged, b"something else")
    assert making.make(settings, directory).manifest.missing == []
    without = making.make(settings, directory.with_name("elsewhere"))
    assert without.manifest.missing == [lost, damaged]
    assert set(store.lost()) == {lost, damaged}, "the dashboard says so"
    restoring.verify(settings, without.folder)


def test_somebody_who_withdraws_while_the_files_are_copied_is_not_in_the_backup(
    settings: Settings,
    database: Database,
    store: ArtefactStore,
    people: list[Participant],
    directory: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    leaving, *staying = people
    copied, copy = 0, making._copied

    def withdrawing(source: Path, target: Path, sha256: str) -> bool:
        nonlocal copied
        copied += 1
        if copied == 5:
            with database.writing() as session:
                withdrawal.withdraw(session, store, session.get_one(Participant, leaving.id), "P01")
        return copy(source, target, sha256)

    monkeypatch.setattr(making, "_copied", withdrawing)
    backup = making.make(settings, directory)
    assert backed_up.traces(directory, backed_up.mark_of(leaving)) == []
    assert all(backed_up.traces(directory, backed_up.mark_of(each)) for each in staying)
    assert backup.manifest.missing == []
    assert layout.folders_in(directory) == [backup.folder]


def test_a_file_whose_row_is_just_being_deleted_is_not_said_to_be_lost(
    settings: Settings,
    database: Database,
    store: ArtefactStore,
    people: list[Participant],
    directory: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    deleted, copy = threading.Event(), making._copied

    def withdraw_slowly() -> None:
        with database.writing() as session:
            withdrawal.withdraw(session, store, session.get_one(Participant, people[0].id), "P01")
            deleted.set()
            threading.Event().wait(0.5)

    def after_the_files_are_gone(source: Path, target: Path, sha256: str) -> bool:
        if not withdrawing.is_alive() and not deleted.is_set():
            withdrawing.start()
        assert deleted.wait(PATIENCE_S)
        return copy(source, target, sha256)

    withdrawing = threading.Thread(target=withdraw_slowly)
    monkeypatch.setattr(making, "_copied", after_the_files_are_gone)
    backup = making.make(settings, directory)
    withdrawing.join()
    assert backup.manifest.missing == []
    assert store.lost() == {}


def test_a_file_that_goes_and_is_made_again_in_the_meantime_is_not_said_to_be_lost(
    settings: Settings,
    database: Database,
    store: ArtefactStore,
    people: list[Participant],
    directory: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    content, copy = b"trajectory 1", making._copied

    def remaking(source: Path, target: Path, sha256: str) -> bool:
        if source != store.files.local(lost_files.place(sha256_of_content)):
            return copy(source, target, sha256)
        found, _ = copy(source, target, sha256), store.put(content)
        return found

    sha256_of_content = store.put(content)
    store.delete(sha256_of_content)
    monkeypatch.setattr(making, "_copied", remaking)
    backup = making.make(settings, directory)
    assert backup.manifest.missing == []
    assert sha256_of_content in backup.manifest.artefacts


def test_rows_that_were_deleted_are_in_no_free_page_of_the_copy(
    settings: Settings, database: Database, people: list[Participant], directory: Path
) -> None:
    with database.writing() as session:
        session.execute(text("DELETE FROM form_answer"))
    backup = making.make(settings, directory)
    assert b"has said this" not in (backup.folder / "studio.sqlite3").read_bytes()


def test_a_backup_that_is_killed_anywhere_leaves_nothing_that_looks_whole_and_the_next_one_clears_up(
    settings: Settings, database: Database, people: list[Participant], directory: Path
) -> None:
    def make_and_die(number: int) -> None:
        with pytest.MonkeyPatch.context() as monkeypatch:
            die_at(number, monkeypatch)
            making.make(settings, directory)

    steps = counted_steps(lambda: making.make(settings, directory))
    for number in (*range(2, steps - 3, steps // 10), *range(steps - 3, steps + 1)):
        making.erase(layout.folders_in(directory)[-1])  # so that files are copied, not shared
        if in_a_process(partial(make_and_die, number)) != 0:
            named = number >= steps - 1  # what is left is to tell the disk so
            assert len(list(directory.glob(".making-*"))) == (not named)
            assert len(layout.folders_in(directory)) == named
        making.make(settings, directory)
    for folder in layout.folders_in(directory):
        restoring.verify(settings, folder)
    making.make(settings, directory)
    assert list(directory.glob(".making-*")) == []


def test_a_disk_that_is_full_leaves_nothing_and_is_explained(
    settings: Settings,
    database: Database,
    people: list[Participant],
    directory: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def with_files_up_to(most_bytes: int) -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (most_bytes, most_bytes))
        making.make(settings, directory)

    for most_bytes in (0, 1000, 100_000):
        assert in_a_process(partial(with_files_up_to, most_bytes)) == 3
        assert [path.name for path in directory.iterdir()] == ["backup.lock"]
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(shutil, "disk_usage", lambda _path: usage(2**30, 2**30 - 2**20, 2**20))
    with pytest.raises(BackupFailed, match="No space left on device"):
        making.make(settings, directory)
    assert [path.name for path in directory.iterdir()] == ["backup.lock"]


def test_directories_that_no_backup_can_go_to_are_explained(
    settings: Settings, database: Database, people: list[Participant], tmp_path: Path
) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(BackupFailed, match="Not a directory"):
        making.make(settings, tmp_path / "file" / "backups")
    with pytest.raises(BackupFailed, match="lies in the data directory"):
        making.make(settings, settings.data_dir / "backups")


def test_a_damaged_database_is_not_backed_up(
    settings: Settings, database: Database, people: list[Participant], directory: Path
) -> None:
    database.dispose()
    with closing(sqlite3.connect(settings.data_dir / "studio.sqlite3")) as connection:
        connection.execute("DELETE FROM study")
        connection.commit()
    with pytest.raises(BackupFailed, match=r"a row of .* refers to a row of study that is not there"):
        making.make(settings, directory)
    assert layout.folders_in(directory) == []


def test_two_backups_into_one_directory_are_not_made_at_once(
    settings: Settings, database: Database, people: list[Participant], directory: Path
) -> None:
    with making.only_one(directory), pytest.raises(BackupUnderWay):
        making.make(settings, directory)


def test_a_database_on_a_server_is_explained_with_the_commands_and_without_the_password() -> None:
    settings = Settings(_env_file=None, database_url="postgresql+psycopg://lab:secret@db.example/studio")
    with pytest.raises(OfPostgresql) as refused:
        making.make(settings, Path("backups"))
    said = refused.value.message
    assert "pg_dump --format=custom --file=studio.dump postgresql://lab@db.example/studio\n" in said
    assert "pg_restore" in said
    assert "secret" not in said


@pytest.mark.sqlite("PostgreSQL is backed up with its own tools")
def test_the_commands_say_what_was_done(
    settings: Settings,
    database: Database,
    people: list[Participant],
    directory: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv("DATA_DIR", str(settings.data_dir))
    assert main(["backup", str(directory)]) == 0
    assert "studies: 1, participants: 3, answers: 12, files: " in capsys.readouterr().out
    (folder,) = layout.folders_in(directory)
    assert main(["verify", str(folder)]) == 0
    assert "is whole: made " in capsys.readouterr().out
    assert main(["verify", str(directory)]) == 1
    assert f"the newest is {folder}" in capsys.readouterr().out
    assert main(["restore", str(folder)]) == 1
    assert "say --replace" in capsys.readouterr().out
    assert main(["restore", str(folder), "--into", str(directory.with_name("new"))]) == 0
    assert "Restored into" in capsys.readouterr().out
    with database.writing() as session:
        session.get_one(Participant, people[0].id).withdrawn_at = now()
        session.get_one(Participant, people[0].id).erased_at = now()
    assert main(["backup", str(directory)]) == 0
    assert f"Somebody who is in {folder} has withdrawn since" in capsys.readouterr().out
