"""The worker as a service: looks every half second whether anything has changed, and has the engine do what is due."""

import fcntl
import logging
import math
import os
import threading
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from functools import partial
from pathlib import Path

from dbos import DBOS, SetWorkflowID
from sqlalchemy.exc import OperationalError

from app import data_directory, logs, signing
from app.db import Database, Watch, complaints, now
from app.domain.study_settings import StudySettings
from app.errors import AppError, OncePerMinute
from app.files.interface import StorageUnavailable
from app.services.monitoring import health
from app.settings import Settings
from app.storage import ArtefactMissing, ArtefactStore, keep_private
from worker.compute import learning, simulation
from worker.compute.pools import Compute, ComputeLost, Interrupted, Lane
from worker.jobs import experiments, reconcile
from worker.jobs.learning import query_selection
from worker.jobs.runtime import due_lending, engine, records
from worker.jobs.runtime.context import WorkerContext
from worker.jobs.runtime.lanes import Lanes
from worker.jobs.runtime.records import Job, as_arguments
from worker.jobs.runtime.urgency import Level, WhoWaits
from worker.jobs.upkeep import erasure, unused_files
from worker.jobs.upkeep.backups import Backups
from worker.jobs.workflows import JobRunner
from worker.stop_signals import Stop

log = logging.getLogger("worker")

ROUND_S = 0.5
REST = 9.0
"""Times as long as the last round took: a tenth of a core at most, however large the studies are."""
PRESENCE_S = 5.0
MOST_WORKERS = 1000
"""that find a name by themselves"""
CLEARING_S = 24 * 3600.0
LOOK_AGAIN_S = 10.0
"""What is still due after this long may have been forgotten by the engine, or given up."""
BEGINS_WITHIN_S = 30.0
"""A job the engine was told of takes up a place for so long; one of an earlier version it may never begin."""


class WorkerAlreadyRunning(AppError):
    """A worker of this name is already running on this data directory or database. Stop it, or set WORKER_NAME."""


class KeepsFelling(AppError):
    """The worker has stopped again and again in the middle of this, as it does when the machine runs out of memory."""


def run(settings: Settings) -> int:
    """Keep studies supplied with clips, queries, models and bundles until told to stop."""
    logs.write_to_stderr(settings.log_format, logging.INFO)
    logging.getLogger("alembic").setLevel(logging.WARNING)  # it tells of every plugin it loads
    engine_log = logging.getLogger("dbos")
    engine_log.setLevel(logging.ERROR)
    engine_log.addFilter(OncePerMinute())
    keep_private(settings)
    with data_directory.shared(settings.data_dir), ExitStack() as stack:
        database = Database(settings.sqlalchemy_url)
        stack.callback(database.dispose)
        with database.reading() as session:
            health.require_own_schema(session)
        settings = _named(settings, database, stack)
        stack.enter_context(_only_one(settings))
        stop = Stop()
        compute = Compute(settings.compute_processes, stop.asked)
        stop.at_once = compute.kill
        store = ArtefactStore.of(settings)
        store.files.require_usable()
        context = WorkerContext(database, store, compute, signing.load(settings))
        runner = JobRunner(context, Lanes(compute))
        experiments.CellRunner(compute, experiments.work_directory(settings))
        try:
            compute.warm_up(Lane.CLIPS, simulation.warm_up)
            with engine.running(settings, database) as bond:
                log.info("worker %s is ready", settings.worker_name)
                _Rounds(settings, runner, bond).until(stop.asked)
        except Interrupted:
            log.info("stopped while starting")
        finally:
            compute.close()
            DBOS.destroy()
    return 0


def _named(settings: Settings, database: Database, stack: ExitStack) -> Settings:
    """The settings with a name that no other worker of this database has, until the stack is closed.

    Whoever is given no name takes the first that is free: copies of one container can be told nothing of their own.
    """
    given = "worker_name" in settings.model_fields_set or database.is_sqlite
    for name in [settings.worker_name] if given else (f"worker-{number}" for number in range(1, MOST_WORKERS + 1)):
        claim = ExitStack()
        if claim.enter_context(database.claiming(name)):
            stack.enter_context(claim)
            return settings.model_copy(update={"worker_name": name})
        claim.close()
    raise WorkerAlreadyRunning


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


class _Rounds:
    """Asks the database again and again; remembers only what spares work, nothing that work depends on."""

    def __init__(self, settings: Settings, runner: JobRunner, bond: engine.Bond) -> None:
        self._worker_name = settings.worker_name
        self._engine_file = engine.file_of(settings)
        self._bond = bond
        self._runner = runner
        self._context = runner.context
        self._started: dict[str, float] = {}  # what the engine has been told already, and when it was last asked
        self._told_at: dict[str, float] = {}
        self._born_at = time.monotonic()
        self._signed_at = -math.inf
        self._cleared_at = -math.inf
        self._rested_at = -math.inf
        self._prepared: set[int] = set()
        self._refused: set[int] = set()
        self._backups = Backups(settings)

    def until(self, stop: threading.Event) -> None:
        """One round after the other; a database that is away for a while is waited for."""
        with closing(self._context.database.watch()) as watch:
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
            self._runner.leave_nothing_of_erased()
            self._backups.look()
        except OperationalError as error:
            complaints.warning("the database could not be reached, trying again: %s", error.orig)
        except StorageUnavailable as error:
            complaints.warning("stored files could not be reached, trying again: %s", error.__cause__)

    def _sign(self) -> None:
        if time.monotonic() - self._signed_at >= PRESENCE_S:
            moment = now()
            if not self._bond.promise(moment):
                return
            with self._context.database.writing() as session:
                health.require_own_schema(session)  # another machine may have brought a newer version
                records.sign_presence(session, self._worker_name, moment)
                records.beat_all(session, list(self._runner.in_hand))
            self._bond.signed(moment)
            self._signed_at = time.monotonic()

    def _clear_away(self) -> None:
        """At the start and once a day."""
        if time.monotonic() - self._cleared_at >= CLEARING_S:
            unused_files.clear_away(self._context, erasure.drafts() | set().union(*self._runner.stored.values()))
            self._cleared_at = time.monotonic()

    def _round(self) -> None:
        lanes = self._runner.lanes
        with self._context.database.reading() as session:
            lost_files = self._context.store.lost()
            due = list(reconcile.due(session, lost_files))
            hungry = {*reconcile.short_of_queries(session), *reconcile.with_lost_queries(session, lost_files)}
            lost = reconcile.abandoned(session, self._runner.in_hand)
            answered = reconcile.studies_with_answers(session)
            withdrawn, deleted = erasure.unfinished(session), erasure.unfinished_studies(session)
            lending = due_lending.unsettled(session)
            lanes.who_waits = WhoWaits.look(session)
        self._start_most_urgent(due)
        for participant_id in hungry - self._refused:
            self._refill(participant_id)
        for study_id in lending:
            with self._context.database.writing() as session:
                due_lending.settle(session, study_id)
        for participant_id in withdrawn:
            self._erase(erasure.erase_traces, participant_id)
        for study_id in deleted:
            self._erase(erasure.erase_traces_of_study, study_id)
        for job, attempt in lost:
            self._take_over(job, reconcile.workflow_name(job.key, attempt))
        for study in answered:
            if study.id not in self._prepared:
                self._prepared.add(study.id)
                lanes.compute.warm_up(Lane.REWARDS, partial(learning.warm_up, study.task))
                threading.Thread(
                    target=self._make_references, args=(study.task, study.settings, study.seed), daemon=True
                ).start()

    def _make_references(self, task: str, settings: StudySettings, study_seed: int) -> None:
        """What the first filter would otherwise wait for."""
        from worker.jobs.learning import reference_rollouts  # seconds, for which nothing else shall wait

        try:
            context = self._context
            made = context.references, context.outcomes
            reference_rollouts.make_ready(context.compute, *made, task, settings, study_seed)
        except Interrupted:
            return
        except ComputeLost:
            log.warning("rollouts of the reference policy were lost; the first filter of %s will make them", task)

    def _erase(self, erase: erasure.Erase, row_id: int) -> None:
        progress = erase(self._context, row_id, self._runner.in_hand, self._runner.stored, self._engine_file)
        for name in progress.forgotten:
            self._started.pop(name, None)

    def _refill(self, participant_id: int) -> None:
        try:
            query_selection.refill_queries(self._context, participant_id)
        except StorageUnavailable:
            raise
        except ArtefactMissing:  # which is known now, and done without or made again by the next round
            complaints.warning("pairs of participant %d could not be chosen: a stored file is lost", participant_id)
        except AppError as refusal:  # one study that cannot go on must not stop the others
            log.warning("participant %d gets no further pairs: %s", participant_id, refusal.message)
            self._refused.add(participant_id)

    def _start_most_urgent(self, due: Sequence[tuple[Job, int]]) -> None:
        """Tell the engine only of what can be begun now, so that whoever comes to wait later stands before the rest.

        What the engine was told and has not begun is still due, and counts, unless it seems to have forgotten it.
        """
        begun = Counter(key.partition("/")[0] for key in tuple(self._runner.in_hand))
        for job, attempt in sorted(due, key=lambda each: self._runner.lanes.who_waits.urgency(each[0])):
            level = self._runner.lanes.who_waits.urgency(job).level
            places = engine.QUEUES[job.kind] + (engine.RESERVE if level <= Level.ANSWERING else 0)
            if job.key in self._runner.in_hand or begun[job.kind] >= places:
                continue
            name = reconcile.workflow_name(job.key, attempt)
            self._start(job, name)
            begun[job.kind] += time.monotonic() - self._told_at.setdefault(name, time.monotonic()) < BEGINS_WITHIN_S

    def _start(self, job: Job, name: str) -> None:
        """Have the engine do it; once, unless it turns out to be due still and in nobody's hands."""
        if time.monotonic() - self._started.get(name, -math.inf) < LOOK_AGAIN_S:
            return
        self._started[name] = time.monotonic()
        if job.key not in self._runner.in_hand and not engine.is_at_it(name):
            self._go_on(job, name)

    def _take_over(self, job: Job, name: str) -> None:
        """Go on with what was begun; anew where the engine does not know how far it had come.

        Not right after the start: then the engine takes up by itself, and counts, what this worker was doing.
        """
        if time.monotonic() - self._started.get(name, self._born_at) < LOOK_AGAIN_S:
            return
        self._started[name] = time.monotonic()
        if engine.gave_up(name):
            log.warning("%s: %s", name, KeepsFelling().message)
            with self._context.database.writing() as session:
                records.fail_run(session, job.key, KeepsFelling().message)
            return
        log.warning("%s was left behind; taking it over", name)
        self._go_on(job, name)

    def _go_on(self, job: Job, name: str) -> None:
        if not engine.resume(name):
            with SetWorkflowID(name):
                DBOS.enqueue_workflow(job.kind, self._runner.work, as_arguments(job))
