"""Workers on machines of their own: names, signs of life, and what is left when another one has erased somebody."""

import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from datetime import timedelta

import pytest
from dbos import DBOS, SetWorkflowID
from sqlalchemy import select, text

from app.db import Database, now
from app.domain.models import Run, RunKind, RunStatus
from app.domain.studies import Participant, Study
from app.files.interface import StorageUnavailable
from app.services.monitoring import health
from app.services.participants import withdrawal
from app.settings import Settings
from app.storage import ArtefactStore
from tests import databases, stored_files
from tests.waiting import PATIENCE_S, until
from tests.worker.conftest import the_job_runner
from tests.worker.invented import job_of
from worker.compute.pools import Compute
from worker.jobs import reconcile, service, workflows
from worker.jobs.runtime import engine, records
from worker.jobs.runtime.context import Step, WorkerContext
from worker.jobs.runtime.records import Job, as_arguments
from worker.jobs.workflows import JobRunner


@pytest.fixture
def job(participant: Participant) -> Job:
    return job_of(f"filter/participant-{participant.id}/labels-10", participant.study_id)


@pytest.fixture
def runner(settings: Settings, database: Database, store: ArtefactStore) -> Iterator[JobRunner]:
    runner, compute = the_job_runner(), Compute(1)
    runner.context = WorkerContext(database, store, compute)
    engine.launch(settings)
    yield runner
    DBOS.destroy(destroy_registry=False)
    compute.close()


def start(runner: JobRunner, job: Job) -> None:
    with SetWorkflowID(f"{job.key}#1"):
        DBOS.enqueue_workflow(RunKind.FILTER, runner.work, as_arguments(job))


def test_a_job_whose_files_cannot_be_reached_is_tried_again_for_as_long_as_it_takes(
    runner: JobRunner, job: Job, database: Database, monkeypatch: pytest.MonkeyPatch
) -> None:
    def unreachable(context: WorkerContext, job: Job, run_id: int, step: Step) -> None:
        raise StorageUnavailable

    def failed() -> Run | None:
        with database.reading() as session:
            return session.scalar(select(Run).where(Run.status == RunStatus.FAILED))

    monkeypatch.setitem(workflows.BODIES, RunKind.FILTER, unreachable)
    start(runner, job)
    assert until(lambda: failed() is not None)
    run = failed()
    assert run is not None
    assert run.attempt == 1, "as at the start: it was no fault of the work"
    assert "cannot be reached" in (run.error or "")


def test_what_was_made_for_somebody_whom_another_worker_has_erased_is_removed(
    runner: JobRunner, job: Job, database: Database, store: ArtefactStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    at_work, erased = threading.Event(), threading.Event()

    def late(context: WorkerContext, job: Job, run_id: int, step: Step) -> None:
        folder = context.store.unfinished.folder(job.participant) / "run-1"
        folder.mkdir(parents=True)
        (folder / "state.safetensors").write_bytes(b"half way")
        at_work.set()
        assert erased.wait(PATIENCE_S)
        context.store.put(b"a result that comes late")
        context.report(run_id, "nearly done", 0.9)

    monkeypatch.setitem(workflows.BODIES, RunKind.FILTER, late)
    start(runner, job)
    assert at_work.wait(PATIENCE_S)
    with database.writing() as session:  # as the other worker does, which has nothing of this in hand
        person = session.get_one(Participant, job.participant)
        withdrawal.withdraw(session, store, person, actor="P01")
        person.erased_at = now()
    erased.set()
    assert until(lambda: not runner.in_hand)
    assert len(stored_files.names(store)) == 1
    runner.leave_nothing_of_erased()
    assert stored_files.names(store) == set()
    assert not store.unfinished.folder(job.participant).exists()


def test_work_may_begin_while_it_is_looked_for_what_is_left(runner: JobRunner, monkeypatch: pytest.MonkeyPatch) -> None:
    class Beginning(set[str]):
        def __contains__(self, key: object) -> bool:
            runner.stored.setdefault("filter/participant-9/labels-10", set())
            return True

    monkeypatch.setattr(runner, "in_hand", Beginning())
    monkeypatch.setattr(runner, "stored", {"filter/participant-8/labels-10": set()})
    runner.leave_nothing_of_erased()
    assert len(runner.stored) == 2


def test_a_sign_of_life_is_given_for_everything_in_hand(database: Database, job: Job, study: Study) -> None:
    """Whatever a step does, writing a large file for instance, nobody else takes it over meanwhile."""
    with database.writing() as session:
        run_id = records.begin_run(session, job, seed=1)
        session.get_one(Run, run_id).heartbeat_at = now() - timedelta(minutes=5)
    with database.reading() as session:
        assert [each.key for each, _ in reconcile.abandoned(session, ())] == [job.key]
    with database.writing() as session:
        records.beat_all(session, [job.key])
    with database.reading() as session:
        assert reconcile.abandoned(session, ()) == []


@pytest.mark.skipif(databases.SERVER is None, reason="with SQLite files do that")
def test_workers_without_a_name_take_the_first_that_is_free(database: Database, settings: Settings) -> None:
    with ExitStack() as second:
        with ExitStack() as first:
            names = [service._named(settings, database, stack).worker_name for stack in (first, second)]
            assert names == ["worker-1", "worker-2"]
            named = settings.model_copy()
            named.__pydantic_fields_set__.add("worker_name")
            with pytest.raises(service.WorkerAlreadyRunning):
                service._named(named, database, first)
        with ExitStack() as third:
            assert service._named(settings, database, third).worker_name == "worker-1", "it is free again"


class TestAnotherVersion:
    """Its code would compute by other rules, and write rows that this one does not know."""

    @pytest.fixture
    def upgraded(self, database: Database) -> Callable[[], None]:
        def upgrade() -> None:
            with database.writing() as session:
                session.execute(text("UPDATE alembic_version SET version_num = 'newer'"))

        return upgrade

    def test_a_worker_does_not_begin_on_another_schema(self, settings: Settings, upgraded: Callable[[], None]) -> None:
        upgraded()
        with pytest.raises(health.OtherSchema, match="same version on every machine"):
            service.run(settings)

    def test_an_upgrade_ends_the_workers_of_before(
        self, runner: JobRunner, settings: Settings, upgraded: Callable[[], None], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(service, "PRESENCE_S", 0.0)
        rounds = service._Rounds(settings, runner, engine.Bond(None, settings.worker_name, None))
        rounds._sign()
        upgraded()
        with pytest.raises(health.OtherSchema):
            rounds.until(threading.Event())
