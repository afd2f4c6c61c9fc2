"""The worker's part of a withdrawal: its own notes, the results of work that was under way, the bytes of freed pages.

The web has erased rows and files and written down when. Here that is found (``withdrawn_at`` without ``erased_at``),
work for the person is cancelled and waited for, and what it left is erased before anybody says that all is gone.
"""

import logging
import re
from collections.abc import Callable, Collection, Iterator, Mapping, MutableMapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from dbos import DBOS, WorkflowStatus
from sqlalchemy import select, update
from sqlalchemy.orm import Session

from app import upgrading
from app.db import now, sqlite
from app.domain.models import RunKind
from app.domain.studies import Participant, Study
from app.services.auditing import receipts
from app.services.auditing.receipts import Erased
from app.services.backups import restoring
from app.services.participants import withdrawal
from worker.jobs.runtime import engine
from worker.jobs.runtime.context import WorkerContext
from worker.jobs.runtime.records import Job, from_arguments

log = logging.getLogger("worker")

_ACTIVE = frozenset({"PENDING", "ENQUEUED", "DELAYED"})
_OF_WHOLE_STUDIES = frozenset({RunKind.REPORT.value, RunKind.EXPORT.value})
"""Kinds of work whose results hold something of everybody."""
_SHA256 = re.compile(r"\b[0-9a-f]{64}\b")


@dataclass(frozen=True)
class ErasureProgress:
    """What one attempt at erasing came to."""

    finished: bool
    forgotten: frozenset[str] = frozenset()
    """Names of workflows that the engine no longer knows, so that they may be started again if they are due."""


def unfinished(session: Session) -> Sequence[int]:
    """Participants of whom traces may be left; those of deleted studies are erased with these."""
    theirs = select(Participant.id).join(Study, Study.id == Participant.study_id).where(Study.deleted_at.is_(None))
    left = theirs.where(Participant.withdrawn_at.is_not(None), Participant.erased_at.is_(None))
    return session.scalars(left).all()


def unfinished_studies(session: Session) -> Sequence[int]:
    """Deleted studies of which traces may be left."""
    return session.scalars(select(Study.id).where(Study.deleted_at.is_not(None), Study.erased_at.is_(None))).all()


def erase_traces(
    context: WorkerContext,
    participant_id: int,
    in_hand: Collection[str],
    stored: MutableMapping[str, set[str]],
    engine_file: Path | None,
) -> ErasureProgress:
    """Erase what the worker knows of somebody who has withdrawn; asked again until it says that it has finished.

    ``in_hand``: keys of runs this process works on; ``stored``: artefacts that unfinished work has put away, by key.
    """
    with context.database.reading() as session:
        study_id = session.get_one(Participant, participant_id).study_id

    def concerns(job: Job) -> bool:
        of_study = job.kind in _OF_WHOLE_STUDIES and job.study_id == study_id
        return job.participant_id == participant_id or of_study

    def whom(session: Session) -> Participant:
        return session.get_one(Participant, participant_id)

    def erase(session: Session) -> None:
        withdrawal.erase(session, context.store, whom(session))

    def finish(session: Session) -> None:
        session.get_one(Participant, participant_id).erased_at = now()
        log.info("participant %d has withdrawn: the last traces are erased", participant_id)

    return _erase(context, concerns, whom, erase, finish, in_hand, stored, engine_file)


def erase_traces_of_study(
    context: WorkerContext,
    study_id: int,
    in_hand: Collection[str],
    stored: MutableMapping[str, set[str]],
    engine_file: Path | None,
) -> ErasureProgress:
    """The same for a study that was deleted, and for everybody in it at once."""

    def concerns(job: Job) -> bool:
        return job.study_id == study_id

    def whom(session: Session) -> Study:
        return session.get_one(Study, study_id)

    def erase(session: Session) -> None:
        withdrawal.erase_study(session, context.store, whom(session))

    def finish(session: Session) -> None:
        session.get_one(Study, study_id).erased_at = now()
        session.execute(update(Participant).where(Participant.study_id == study_id).values(erased_at=now()))
        log.info("study %d was deleted: the last traces are erased", study_id)

    return _erase(context, concerns, whom, erase, finish, in_hand, stored, engine_file)


Erase = Callable[
    [WorkerContext, int, Collection[str], MutableMapping[str, set[str]], Path | None],
    ErasureProgress,
]


def _erase(
    context: WorkerContext,
    concerns: Callable[[Job], bool],
    whom: Callable[[Session], Participant | Study],
    erase: Callable[[Session], None],
    finish: Callable[[Session], None],
    in_hand: Collection[str],
    stored: MutableMapping[str, set[str]],
    engine_file: Path | None,
) -> ErasureProgress:
    jobs = dict(_workflows(concerns))
    active = [name for name, (_, status) in jobs.items() if status in _ACTIVE]
    if active:
        DBOS.cancel_workflows(active)  # and look again: one of them may just be beginning
    if active or any(job.key in in_hand for job, _ in jobs.values()):
        return ErasureProgress(finished=False)
    left_over = {sha256 for name in jobs for sha256 in _artefacts_of_steps(name)}
    for job, _ in jobs.values():
        left_over |= stored.pop(job.key, set())
    with context.database.writing() as session:
        erase(session)
        unused = left_over - withdrawal.in_use(session, left_over)
        for sha256 in unused:
            context.store.delete(sha256)
        late = Erased(rows={"notes of the engine": len(jobs)}, files=len(unused))
        if late:
            receipts.add(session, whom(session), receipts.LATE_RESULTS, late)
    DBOS.delete_workflows(list(jobs))
    if not context.database.forget_erased() or (engine_file is not None and not sqlite.rewrite(engine_file)):
        return ErasureProgress(
            finished=False, forgotten=frozenset(jobs)
        )  # somebody is reading; the next round tries again
    if engine_file is not None:
        engine.forget_set_aside(engine_file)
    database_file = sqlite.file_of(context.database.url)
    if database_file is not None:
        upgrading.forget_copies(database_file)
    restoring.forget_replaced(context.store.root.parent)
    with context.database.writing() as session:
        finish(session)
        receipts.add(session, whom(session), receipts.LAST_TRACES, Erased())
    return ErasureProgress(finished=True, forgotten=frozenset(jobs))


def drafts() -> set[str]:
    """Artefacts that the engine alone knows: results of steps of unfinished work."""
    unfinished_work = DBOS.list_workflows(status=sorted(_ACTIVE), load_input=False, load_output=False)
    return {sha256 for workflow in unfinished_work for sha256 in _artefacts_of_steps(workflow.workflow_id)}


def _workflows(concerns: Callable[[Job], bool]) -> Iterator[tuple[str, tuple[Job, str]]]:
    """Names, jobs and states of every workflow whose job is of concern."""
    for workflow in DBOS.list_workflows(load_input=True, load_output=False):
        job = _job(workflow)
        if job is not None and concerns(job):
            yield workflow.workflow_id, (job, workflow.status)


def _job(workflow: WorkflowStatus) -> Job | None:
    arguments = workflow.input["args"][-1] if workflow.input and workflow.input["args"] else None
    if not isinstance(arguments, Mapping):
        return None
    try:
        return from_arguments(arguments)
    except (KeyError, ValueError):
        return None


def _artefacts_of_steps(workflow: str) -> set[str]:
    """Drafts are known to the engine alone: their hashes are what the steps returned."""
    return {sha256 for step in DBOS.list_workflow_steps(workflow) for sha256 in _SHA256.findall(repr(step["output"]))}
