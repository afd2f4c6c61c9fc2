"""What the worker does when somebody withdraws while it works for them, with the real engine and its real files."""

import base64
import hashlib
import threading
from collections.abc import Iterator

import pytest
from dbos import DBOS, SetWorkflowID

from app.db import Database, now
from app.domain.models import ModelKind, RunKind
from app.domain.studies import Participant, Study
from app.services.auditing import chain_check, receipts
from app.services.participants import withdrawal
from app.services.studies import retirement
from app.settings import Settings
from app.storage import ArtefactStore
from tests import databases
from tests.waiting import PATIENCE_S, until
from tests.worker.conftest import the_job_runner
from tests.worker.invented import job_of
from worker.compute.pools import Compute
from worker.jobs import workflows
from worker.jobs.reconcile import due, short_of_queries
from worker.jobs.runtime import engine, records
from worker.jobs.runtime.context import Step, WorkerContext
from worker.jobs.runtime.records import Job, as_arguments
from worker.jobs.upkeep import erasure
from worker.jobs.workflows import JobRunner

MARK = b"erase-me"


class Work:
    """Work for one person that stores a draft, waits to be told to go on, and stores its result."""

    def __init__(self) -> None:
        self.waits, self.may_go_on = threading.Event(), threading.Event()

    def __call__(self, context: WorkerContext, job: Job, run_id: int, step: Step) -> None:
        step("draft", self.draft, context)
        step("save", self.save, context, run_id)

    def draft(self, context: WorkerContext) -> str:
        return context.store.put(MARK + b"draft")

    def save(self, context: WorkerContext, run_id: int) -> None:
        self.waits.set()
        assert self.may_go_on.wait(PATIENCE_S)
        artefact = context.store.put(MARK + b"late model")
        with context.database.writing() as session:
            records.set_labels(session, run_id, 10, "h" * 64)
            records.save_model(session, run_id, ModelKind.FILTER, artefact, {"mark": MARK.decode()})


@pytest.fixture
def work(monkeypatch: pytest.MonkeyPatch) -> Work:
    work = Work()
    monkeypatch.setitem(workflows.BODIES, RunKind.FILTER, work)
    return work


@pytest.fixture
def runner(settings: Settings, database: Database, store: ArtefactStore) -> Iterator[JobRunner]:
    """A worker's engine on the data directory."""
    runner, compute = the_job_runner(), Compute(1)
    runner.context = WorkerContext(database, store, compute)
    engine.launch(settings)
    yield runner
    DBOS.destroy(destroy_registry=False)
    compute.close()


@pytest.fixture
def job(participant: Participant) -> Job:
    return job_of(f"filter/participant-{participant.id}/{MARK.decode()}/labels-10", 1)


def start(runner: JobRunner, job: Job) -> None:
    with SetWorkflowID(f"{job.key}#1"):
        DBOS.enqueue_workflow(RunKind.FILTER, runner.work, as_arguments(job))


def withdraw(database: Database, store: ArtefactStore, participant_id: int) -> None:
    with database.writing() as session:
        withdrawal.withdraw(session, store, session.get_one(Participant, participant_id), actor="P01")


def has_ended() -> bool:
    """Whether the engine has taken up all work, and is done with it."""
    return not DBOS.list_workflows(status=["ENQUEUED", "PENDING"])


def erase(runner: JobRunner, settings: Settings, participant_id: int) -> bool:
    context, file = runner.context, engine.file_of(settings)
    return erasure.erase_traces(context, participant_id, runner.in_hand, runner.stored, file).finished


def traces(settings: Settings) -> list[str]:
    """Files, and tables on a server, that hold the mark, as it is or as the engine writes it."""
    written = [MARK, *(base64.b64encode(b"x" * offset + MARK)[4:-4] for offset in range(3))]
    files = [
        str(path.relative_to(settings.data_dir))
        for path in sorted(settings.data_dir.rglob("*"))
        if path.is_file() and any(each in path.read_bytes() for each in written)
    ]
    return files + databases.tables_with(written, settings.sqlalchemy_url)


def test_work_under_way_is_abandoned_and_neither_draft_nor_late_result_nor_note_is_left(
    runner: JobRunner, work: Work, job: Job, participant: Participant, settings: Settings
) -> None:
    context = runner.context
    start(runner, job)
    assert work.waits.wait(PATIENCE_S)
    assert any(name.startswith(("engine", "dbos")) for name in traces(settings)), "the engine keeps inputs"
    withdraw(context.database, context.store, participant.id)
    assert not erase(runner, settings, participant.id), "it is still being worked on"
    with context.database.reading() as session:
        assert erasure.unfinished(session) == [participant.id]
    work.may_go_on.set()
    erased = until(lambda: erase(runner, settings, participant.id))
    assert erased, (runner.in_hand, [(each.workflow_id, each.status) for each in DBOS.list_workflows()])
    assert traces(settings) == []
    assert DBOS.list_workflows() == []
    with context.database.reading() as session:
        assert erasure.unfinished(session) == []
        assert session.get_one(Participant, participant.id).erased_at is not None
        (erasure_of_them,) = receipts.erasures(session)
        late = [step.contents for step in erasure_of_them.steps if step.contents["step"] == receipts.LATE_RESULTS]
        assert erasure_of_them.is_complete
        assert [(each["rows"], each["files"]) for each in late] == [({"notes of the engine": 1}, 2)], (
            "the draft and the result"
        )
        assert chain_check.check(session).faults == []


def test_drafts_of_work_under_way_are_known_as_long_as_it_is_under_way(
    runner: JobRunner, work: Work, job: Job, participant: Participant
) -> None:
    start(runner, job)
    assert work.waits.wait(PATIENCE_S)
    assert until(lambda: erasure.drafts() == {hashlib.sha256(MARK + b"draft").hexdigest()})
    work.may_go_on.set()
    assert until(lambda: erasure.drafts() == set())


def test_finished_work_is_forgotten_and_its_drafts_are_erased(
    runner: JobRunner, work: Work, job: Job, participant: Participant, settings: Settings
) -> None:
    context = runner.context
    work.may_go_on.set()
    start(runner, job)
    assert until(lambda: [each.status for each in DBOS.list_workflows()] == ["SUCCESS"])
    withdraw(context.database, context.store, participant.id)
    assert traces(settings) != [], "the draft is known to the engine alone"
    assert until(lambda: erase(runner, settings, participant.id))
    assert traces(settings) == []


@pytest.mark.sqlite("about copies of its files")
def test_copies_made_before_upgrades_and_engine_s_files_that_were_set_aside_go_as_well(
    runner: JobRunner, participant: Participant, settings: Settings
) -> None:
    context = runner.context
    for name in ("studio.sqlite3.before-0002-20260101T000000", "studio.sqlite3.copying"):
        (settings.data_dir / name).write_bytes(MARK)
    for name in ("engine.sqlite3.set-aside-20260101T000000", "engine.sqlite3-journal.set-aside-20260101T000000"):
        (settings.data_dir / name).write_bytes(MARK)
    assert len(traces(settings)) == 4
    withdraw(context.database, context.store, participant.id)
    assert until(lambda: erase(runner, settings, participant.id))
    assert traces(settings) == []


def test_work_that_begins_after_the_withdrawal_does_nothing(
    runner: JobRunner, work: Work, job: Job, participant: Participant, settings: Settings
) -> None:
    context = runner.context
    withdraw(context.database, context.store, participant.id)
    start(runner, job)
    assert until(has_ended)
    assert until(lambda: erase(runner, settings, participant.id))
    assert not work.waits.is_set()
    assert traces(settings) == []


def test_what_the_engine_keeps_of_work_that_begins_after_the_last_traces_are_erased_goes_as_well(
    runner: JobRunner, work: Work, job: Job, participant: Participant, settings: Settings
) -> None:
    context = runner.context
    withdraw(context.database, context.store, participant.id)
    assert until(lambda: erase(runner, settings, participant.id))
    start(runner, job)
    assert until(has_ended)
    with context.database.reading() as session:
        assert erasure.unfinished(session) == [participant.id]
    assert until(lambda: erase(runner, settings, participant.id))
    assert not work.waits.is_set()
    assert traces(settings) == []


def test_what_the_worker_keeps_of_others_stays(
    runner: JobRunner, work: Work, job: Job, participant: Participant, settings: Settings
) -> None:
    context = runner.context
    with context.database.writing() as session:
        other = Participant(study_id=participant.study_id, number=99, token_sha256="o" * 64, seed=1)
        session.add(other)
    work.may_go_on.set()
    start(runner, job_of(f"filter/participant-{other.id}/labels-10", participant.study_id))
    assert until(lambda: [each.status for each in DBOS.list_workflows()] == ["SUCCESS"])
    withdraw(context.database, context.store, participant.id)
    assert until(lambda: erase(runner, settings, participant.id))
    assert [each.workflow_id for each in DBOS.list_workflows()] == [f"filter/participant-{other.id}/labels-10#1"]
    files = [name for name in traces(settings) if name.startswith("artefacts")]
    assert len(files) == 2, "the other's draft and model"
    assert len(traces(settings)) > 2, "and their row"


def test_of_a_deleted_study_neither_drafts_nor_late_results_nor_notes_are_left_and_others_keep_theirs(
    runner: JobRunner, work: Work, job: Job, participant: Participant, settings: Settings
) -> None:
    context, file = runner.context, engine.file_of(settings)
    start(runner, job)
    assert work.waits.wait(PATIENCE_S)
    with context.database.writing() as session:
        study = session.get_one(Study, participant.study_id)
        retirement.delete(session, context.store, study, study.slug, "x")
        other = Study(slug="other", name="Other", stored_settings=study.stored_settings, seed=4)
        session.add(other)

    def erase_study() -> bool:
        return erasure.erase_traces_of_study(context, 1, runner.in_hand, runner.stored, file).finished

    with context.database.reading() as session:
        assert (erasure.unfinished_studies(session), erasure.unfinished(session)) == ([1], [])
    assert not erase_study(), "it is still being worked on"
    work.may_go_on.set()
    assert until(erase_study)
    assert traces(settings) == []
    assert DBOS.list_workflows() == []
    with context.database.reading() as session:
        assert erasure.unfinished_studies(session) == []
        assert session.get_one(Participant, participant.id).erased_at is not None
        assert session.get_one(Study, other.id).name == "Other"


def test_work_for_a_deleted_study_does_nothing(
    runner: JobRunner, work: Work, participant: Participant, settings: Settings
) -> None:
    context = runner.context
    with context.database.writing() as session:
        session.get_one(Study, participant.study_id).deleted_at = now()
    start(runner, job_of(f"filter/study-{participant.study_id}", participant.study_id))
    assert until(lambda: [each.status for each in DBOS.list_workflows()] == ["SUCCESS"])
    assert not work.waits.is_set()


def test_nothing_is_due_for_somebody_who_has_withdrawn(
    database: Database, store: ArtefactStore, participant: Participant
) -> None:
    withdraw(database, store, participant.id)
    with database.reading() as session:
        assert participant.id not in short_of_queries(session)
        assert participant.id not in {job.participant_id for job, _ in due(session)}
