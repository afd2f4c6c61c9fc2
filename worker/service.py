"""The worker as a service: looks every half second whether anything has changed, and has the engine do what is due."""

import fcntl
import logging
import math
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from functools import partial
from pathlib import Path
from types import FrameType

from dbos import DBOS, SetWorkflowID
from sqlalchemy.exc import OperationalError

from app.db import Database, Watch
from app.domain.models import RunKind
from app.domain.studies import StudySettings
from app.errors import AppError
from app.settings import Settings
from app.storage import ArtefactStore
from worker import erasure, laboratory, lessons, orphans, querying, reconcile, records, references
from worker.compute import Compute, ComputeLost, Interrupted, Lane
from worker.records import Job
from worker.workflows import Workshop, as_arguments
from worker.workplace import Workplace

log = logging.getLogger("worker")

ROUND_S = 0.5
REST = 9.0
"""Times as long as the last round took: a tenth of a core at most, however large the studies are."""
PRESENCE_S = 5.0
CLEARING_S = 24 * 3600.0
ENGINE_VERSION = "2"
"""Raised when the steps of a workflow change so that a half-finished one could not be resumed."""

QUEUES = {
    RunKind.CLIPS: 2,
    RunKind.REWARD: 1,
    RunKind.FILTER: 1,
    RunKind.METHOD: 1,
    RunKind.FILMS: 1,
    RunKind.REPORT: 1,
    RunKind.EXPORT: 1,
}
"""How many jobs of each kind one worker does at a time."""
AWAITED = {RunKind.CLIPS, RunKind.REWARD}
"""What somebody may be waiting for who is answering: begun within AWAITED_POLL_S, anything else within POLL_S.

Asking the engine for all seven kinds five times a second took a tenth of a core, whether there was work or not."""
AWAITED_POLL_S, POLL_S = 0.3, 1.0


class WorkerAlreadyRunning(AppError):
    """A worker of this name is already running on this data directory. Stop it first, or set WORKER_NAME."""


def run(settings: Settings) -> int:
    """Keep studies supplied with clips, queries, models and bundles until told to stop."""
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    logging.getLogger("dbos").setLevel(logging.ERROR)
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _setter(stop))
    with _only_one(settings):
        database = Database(settings.sqlalchemy_url)
        compute = Compute(settings.compute_processes)
        compute.warm_up(Lane.CLIPS, laboratory.warm_up)
        workshop = Workshop(Workplace(database, ArtefactStore(settings.data_dir / "artefacts"), compute))
        _launch_engine(settings)
        log.info("worker %s is ready", settings.worker_name)
        try:
            _Rounds(settings, workshop).until(stop)
        finally:
            compute.close()
            DBOS.destroy()
            database.dispose()
    return 0


def _setter(stop: threading.Event) -> Callable[[int, FrameType | None], None]:
    def on_signal(_number: int, _frame: FrameType | None) -> None:
        stop.set()

    return on_signal


@contextmanager
def _only_one(settings: Settings) -> Iterator[None]:
    """Two workers of one name would resume each other's work while it is being done."""
    settings.data_dir.mkdir(parents=True, exist_ok=True)
    path = Path(settings.data_dir / f"{settings.worker_name}.lock")
    with path.open("w") as stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise WorkerAlreadyRunning from error
        stream.write(str(os.getpid()))
        stream.flush()
        yield


def engine_file(settings: Settings) -> Path | None:
    """Where the durable engine keeps its own notes; None when they lie on the PostgreSQL server."""
    return settings.data_dir.resolve() / "engine.sqlite3" if settings.sqlalchemy_url.startswith("sqlite") else None


def _launch_engine(settings: Settings) -> None:
    path = engine_file(settings)
    url = settings.sqlalchemy_url if path is None else f"sqlite:///{path}"
    DBOS(
        config={
            "name": "pbarl-studio",
            "system_database_url": url,
            "executor_id": settings.worker_name,
            "application_version": ENGINE_VERSION,
            "log_level": "ERROR",
        }
    )
    DBOS.launch()
    for kind, count in QUEUES.items():
        interval = AWAITED_POLL_S if kind in AWAITED else POLL_S
        DBOS.register_queue(kind.value, worker_concurrency=count, polling_interval_sec=interval)


class _Rounds:
    """Asks the database again and again; remembers only what spares work, nothing that work depends on."""

    def __init__(self, settings: Settings, workshop: Workshop) -> None:
        self._worker_name = settings.worker_name
        self._engine_file = engine_file(settings)
        self._workshop = workshop
        self._place = workshop.place
        self._started: set[str] = set()  # what the engine has been told already
        self._signed_at = -math.inf
        self._cleared_at = -math.inf
        self._rested_at = -math.inf
        self._prepared: set[int] = set()
        self._refused: set[int] = set()

    def until(self, stop: threading.Event) -> None:
        """One round after the other; a database that is away for a while is waited for."""
        with closing(self._place.database.watch()) as watch:
            while not stop.wait(ROUND_S):
                self._look(watch)

    def _look(self, watch: Watch) -> None:
        try:
            self._sign()  # a change as well, so that what is due for its time alone is found, too
            started = time.monotonic()
            if started >= self._rested_at and watch.changed():
                self._round()
                self._rested_at = time.monotonic() + REST * (time.monotonic() - started)
            self._clear_away()
        except OperationalError as error:
            log.warning("the database could not be reached, trying again: %s", error.orig)

    def _sign(self) -> None:
        if time.monotonic() - self._signed_at >= PRESENCE_S:
            with self._place.database.writing() as session:
                records.sign_presence(session, self._worker_name)
            self._signed_at = time.monotonic()

    def _clear_away(self) -> None:
        """At the start and once a day."""
        if time.monotonic() - self._cleared_at >= CLEARING_S:
            orphans.clear_away(self._place, erasure.drafts() | set().union(*self._workshop.stored.values()))
            self._cleared_at = time.monotonic()

    def _round(self) -> None:
        with self._place.database.reading() as session:
            due = list(reconcile.findings(session))
            hungry = set(reconcile.short_of_queries(session))
            lost = reconcile.abandoned(session, self._workshop.in_hand)
            answered = reconcile.studies_with_answers(session)
            withdrawn, deleted = erasure.unfinished(session), erasure.unfinished_studies(session)
        for job, attempt in due:
            self._start(job, reconcile.workflow_name(job.finding, attempt))
        for participant_id in hungry - self._refused:
            self._refill(participant_id)
        for participant_id in withdrawn:
            self._erase(erasure.erase_traces, participant_id)
        for study_id in deleted:
            self._erase(erasure.erase_traces_of_study, study_id)
        for name in lost:
            log.warning("%s was left behind by another worker; taking it over", name)
            DBOS.resume_workflow(name)
        for study in answered:
            if study.id not in self._prepared:
                self._prepared.add(study.id)
                for lane in (Lane.REWARDS, Lane.LEARNING):
                    self._place.compute.warm_up(lane, partial(lessons.warm_up, study.task))
                threading.Thread(target=self._make_references, args=(study.task, study.settings), daemon=True).start()

    def _make_references(self, task: str, settings: StudySettings) -> None:
        """What the first filter would otherwise wait for."""
        try:
            references.make_ready(self._place.compute, self._place.references, task, settings)
        except Interrupted:
            return
        except ComputeLost:
            log.warning("rollouts of the reference policy were lost; the first filter of %s will make them", task)

    def _erase(self, erase: erasure.Erase, row_id: int) -> None:
        shop = self._workshop
        progress = erase(self._place, row_id, shop.in_hand, shop.stored, self._engine_file)
        self._started -= progress.forgotten

    def _refill(self, participant_id: int) -> None:
        try:
            querying.refill_queries(self._place, participant_id)
        except AppError as refusal:  # one study that cannot go on must not stop the others
            log.warning("participant %d gets no further pairs: %s", participant_id, refusal.message)
            self._refused.add(participant_id)

    def _start(self, job: Job, name: str) -> None:
        if name not in self._started:
            with SetWorkflowID(name):
                DBOS.enqueue_workflow(job.kind, self._workshop.work, as_arguments(job))
            self._started.add(name)
