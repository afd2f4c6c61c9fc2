"""Backups that the worker makes: when they are due, one at a time, and nobody in them who has withdrawn."""

import threading
from datetime import timedelta
from pathlib import Path

import pytest
from dbos import DBOS

from app.db import Database, now
from app.domain.studies import Participant
from app.services.backups import layout, making, restoring, schedule, withdrawals
from app.services.participants import withdrawal
from app.settings import Settings
from app.storage import ArtefactStore
from tests import backed_up
from tests.waiting import until
from tests.worker.conftest import the_job_runner
from worker.compute.pools import Compute
from worker.jobs import reconcile, service
from worker.jobs.runtime import engine
from worker.jobs.runtime.context import WorkerContext
from worker.jobs.upkeep import backups


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    return Settings(
        _env_file=None, data_dir=tmp_path / "data", database_url=None, backup_dir=tmp_path / "backups", backups_kept=2
    )


@pytest.fixture
def directory(settings: Settings) -> Path:
    assert settings.backup_dir is not None
    return settings.backup_dir


@pytest.fixture
def people(database: Database, store: ArtefactStore) -> list[Participant]:
    with database.writing() as session:
        return backed_up.fill(session, store)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[timedelta]:
    """What is added here has gone by."""
    gone_by: list[timedelta] = []
    for module in (schedule, making):
        monkeypatch.setattr(module, "now", lambda: now() + sum(gone_by, timedelta()))
    return gone_by


def erase(database: Database, store: ArtefactStore, participant_id: int) -> None:
    """Everything about somebody, as web and worker do it between them."""
    with database.writing() as session:
        participant = session.get_one(Participant, participant_id)
        withdrawal.withdraw(session, store, participant, "P01")
        participant.erased_at = now()


def test_a_backup_is_made_when_one_is_due_and_the_newest_ones_are_kept(
    settings: Settings, database: Database, people: list[Participant], directory: Path, clock: list[timedelta]
) -> None:
    schedule.tend(settings, directory)
    schedule.tend(settings, directory)
    (first,) = layout.folders_in(directory)
    for _ in range(3):
        clock.append(timedelta(hours=23))
        schedule.tend(settings, directory)
        before = layout.folders_in(directory)
        clock.append(timedelta(hours=1, minutes=1))
        schedule.tend(settings, directory)
        assert layout.folders_in(directory)[:-1] == before[-1:]
    kept = layout.folders_in(directory)
    assert len(kept) == settings.backups_kept
    assert first not in kept
    for folder in kept:
        restoring.verify(settings, folder)


def test_nothing_is_made_while_another_backup_is_made(
    settings: Settings, database: Database, people: list[Participant], directory: Path
) -> None:
    with making.only_one(directory):
        schedule.tend(settings, directory)
    assert layout.folders_in(directory) == []
    assert schedule.standing(settings.data_dir) is None, "and that is no failure"


def test_a_failure_is_told_and_tried_again_after_a_while(
    settings: Settings, database: Database, people: list[Participant], directory: Path, clock: list[timedelta]
) -> None:
    directory.write_text("in the way")
    schedule.tend(settings, directory)
    standing = schedule.standing(settings.data_dir)
    assert standing is not None
    assert standing.failed_at is not None
    assert "File exists" in standing.words
    directory.unlink()
    schedule.tend(settings, directory)
    assert not directory.exists(), "not at once"
    clock.append(schedule.RETRY_AFTER)
    schedule.tend(settings, directory)
    standing = schedule.standing(settings.data_dir)
    assert standing is not None
    assert (standing.failed_at, standing.made_at is None) == (None, False)
    clock.append(timedelta(hours=49))
    assert standing.late


def test_backups_that_hold_somebody_who_has_withdrawn_are_replaced_and_no_byte_is_left(
    settings: Settings, database: Database, store: ArtefactStore, people: list[Participant], directory: Path
) -> None:
    leaving, *staying = people
    making.make(settings, directory)
    making.make(settings, directory)
    schedule.tend(settings, directory)
    assert len(layout.folders_in(directory)) == 2, "nothing was due"
    erase(database, store, leaving.id)
    schedule.tend(settings, directory)
    (newest,) = layout.folders_in(directory)
    assert backed_up.traces(directory, backed_up.mark_of(leaving)) == []
    assert all(backed_up.traces(directory, backed_up.mark_of(each)) for each in staying)
    restoring.verify(settings, newest)
    assert len(withdrawals.noted(directory)) == 1
    schedule.tend(settings, directory)
    assert layout.folders_in(directory) == [newest]


def test_a_backup_in_which_nobody_has_withdrawn_stays(
    settings: Settings, database: Database, store: ArtefactStore, people: list[Participant], directory: Path
) -> None:
    before = making.make(settings, directory)
    with database.writing() as session:
        later = backed_up.fill(session, store, "Begun later")
    with_all = making.make(settings, directory)
    erase(database, store, later[0].id)
    schedule.tend(settings, directory)
    kept = layout.folders_in(directory)
    assert before.folder in kept
    assert with_all.folder not in kept


def test_backups_go_even_if_no_new_one_can_be_made(
    settings: Settings,
    database: Database,
    store: ArtefactStore,
    people: list[Participant],
    directory: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    making.make(settings, directory)
    erase(database, store, people[0].id)
    monkeypatch.setattr(making, "SPARE_BYTES", 10**18)
    schedule.tend(settings, directory)
    assert layout.folders_in(directory) == []
    assert backed_up.traces(directory, backed_up.mark_of(people[0])) == []
    standing = schedule.standing(settings.data_dir)
    assert standing is not None
    assert "No space left on device" in standing.words


def test_a_backup_whose_manifest_is_damaged_may_hold_anybody(
    settings: Settings, database: Database, store: ArtefactStore, people: list[Participant], directory: Path
) -> None:
    damaged = making.make(settings, directory).folder
    (damaged / "manifest.json").write_text("{}")
    schedule.tend(settings, directory)
    assert damaged in layout.folders_in(directory)
    erase(database, store, people[0].id)
    schedule.tend(settings, directory)
    assert damaged not in layout.folders_in(directory)


def test_without_a_directory_there_is_no_schedule_and_nothing_to_tell(settings: Settings, database: Database) -> None:
    schedule.tend(settings, settings.data_dir)
    assert schedule.standing(settings.data_dir) is not None
    backups.Backups(settings.model_copy(update={"backup_dir": None})).look()
    assert schedule.standing(settings.data_dir) is None


def test_a_running_worker_erases_somebody_from_studio_and_backups(
    settings: Settings,
    database: Database,
    store: ArtefactStore,
    people: list[Participant],
    directory: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(backups, "LOOK_S", 0.2)
    monkeypatch.setattr(reconcile, "due", lambda _session, _lost: [])
    monkeypatch.setattr(reconcile, "short_of_queries", lambda _session: [])
    monkeypatch.setattr(reconcile, "studies_with_answers", lambda _session: [])
    replaced = settings.data_dir / "replaced-20260101T000000Z"
    replaced.mkdir()
    (replaced / "studio.sqlite3").write_text(backed_up.mark_of(people[0]))
    runner, compute, stop = the_job_runner(), Compute(1), threading.Event()
    runner.context = WorkerContext(database, store, compute)
    with engine.running(settings, database) as bond:
        rounds = threading.Thread(target=service._Rounds(settings, runner, bond).until, args=(stop,))
        rounds.start()
        try:
            assert until(lambda: len(layout.folders_in(directory)) == 1)
            (first,) = layout.folders_in(directory)
            with database.writing() as session:
                withdrawal.withdraw(session, store, session.get_one(Participant, people[0].id), "P01")
            assert until(lambda: not first.exists() and not list(directory.glob(".making-*")))
        finally:
            stop.set()
            rounds.join()
            compute.close()
            DBOS.destroy(destroy_registry=False)
    (newest,) = layout.folders_in(directory)
    restoring.verify(settings, newest)
    assert backed_up.traces(settings.data_dir.parent, backed_up.mark_of(people[0])) == []
