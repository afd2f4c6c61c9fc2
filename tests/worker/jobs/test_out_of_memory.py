"""A training that needs more memory than there is: it is given up with words, and its neighbours' work goes on."""

import mmap
import resource
from collections.abc import Iterator

import pytest
import torch
from dbos import DBOS, SetWorkflowID
from sqlalchemy import select

from app.db import Database
from app.domain.models import Run, RunKind, RunStatus
from app.domain.studies import Participant
from app.settings import Settings
from app.storage import ArtefactStore
from tests.waiting import until
from tests.worker.conftest import the_job_runner
from tests.worker.invented import job_of
from worker.compute.pools import Compute, Lane
from worker.jobs import workflows
from worker.jobs.runtime import engine
from worker.jobs.runtime.context import Step, WorkerContext
from worker.jobs.runtime.records import Job, as_arguments
from worker.jobs.workflows import JobRunner

GIGABYTE = 2**30


def limit_memory() -> None:
    """This process may have a gigabyte more than it has."""
    with open("/proc/self/statm") as stream:  # noqa: PTH123
        present = int(stream.read().split()[0]) * mmap.PAGESIZE
    resource.setrlimit(resource.RLIMIT_AS, (present + GIGABYTE, resource.RLIM_INFINITY))


def train_too_large(kind: str) -> None:
    """What a fit does when its data are too many, in plain Python or in the learning library."""
    limit_memory()
    if kind == "python":
        bytearray(4 * GIGABYTE)
    else:
        torch.zeros(GIGABYTE)


def train() -> int:
    """A fit that has room."""
    return int(torch.zeros(1000).sum())


@pytest.fixture
def runner(settings: Settings, database: Database, store: ArtefactStore) -> Iterator[JobRunner]:
    runner, compute = the_job_runner(), Compute(1)
    runner.context = WorkerContext(database, store, compute)
    engine.launch(settings)
    yield runner
    DBOS.destroy(destroy_registry=False)
    compute.close()


@pytest.mark.parametrize("kind", ["python", "torch"])
def test_a_training_without_enough_memory_fails_with_advice_and_its_neighbour_succeeds(
    runner: JobRunner, database: Database, participant: Participant, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    def work(context: WorkerContext, job: Job, run_id: int, step: Step) -> None:
        too_large = job.about.labels == 10
        arguments = (train_too_large, kind) if too_large else (train,)
        context.compute.run(Lane.REWARDS, context.beat(run_id), *arguments)

    def statuses() -> dict[str, str]:
        with database.reading() as session:
            return dict(session.execute(select(Run.workflow_id, Run.status)).all())

    monkeypatch.setitem(workflows.BODIES, RunKind.FILTER, work)
    jobs = [job_of(f"filter/participant-{participant.id}/labels-{count}", participant.study_id) for count in (10, 20)]
    for job in jobs:
        with SetWorkflowID(f"{job.key}#1"):
            DBOS.enqueue_workflow(RunKind.FILTER, runner.work, as_arguments(job))
    wanted = {jobs[0].key: RunStatus.FAILED, jobs[1].key: RunStatus.SUCCEEDED}
    assert until(lambda: statuses() == wanted)
    with database.reading() as session:
        run = session.scalars(select(Run).where(Run.status == RunStatus.FAILED)).one()
    assert run.attempt == 2, "which counts: it would not succeed by itself"
    assert "more memory than it could have" in (run.error or "")
