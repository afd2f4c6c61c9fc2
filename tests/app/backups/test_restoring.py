"""A restored studio is the one of the backup, without those who have withdrawn since; what was there is kept."""

import os
import shutil
import sqlite3
from contextlib import closing
from functools import partial
from pathlib import Path

import pytest
from alembic import command
from fastapi.testclient import TestClient
from sqlalchemy import select

from app import data_directory, upgrading
from app.data_directory import DirectoryBeingRestored, DirectoryInUse, RestoreInterrupted
from app.db import Database, now
from app.domain.preferences import LabelEvent
from app.domain.studies import Participant, Study
from app.main import create_app
from app.services.auditing import chain_check
from app.services.backups import layout, making, restoring, withdrawals
from app.services.backups.layout import Backup
from app.services.backups.restoring import DirectoryNotEmpty, RestoreFailed
from app.services.participants import enrolment, withdrawal
from app.services.studies import retirement
from app.settings import Settings
from app.storage import ArtefactStore
from tests import backed_up
from tests.app import test_upgrading
from tests.app.backups.test_backups import counted_steps, die_at, in_a_process


@pytest.fixture
def backup(settings: Settings, people: list[Participant], tmp_path: Path) -> Backup:
    return making.make(settings, tmp_path / "backups")


@pytest.fixture
def new(tmp_path: Path) -> Path:
    return tmp_path / "new"


def database_in(data_dir: Path) -> Path:
    return data_dir / "studio.sqlite3"


def add_answer(database: Database) -> None:
    """Something that no backup has."""
    with database.writing() as session:
        old = session.scalars(select(LabelEvent)).first()
        assert old is not None
        session.add(LabelEvent(query_id=old.query_id, revision=2, response="right", client_uuid="u", created_at=now()))


def test_a_restored_studio_has_every_row_and_file_and_serves_its_participants(
    settings: Settings, database: Database, people: list[Participant], new: Path, tmp_path: Path
) -> None:
    with database.writing() as session:
        _, token = enrolment.add_participant(session, session.get_one(Study, 1))
    (settings.data_dir / "signing.key").write_bytes(b"secret")
    backup = making.make(settings, tmp_path / "backups")
    done = restoring.restore(settings, backup.folder, new)
    assert (done.erased_again, done.replaced) == (0, None)
    assert backed_up.rows(database_in(new)) == backed_up.rows(database_in(settings.data_dir))
    assert backed_up.artefacts(new) == backed_up.artefacts(settings.data_dir)
    assert (new / "signing.key").read_bytes() == b"secret"
    assert {path.name for path in new.iterdir()} == {"studio.sqlite3", "artefacts", "signing.key", "studio.lock"}
    with TestClient(create_app(settings.model_copy(update={"data_dir": new})), follow_redirects=False) as browser:
        assert browser.get("/health").text == "ok"
        assert browser.get(f"/p/{token}").status_code == 303


def test_a_directory_that_holds_something_is_left_alone_unless_told_otherwise(
    settings: Settings, database: Database, backup: Backup
) -> None:
    before = backed_up.rows(database_in(settings.data_dir))
    with pytest.raises(DirectoryNotEmpty, match="--replace"):
        restoring.restore(settings, backup.folder)
    assert backed_up.rows(database_in(settings.data_dir)) == before
    assert not list(settings.data_dir.glob("restoring-*"))


def test_what_was_there_is_kept_as_a_whole_and_no_log_of_the_old_database_stays_beside_the_new_one(
    settings: Settings, database: Database, backup: Backup
) -> None:
    add_answer(database)
    with database.reading() as session:  # keeps the log from being put into the database, as a killed studio leaves it
        session.scalars(select(Study)).all()
        copy = settings.data_dir.with_name("killed")
        shutil.copytree(settings.data_dir, copy)
    killed = settings.model_copy(update={"data_dir": copy})
    assert (copy / "studio.sqlite3-wal").stat().st_size > 0
    (copy / "engine.sqlite3").write_bytes(b"of another time")
    done = restoring.restore(killed, backup.folder, replace=True)
    assert done.replaced is not None
    assert {path.name for path in copy.glob("*sqlite3*")} == {"studio.sqlite3"}
    assert backed_up.rows(database_in(copy)) == backed_up.rows(backup.folder / "studio.sqlite3")
    assert backed_up.rows(database_in(done.replaced)) == backed_up.rows(database_in(settings.data_dir))
    assert (done.replaced / "engine.sqlite3").exists()


def test_a_running_studio_is_not_restored_over_and_none_starts_while_one_is_restored(
    settings: Settings, database: Database, backup: Backup
) -> None:
    together = data_directory.shared(settings.data_dir), data_directory.shared(settings.data_dir)
    with together[0], together[1], pytest.raises(DirectoryInUse):
        restoring.restore(settings, backup.folder, replace=True)
    with TestClient(create_app(settings)), pytest.raises(DirectoryInUse):
        restoring.restore(settings, backup.folder, replace=True)
    alone, refused = data_directory.alone(settings.data_dir), pytest.raises(DirectoryBeingRestored)
    with alone, refused, TestClient(create_app(settings)):
        pass


def test_a_restore_that_is_killed_anywhere_leaves_the_old_studio_or_one_that_says_so(
    settings: Settings, database: Database, backup: Backup, tmp_path: Path
) -> None:
    add_answer(database)
    database.dispose()
    old, restored = (backed_up.rows(database_in(each)) for each in (settings.data_dir, backup.folder))
    pristine = tmp_path / "pristine"
    settings.data_dir.rename(pristine)
    (pristine / "upgrade.lock").unlink(missing_ok=True)

    def restore_and_die(number: int) -> None:
        with pytest.MonkeyPatch.context() as monkeypatch:
            die_at(number, monkeypatch)
            restoring.restore(settings, backup.folder, replace=True)

    steps = counted_steps(lambda: restoring.restore(settings, backup.folder, tmp_path / "undisturbed"))
    early, late = range(3, steps - 5, steps // 4), range(steps - 5, steps + 9)  # where files move, at every step
    unfinished = 0
    for number in (*early, *late):
        shutil.copytree(pristine, settings.data_dir)
        if in_a_process(partial(restore_and_die, number)) != 0:
            unfinished += 1
            kept = [settings.data_dir, *settings.data_dir.glob("replaced-*")]
            assert old in [backed_up.rows(database_in(each)) for each in kept if database_in(each).exists()]
            with pytest.raises(RestoreInterrupted, match="Repeat it with --replace"):
                upgrading.upgrade(settings)
            restoring.restore(settings, backup.folder, replace=True)
        assert backed_up.rows(database_in(settings.data_dir)) == restored
        upgrading.upgrade(settings)
        shutil.rmtree(settings.data_dir)
    assert len(early) < unfinished < len(early) + len(late), "killed up to the very end, and not after it"


def test_an_older_schema_is_upgraded_at_the_next_start_with_everything_in_it(
    settings: Settings, tmp_path: Path
) -> None:
    settings.data_dir.mkdir()
    command.upgrade(upgrading._config(settings), test_upgrading.OLDEST)
    test_upgrading.fill(database_in(settings.data_dir))
    backup = making.make(settings, tmp_path / "backups")
    assert backup.manifest.revision == test_upgrading.OLDEST
    there = settings.model_copy(update={"data_dir": tmp_path / "new"})
    restoring.restore(there, backup.folder)
    assert test_upgrading.revision(database_in(there.data_dir)) == test_upgrading.OLDEST
    upgrading.upgrade(there)
    with closing(sqlite3.connect(database_in(there.data_dir))) as connection:
        assert connection.execute("SELECT count(*) FROM label_event").fetchone() == (3,)
    assert test_upgrading.revision(database_in(there.data_dir)) == test_upgrading.newest(settings)


def test_somebody_who_has_withdrawn_since_is_not_brought_back_to_the_byte(
    settings: Settings, database: Database, store: ArtefactStore, people: list[Participant], backup: Backup, new: Path
) -> None:
    leaving, *staying = people
    with database.writing() as session:
        withdrawal.withdraw(session, store, session.get_one(Participant, leaving.id), "P01")
    done = restoring.restore(settings, backup.folder, new)
    assert done.erased_again == 1
    assert backed_up.traces(backup.folder, backed_up.mark_of(leaving)) != [], "the backup itself is as it was"
    assert backed_up.traces(new, backed_up.mark_of(leaving)) == []
    assert all(len(backed_up.traces(new, backed_up.mark_of(each))) == 2 for each in staying), "row and model"
    restored = Database(settings.model_copy(update={"data_dir": new}).sqlalchemy_url)
    with restored.reading() as session:
        assert session.get_one(Participant, leaving.id).withdrawn_at is not None
        assert chain_check.check(session).faults == []
    restored.dispose()
    assert {path.name for path in new.iterdir()} == {"studio.sqlite3", "artefacts", "studio.lock"}


def test_withdrawals_are_known_from_the_list_beside_the_backups_when_the_studio_is_lost(
    settings: Settings, database: Database, store: ArtefactStore, people: list[Participant], backup: Backup
) -> None:
    with database.writing() as session:
        withdrawal.withdraw(session, store, session.get_one(Participant, people[0].id), "P01")
    making.make(settings, backup.folder.parent)
    database.dispose()
    shutil.rmtree(settings.data_dir)
    assert restoring.restore(settings, backup.folder).erased_again == 1
    assert backed_up.traces(settings.data_dir, backed_up.mark_of(people[0])) == []


def test_a_study_that_was_deleted_since_is_not_brought_back(
    settings: Settings, database: Database, store: ArtefactStore, people: list[Participant], new: Path, tmp_path: Path
) -> None:
    with database.writing() as session:
        others = backed_up.fill(session, store, "Another study")
    backup = making.make(settings, tmp_path / "backups")
    with database.writing() as session:
        study = session.get_one(Study, people[0].study_id)
        retirement.delete(session, store, study, study.slug, "x")
    assert restoring.restore(settings, backup.folder, new).erased_again == 1 + len(people)
    assert not any(backed_up.traces(new, backed_up.mark_of(each)) for each in people)
    assert all(backed_up.traces(new, backed_up.mark_of(each)) for each in others)
    restored = Database(settings.model_copy(update={"data_dir": new}).sqlalchemy_url)
    with restored.reading() as session:
        assert chain_check.check(session).faults == []
    restored.dispose()


def test_the_withdrawal_of_somebody_else_with_the_same_row_id_erases_nobody(
    settings: Settings, database: Database, backup: Backup, new: Path
) -> None:
    withdrawals.note(backup.folder.parent, {"participant/1/99/2020-01-01 00:00:00.000000"})
    assert restoring.restore(settings, backup.folder, new).erased_again == 0
    assert backed_up.rows(database_in(new)) == backed_up.rows(database_in(settings.data_dir))


def test_a_database_outside_the_data_directory_is_not_restored_over_by_mistake(
    settings: Settings, backup: Backup, tmp_path: Path, new: Path
) -> None:
    elsewhere = settings.model_copy(update={"data_dir": new, "database_url": f"sqlite:///{tmp_path / 'other.sqlite3'}"})
    with pytest.raises(RestoreFailed, match="--into"):
        restoring.restore(elsewhere, backup.folder)
    assert not new.exists()


def test_files_are_for_their_owner_alone_whatever_the_account_is_used_to(
    settings: Settings, backup: Backup, new: Path
) -> None:
    before = os.umask(0o022)
    try:
        restoring.restore(settings, backup.folder, new)
    finally:
        os.umask(before)
    assert {path.stat().st_mode & 0o077 for path in new.rglob("*") if path.name != data_directory.LOCK} == {0}
    assert layout.folders_in(new) == []
