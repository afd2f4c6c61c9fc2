"""The engine's file is lost, damaged or of another time than the database: work goes on, nothing by halves."""

import errno
import fcntl
import os
import shutil
import sqlite3
import threading
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest
from dbos import DBOS, SetWorkflowID
from sqlalchemy import select, text

from app.db import Database, now
from app.domain.models import Run, RunKind, RunStatus, WorkerPresence
from app.domain.studies import Participant
from app.settings import Settings
from app.storage import ArtefactStore
from tests.waiting import PATIENCE_S, until
from tests.worker.conftest import the_job_runner
from tests.worker.invented import job_of
from worker.compute.pools import Compute
from worker.jobs import reconcile, service, workflows
from worker.jobs.runtime import engine, records
from worker.jobs.runtime.context import Step, WorkerContext
from worker.jobs.runtime.records import Job, as_arguments, from_arguments
from worker.jobs.workflows import JobRunner

pytestmark = [pytest.mark.slow, pytest.mark.sqlite("about the engine's own file")]

Damage = Callable[[Path], None]


class Work:
    """Work in two durable steps that counts how often each is done; the second may be told to wait or to fail."""

    def __init__(self) -> None:
        self.prepared: list[str] = []
        self.finished: list[str] = []
        self.waits, self.may_finish = threading.Event(), threading.Event()
        self.may_finish.set()
        self.fails: list[Exception] = []

    def __call__(self, context: WorkerContext, job: Job, run_id: int, step: Step) -> None:
        step("prepare", self.prepared.append, job.key)
        step("save", self._save, job)

    def _save(self, job: Job) -> None:
        self.waits.set()
        assert self.may_finish.wait(PATIENCE_S)
        if self.fails:
            raise self.fails.pop(0)
        self.finished.append(job.key)


@pytest.fixture
def work(monkeypatch: pytest.MonkeyPatch) -> Work:
    work = Work()
    monkeypatch.setitem(workflows.BODIES, RunKind.FILTER, work)
    return work


@pytest.fixture
def job(participant: Participant) -> Job:
    return job_of(f"filter/participant-{participant.id}/labels-10", 1)


@pytest.fixture
def due(monkeypatch: pytest.MonkeyPatch, job: Job) -> Job:
    """The job is all that is ever missing, for as long as its run says so."""

    def found(session: object, _lost: object = None) -> Iterator[tuple[Job, int]]:
        run = session.scalar(select(Run).where(Run.workflow_id == job.key))  # type: ignore[attr-defined]
        seen = run and reconcile._Attempted(run.status, run.attempt, run.finished_at)
        attempt = reconcile._attempt_due(seen, now())
        if attempt is not None:
            yield job, attempt

    monkeypatch.setattr(reconcile, "due", found)
    monkeypatch.setattr(reconcile, "short_of_queries", lambda _session: [])
    monkeypatch.setattr(reconcile, "RETRY_AFTER", timedelta(seconds=0.2))
    monkeypatch.setattr(service, "LOOK_AGAIN_S", 0.2)
    monkeypatch.setattr(service, "REST", 0.0)
    monkeypatch.setattr(engine, "POLL_S", 0.1)
    return job


@contextmanager
def worker(settings: Settings, database: Database, store: ArtefactStore) -> Iterator[JobRunner]:
    """The worker's life in this process, from launching the engine to a stop."""
    runner, compute, stop = the_job_runner(), Compute(1), threading.Event()
    runner.context = WorkerContext(database, store, compute)
    with engine.running(settings, database) as bond:
        rounds = service._Rounds(settings, runner, bond)
        thread = threading.Thread(target=rounds.until, args=(stop,))
        thread.start()
        try:
            yield runner
        finally:
            stop.set()
            thread.join()
            compute.close()
            DBOS.destroy()


def status_of(database: Database, job: Job) -> str | None:
    with database.reading() as session:
        return session.scalar(select(Run.status).where(Run.workflow_id == job.key))


def lived(settings: Settings, database: Database, store: ArtefactStore) -> Path:
    """A worker has been there before, when nothing was due; where its engine's file is."""
    with pytest.MonkeyPatch.context() as before:
        before.setattr(reconcile, "due", lambda *_: iter(()))
        with worker(settings, database, store):
            assert until(lambda: last_seen(database) is not None)
    path = engine.file_of(settings)
    assert path is not None
    return path


def last_seen(database: Database) -> object:
    with database.reading() as session:
        return session.scalar(select(WorkerPresence.last_seen_at))


def left_behind(database: Database, job: Job) -> None:
    """A run that says somebody works on it, and nobody does."""
    with database.writing() as session:
        run = session.get_one(Run, records.begin_run(session, job, seed=1))
        run.heartbeat_at = now() - timedelta(minutes=5)


def removed(path: Path) -> None:
    path.unlink()


def removed_but_for_its_journal(path: Path) -> None:
    path.with_name(path.name + "-journal").write_bytes(path.read_bytes()[:3000])
    path.with_name(path.name + "-wal").write_bytes(os.urandom(5000))
    path.unlink()


def cut_in_half(path: Path) -> None:
    os.truncate(path, path.stat().st_size // 2)


def emptied(path: Path) -> None:
    os.truncate(path, 0)


def overwritten(path: Path) -> None:
    path.write_bytes(os.urandom(path.stat().st_size))


def overwritten_in_the_middle(path: Path) -> None:
    """With the first page intact it can still be opened."""
    size = path.stat().st_size
    with path.open("r+b") as stream:
        stream.seek(8192)
        stream.write(os.urandom(size - 8192))


def overwritten_with_its_companions(path: Path) -> None:
    for ending in ("", "-journal", "-wal", "-shm"):
        path.with_name(path.name + ending).write_bytes(os.urandom(20_000))


def another_program_s(path: Path) -> None:
    path.unlink()
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("CREATE TABLE cats (name TEXT)")


def without_its_tables(path: Path) -> None:
    """Sound as a file, and of no use: what a killed upgrade of the engine may leave."""
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("DROP TABLE operation_outputs")
        connection.execute("DROP TABLE workflow_status")
        connection.commit()


def replaced_by_an_older_one(path: Path) -> None:
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("UPDATE studio_bond SET promised = '2026-01-01'")
        connection.commit()


def a_folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


DAMAGES = [
    removed,
    removed_but_for_its_journal,
    cut_in_half,
    emptied,
    overwritten,
    overwritten_in_the_middle,
    overwritten_with_its_companions,
    another_program_s,
    without_its_tables,
    a_folder,
]


@pytest.mark.parametrize("damage", DAMAGES, ids=lambda damage: damage.__name__)
def test_work_goes_on_whatever_has_happened_to_the_engine_s_file(
    damage: Damage, settings: Settings, database: Database, store: ArtefactStore, work: Work, due: Job
) -> None:
    path = lived(settings, database, store)
    left_behind(database, due)
    damaged = path.parent / "copy"
    damage(path)
    if path.is_file():
        shutil.copy(path, damaged)
    with worker(settings, database, store):
        assert until(lambda: status_of(database, due) == RunStatus.SUCCEEDED)
    assert work.finished == [due.key]
    if damaged.exists():
        kept = [aside.read_bytes() for aside in path.parent.glob("engine.sqlite3.set-aside-*")]
        assert kept == [damaged.read_bytes()], "what could not be used is kept"


def test_a_file_that_is_as_it_was_left_is_used_again(
    settings: Settings, database: Database, store: ArtefactStore, work: Work, due: Job
) -> None:
    path = lived(settings, database, store)
    lived(settings, database, store)
    assert list(path.parent.glob("*set-aside*")) == []


def test_a_database_older_than_the_engine_s_file_gets_its_work_done_again(
    settings: Settings, database: Database, store: ArtefactStore, work: Work, due: Job, tmp_path: Path
) -> None:
    with closing(sqlite3.connect(settings.data_dir / "studio.sqlite3")) as connection:
        connection.execute(f"VACUUM INTO '{tmp_path / 'backup'}'")
    with worker(settings, database, store):
        assert until(lambda: status_of(database, due) == RunStatus.SUCCEEDED)
    database.dispose()
    for ending in ("-wal", "-shm"):
        (settings.data_dir / f"studio.sqlite3{ending}").unlink(missing_ok=True)
    shutil.copy(tmp_path / "backup", settings.data_dir / "studio.sqlite3")
    with worker(settings, database, store):
        assert until(lambda: status_of(database, due) == RunStatus.SUCCEEDED)
    assert work.prepared == work.finished == [due.key] * 2


def test_an_engine_s_file_older_than_the_database_does_nothing_twice(
    settings: Settings, database: Database, store: ArtefactStore, work: Work, due: Job, tmp_path: Path
) -> None:
    path = engine.file_of(settings)
    assert path is not None
    work.may_finish.clear()
    with worker(settings, database, store):
        assert work.waits.wait(PATIENCE_S)
        shutil.copy(path, tmp_path / "older")  # it believes that the work is under way
        work.may_finish.set()
        assert until(lambda: status_of(database, due) == RunStatus.SUCCEEDED)
        seen = last_seen(database)
        assert until(lambda: last_seen(database) != seen)
    shutil.copy(tmp_path / "older", path)
    with worker(settings, database, store):
        seen = last_seen(database)
        assert until(lambda: last_seen(database) != seen)
    assert work.finished == [due.key]
    assert len(list(path.parent.glob("engine.sqlite3.set-aside-*"))) == 1


def test_work_that_the_engine_takes_for_done_is_done_when_the_database_does_not_know_of_it(
    settings: Settings, database: Database, store: ArtefactStore, work: Work, due: Job
) -> None:
    with worker(settings, database, store):
        assert until(lambda: status_of(database, due) == RunStatus.SUCCEEDED)
        with database.writing() as session:
            session.delete(session.scalars(select(Run).where(Run.workflow_id == due.key)).one())
        assert until(lambda: work.finished == [due.key] * 2)


def test_work_that_fills_the_disk_is_tried_until_there_is_space(
    settings: Settings, database: Database, store: ArtefactStore, work: Work, due: Job
) -> None:
    full = OSError(errno.ENOSPC, "No space left on device")
    work.fails = [full] * (2 * records.ATTEMPTS)
    with worker(settings, database, store):
        assert until(lambda: work.finished == [due.key])
        assert until(lambda: status_of(database, due) == RunStatus.SUCCEEDED)
    with database.reading() as session:
        assert session.scalars(select(Run.attempt).where(Run.workflow_id == due.key)).one() == 1


def test_a_sign_of_life_that_cannot_be_written_does_not_end_the_work(
    database: Database, store: ArtefactStore, job: Job
) -> None:
    with database.writing() as session:
        run_id = records.begin_run(session, job, seed=1)
    with database.writing() as session:
        session.execute(text("DROP TABLE run"))
    WorkerContext(database, store, Compute(1)).beat(run_id)()


def test_work_in_the_middle_of_which_the_worker_falls_again_and_again_counts_as_a_failed_attempt(
    settings: Settings, database: Database, store: ArtefactStore, work: Work, due: Job
) -> None:
    path = lived(settings, database, store)
    engine.launch(settings)
    with SetWorkflowID(f"{due.key}#1"):
        DBOS.enqueue_workflow("a queue of nobody", the_job_runner().work, as_arguments(due))
    DBOS.destroy()
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("UPDATE workflow_status SET status = 'MAX_RECOVERY_ATTEMPTS_EXCEEDED'")
        connection.commit()
    left_behind(database, due)
    with worker(settings, database, store):
        assert until(lambda: status_of(database, due) == RunStatus.SUCCEEDED)
    with database.reading() as session:
        assert session.scalars(select(Run.attempt)).one() == 2


@pytest.mark.parametrize("status", ["ENQUEUED", "PENDING"])
def test_what_the_previous_version_left_half_done_is_found_again_and_done(
    settings: Settings, database: Database, store: ArtefactStore, work: Work, due: Job, status: str
) -> None:
    """Its workflows had another class, another version, and jobs of another form."""
    path = lived(settings, database, store)
    engine.launch(settings)
    with SetWorkflowID(f"{due.key}#1"):
        DBOS.enqueue_workflow("a queue of nobody", the_job_runner().work, as_arguments(due))
    DBOS.destroy()
    with closing(sqlite3.connect(path)) as connection:
        connection.execute(
            "UPDATE workflow_status SET status = ?, application_version = ?, class_name = ?, name = ?, config_name = ?",
            (status, "3", "Workshop", "Workshop.work", "workshop"),
        )
        connection.commit()
    left_behind(database, due)
    with worker(settings, database, store):
        assert until(lambda: status_of(database, due) == RunStatus.SUCCEEDED)
    assert work.finished == [due.key]


@pytest.mark.parametrize(
    "arguments",
    [
        {"key": "filter/participant-1/labels-10", "study_id": 1},
        {
            "finding": "filter/participant-1/labels-10",
            "kind": "filter",
            "study_id": 1,
            "participant_id": 1,
            "label_count": 10,
            "label_hash": None,
        },
    ],
)
def test_a_job_is_read_as_this_version_and_the_previous_one_have_stored_it(arguments: dict[str, Any]) -> None:
    """Whoever withdraws is erased from the engine's notes too, whichever version wrote them."""
    job = from_arguments(arguments)
    assert (job.key, job.study_id, job.participant_id) == ("filter/participant-1/labels-10", 1, 1)


RUNNING_DAMAGES = [removed, overwritten, emptied, another_program_s, replaced_by_an_older_one]


@pytest.mark.parametrize("damage", RUNNING_DAMAGES, ids=lambda damage: damage.__name__)
def test_a_file_that_goes_while_the_worker_runs_is_noticed_at_the_next_sign_of_life(
    damage: Damage, settings: Settings, database: Database
) -> None:
    path = engine.file_of(settings)
    assert path is not None
    with engine.running(settings, database) as bond:
        DBOS.destroy()  # so that nothing writes to it but we
        assert bond.promise(now())
        damage(path)
        with pytest.raises(engine.EngineLost, match="starts again"):
            bond.promise(now())


def test_a_damaged_file_that_another_worker_uses_is_left_to_it(settings: Settings, database: Database) -> None:
    path = engine.file_of(settings)
    assert path is not None
    path.write_bytes(b"damaged" * 1000)
    with path.with_name("engine.lock").open("w") as other:
        fcntl.flock(other, fcntl.LOCK_SH)
        with pytest.raises(engine.EngineInUse, match="Stop all workers"), engine.running(settings, database):
            pytest.fail("it was started")
    assert path.read_bytes() == b"damaged" * 1000


def test_of_files_that_were_set_aside_the_newest_are_kept(settings: Settings, database: Database) -> None:
    path = engine.file_of(settings)
    assert path is not None
    for number in range(engine.KEPT + 2):
        path.write_bytes(b"%d" % number * 5000)
        engine._replace(path, "is damaged", alone=True)
    kept = [aside.read_bytes()[:1] for aside in sorted(path.parent.glob("engine.sqlite3.set-aside-*"))]
    assert kept == [b"2", b"3", b"4"]
