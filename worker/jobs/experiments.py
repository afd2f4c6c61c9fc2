"""Cells of the benchmark on the queue of the studio's workers: any number of machines compute, one command collects.

The command tells the engine which cells are missing. Workers do them with what everything else leaves, and the engine
keeps what came out until the command has fetched it. A command that was interrupted, given again, goes on collecting.
"""

import base64
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from time import sleep
from typing import TYPE_CHECKING

from dbos import DBOS, DBOSClient, DBOSConfiguredInstance, WorkflowHandle, WorkflowStatus
from sqlalchemy import select
from tqdm import tqdm

from app.db import Database, now
from app.domain.models import WorkerPresence
from app.settings import Settings
from worker.compute.pools import Compute, Lane
from worker.jobs.runtime import engine
from worker.jobs.runtime.records import LEASE
from worker.whole_files import written_whole

if TYPE_CHECKING:
    from worker.experiments.benchmark_cell import BenchmarkConfig, Cell

QUEUE = "experiment"
RUNNER = "cell runner"
FALLS_ALLOWED = 5
"""How often a worker may fall in the middle of a cell before that has failed."""
POLL_S = 5.0
"""How often workers look whether there is a cell to be done."""
LOOK_S = 2.0
"""How often the command looks whether one is finished."""
_PREFIX = "cell/"


def work_directory(settings: Settings) -> Path:
    """Where finished cells and the rollouts that they share are kept on this machine."""
    return settings.data_dir / "benchmark"


@DBOS.dbos_class()
class CellRunner(DBOSConfiguredInstance):
    """Does cells at one workplace."""

    def __init__(self, compute: Compute, work: Path) -> None:
        super().__init__(RUNNER)
        self.compute, self.directory = compute, work

    @DBOS.workflow(max_recovery_attempts=FALLS_ALLOWED)
    def work(self, asked: str) -> str:
        """The finished cell's file as base64. ``asked``: see asked_cell.as_text."""
        return DBOS.run_step({"name": "cell"}, self._run, asked)

    def _run(self, asked: str) -> str:
        from worker.experiments import asked_cell  # the learning stack: only for those who have experiments

        content = self.compute.run(Lane.EXPERIMENTS, _no_beat, asked_cell.run_asked, asked, self.directory)
        return base64.b64encode(content).decode()


def on_workers(
    settings: Settings,
    at_once: int,
    missing: "Sequence[Cell]",
    terms: "BenchmarkConfig",
    work: Path,
    done: Callable[[], None],
) -> list[str]:
    """Have the workers do what is missing, and put it where run_cell() would; returns what went wrong, cell by cell.

    ``at_once``: how many cells each worker does at a time. Interrupted, it takes back what no worker has begun.
    """
    from worker.experiments.asked_cell import as_text

    names = {f"{_PREFIX}{cell.path(terms, work).relative_to(work).as_posix()}": cell for cell in missing}
    asked = {name: as_text(cell, terms) for name, cell in names.items()}
    with _collecting(settings, asked, at_once) as queue, tqdm(total=len(names), unit="cell") as bar:
        failures: list[str] = []
        waiting = dict(names)
        while waiting:
            for name, outcome in queue.finished(tuple(waiting)):
                cell = waiting.pop(name)
                if isinstance(outcome, bytes):
                    path = cell.path(terms, work)
                    path.parent.mkdir(parents=True, exist_ok=True)
                    with written_whole(path) as draft:
                        draft.write_bytes(outcome)
                else:
                    failures.append(f"{cell}: {outcome}")
                bar.update(1)
                done()
            if waiting:
                sleep(LOOK_S)
        return failures


@contextmanager
def _collecting(settings: Settings, asked: Mapping[str, str], at_once: int) -> "Iterator[_Queue]":
    client = DBOSClient(system_database_url=engine.address(settings), application_name=engine.NAME)
    database = Database(settings.sqlalchemy_url)
    queue = _Queue(client, database, asked)
    try:
        client.register_queue(
            QUEUE, worker_concurrency=at_once, polling_interval_sec=POLL_S, on_conflict="always_update"
        )
        yield queue
    except KeyboardInterrupt:
        queue.take_back()
        raise
    finally:
        client.destroy()
        database.dispose()


class _Queue:
    """What the engine knows of the cells, as one command sees it."""

    def __init__(self, client: DBOSClient, database: Database, asked: Mapping[str, str]) -> None:
        self._client, self._database, self._asked = client, database, asked
        self._mine = set[str]()
        """what this command has told the engine, or found still to be done"""
        self._told_of_nobody = False

    def finished(self, waiting: Sequence[str]) -> Iterator[tuple[str, bytes | str]]:
        """Cells that have ended since: their files, or what went wrong. Asks for those that nobody is at."""
        known = {each.workflow_id: each for each in self._known() if each.workflow_id in waiting}
        present = self._present_workers()
        for name in waiting:
            status = known.get(name)
            if status is not None and (status.status == "SUCCESS" or (name in self._mine and engine.is_over(status))):
                yield name, self._outcome(name, status)
                self._client.delete_workflow(name)  # only now: whoever asked has put it away
            elif status is None or engine.is_over(status):
                self._ask(name, status)
            elif status.status == "PENDING" and status.executor_id not in present:
                self._client.resume_workflow(name)
            self._mine.add(name)
        if not present and not self._told_of_nobody:
            tqdm.write("No worker is running. Start one: python -m worker run", file=sys.stderr)
        self._told_of_nobody = not present

    def _outcome(self, name: str, ended: WorkflowStatus) -> bytes | str:
        handle: WorkflowHandle[str] = self._client.retrieve_workflow(name)
        if ended.status == "SUCCESS":
            return base64.b64decode(handle.get_result())
        try:
            return str(handle.get_result())
        except Exception as error:  # whatever the worker met with, of any library
            return f"{type(error).__name__}: {error}"

    def take_back(self) -> None:
        """Have nothing begun any more; what is at work is finished, and kept for whoever asks again."""
        left = [each.workflow_id for each in self._known() if each.status == "ENQUEUED"]
        mine = [name for name in left if name in self._mine]
        if mine:
            self._client.cancel_workflows(mine)

    def _ask(self, name: str, ended: WorkflowStatus | None) -> None:
        if ended is not None:  # in an earlier command: this one tries again
            self._client.delete_workflow(name)
        self._client.enqueue(
            {
                "queue_name": QUEUE,
                "workflow_name": CellRunner.work.__qualname__,
                "workflow_id": name,
                "class_name": CellRunner.__name__,
                "instance_name": RUNNER,
                "app_version": engine.VERSION,
            },
            self._asked[name],
        )

    def _known(self) -> list[WorkflowStatus]:
        return self._client.list_workflows(workflow_id_prefix=_PREFIX, load_input=False, load_output=False)

    def _present_workers(self) -> set[str]:
        with self._database.reading() as session:
            seen = select(WorkerPresence.name).where(WorkerPresence.last_seen_at > now() - LEASE)
            return set(session.scalars(seen))


def _no_beat() -> None:
    """The engine knows by the worker's own sign of life whether it is still at it."""
