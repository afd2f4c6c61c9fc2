"""The durable workflow behind every run: load (transaction) -> compute (no transaction) -> save (transaction).

The engine remembers which steps of a workflow are finished. A worker that is killed resumes at the first unfinished
one; every step may therefore run twice, and leaves the same rows and files when it does.
"""

import errno
import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from pkgutil import resolve_name
from typing import Any

from dbos import DBOS, DBOSConfiguredInstance
from sqlalchemy.exc import OperationalError
from sqlalchemy.orm import Session

from app import logs
from app.domain import run_keys
from app.domain.models import RunKind
from app.domain.run_keys import RunKey
from app.domain.studies import Participant, Study
from app.errors import AppError
from app.files.interface import StorageUnavailable
from app.services.participants import withdrawal
from worker.jobs.runtime import records
from worker.jobs.runtime.context import Step, WorkerContext
from worker.jobs.runtime.lanes import Lanes
from worker.jobs.runtime.records import Job, from_arguments

log = logging.getLogger("worker")

FALLS_ALLOWED = 5
"""How often a worker may fall in the middle of an attempt before that has failed."""


@dataclass(frozen=True)
class Imported:
    """A function that is imported when it is first called: together they take seconds to load."""

    name: str

    def __call__(self, context: WorkerContext, job: Job, run_id: int, step: Step) -> None:
        resolve_name(self.name)(context, job, run_id, step)


BODIES: dict[RunKind, Callable[[WorkerContext, Job, int, Step], None]] = {
    RunKind.CLIPS: Imported("worker.jobs.clips.pool_clips:build_clips"),
    RunKind.REWARD: Imported("worker.jobs.learning.reward_models:train_reward"),
    RunKind.FILTER: Imported("worker.jobs.learning.filters:train_filter"),
    RunKind.REFINEMENT: Imported("worker.jobs.learning.refinement:refine_ahead"),
    RunKind.METHOD: Imported("worker.jobs.learning.baselines:train_method"),
    RunKind.SHARED: Imported("worker.jobs.learning.shared_filters:fit"),
    RunKind.FILMS: Imported("worker.jobs.clips.evaluation_films:make_films"),
    RunKind.REPORT: Imported("worker.jobs.publishing.report_files:make"),
    RunKind.EXPORT: Imported("worker.jobs.publishing.export_files:make"),
    RunKind.POWER: Imported("worker.jobs.publishing.power_plans:make"),
}


class ParticipantWithdrew(AppError):
    """The participant has withdrawn, or the study was deleted, so there is nothing to be done."""


class OutOfMemory(AppError):
    """This work needs more memory than it could have. Give the machine more, or set COMPUTE_PROCESSES lower, and try
    again."""


@DBOS.dbos_class()
class JobRunner(DBOSConfiguredInstance):
    """Does jobs at one workplace."""

    def __init__(self, context: WorkerContext, lanes: Lanes) -> None:
        super().__init__("job runner")
        self.context, self.lanes = context, lanes
        self.in_hand: set[str] = set()
        """keys of runs that this process is working on; other threads add and remove: look at a copy of it"""
        self.stored: dict[str, set[str]] = {}
        """artefacts of work that has not succeeded yet, by key: nothing else may know of them"""

    @DBOS.workflow(max_recovery_attempts=FALLS_ALLOWED)
    def work(self, arguments: dict[str, Any]) -> None:
        """Do one job; what goes wrong is kept with the run and in the log, never raised."""
        job = from_arguments(arguments)
        with logs.about(job=job.key):
            self._do(job, arguments)

    def _do(self, job: Job, arguments: dict[str, Any]) -> None:
        self.in_hand.add(job.key)
        started = time.monotonic()
        try:
            run_id = _step("begin", self._begin, arguments)
            if run_id is None:
                return
            context = self.context.noting(self.stored.setdefault(job.key, set())).computing(self.lanes.of(job))
            BODIES[RunKind(job.kind)](context, job, run_id, _step)
            _step("finish", self._finish, run_id)
            self.stored.pop(job.key, None)
            log.info("%s done in %.1f s", job.key, time.monotonic() - started)
        except AppError as refusal:  # foreseen, and already in words for people
            log.warning("%s: %s", job.key, refusal.message)
            _step("fail", self._fail, job.key, refusal.message, not isinstance(refusal, StorageUnavailable))
        except Exception as error:  # the worker's edge: one failed job must not stop the others
            if self._is_pointless(job):
                log.info("%s is abandoned: the participant has withdrawn, or the study was deleted", job.key)
                return
            log.exception("%s failed", job.key)
            _step("fail", self._fail, job.key, _in_words(error), not _is_the_machine_s(error))
        finally:
            self.in_hand.discard(job.key)

    def _is_pointless(self, job: Job) -> bool:
        with self.context.database.reading() as session:
            return _has_withdrawn(session, job)

    def leave_nothing_of_erased(self) -> None:
        """Another worker may have erased somebody's last traces while this one was still at work for them."""
        for key in [each for each in tuple(self.stored) if each not in self.in_hand]:
            about, store = run_keys.read(key), self.context.store
            with self.context.database.writing() as session:
                if about is None or not _is_erased(session, about):
                    continue
                stored = self.stored.pop(key)
                for sha256 in stored - withdrawal.in_use(session, stored):
                    store.delete(sha256)
            if about.participant_id is not None:
                store.unfinished.forget(store.unfinished.folder(about.participant_id))

    def _begin(self, arguments: dict[str, Any]) -> int | None:
        """The run's id; None when there is nothing to be done, because an earlier life of this job has finished it."""
        job = from_arguments(arguments)
        with self.context.database.writing() as session:
            if not _has_withdrawn(session, job):
                if records.has_succeeded(session, job.key):
                    return None
                return records.begin_run(session, job, _seed(session, job))
            _have_erased_again(session, job)
        raise ParticipantWithdrew

    def _finish(self, run_id: int) -> None:
        with self.context.database.writing() as session:
            records.finish_run(session, run_id)

    def _fail(self, key: str, error: str, counts: bool = True) -> None:
        with self.context.database.writing() as session:
            records.fail_run(session, key, error, counts)


def _step(name: str, function: Callable[..., Any], *arguments: Any) -> Any:
    return DBOS.run_step({"name": name}, function, *arguments)


def _in_words(error: Exception) -> str:
    """What the experimenter reads on the study's page."""
    if isinstance(error, MemoryError) or "can't allocate memory" in str(error):
        return f"{OutOfMemory().message} ({type(error).__name__}: {error})"
    return f"{type(error).__name__}: {error}"


def _is_the_machine_s(error: Exception) -> bool:
    """Whether the same work would succeed once there is space again, or the database can be reached."""
    if isinstance(error, OSError):
        return error.errno in {errno.ENOSPC, errno.EDQUOT, errno.EROFS}
    return isinstance(error, OperationalError)


def _has_withdrawn(session: Session, job: Job) -> bool:
    if session.get_one(Study, job.study_id).deleted_at is not None:
        return True
    return job.participant_id is not None and (
        session.get_one(Participant, job.participant_id).withdrawn_at is not None
    )


def _have_erased_again(session: Session, job: Job) -> None:
    """Work may begin just when the last traces are erased, and then the engine keeps it anew."""
    session.get_one(Study, job.study_id).erased_at = None
    if job.participant_id is not None:
        session.get_one(Participant, job.participant_id).erased_at = None


def _is_erased(session: Session, about: RunKey) -> bool:
    if about.participant_id is not None:
        return session.get_one(Participant, about.participant_id).erased_at is not None
    return about.study_id is not None and session.get_one(Study, about.study_id).erased_at is not None


def _seed(session: Session, job: Job) -> int:
    if job.participant_id is None:
        return session.get_one(Study, job.study_id).seed
    return session.get_one(Participant, job.participant_id).seed
