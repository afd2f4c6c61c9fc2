"""Filters that somebody is shown although they are not theirs: another participant's, and one for everybody.

Whose it is, app.services.evaluation.donors draws. Another participant's filter is taken as it is; one for several
people or types of users was fitted before (worker.jobs.learning.shared_filters).
"""

import time
from collections.abc import Collection

from sqlalchemy import select, update
from sqlalchemy.orm import Session

from app.domain.evaluation import DonorDraw, Film
from app.domain.models import Model, ModelKind
from app.domain.protocol import EvaluatedMethod
from app.domain.studies import Participant, Study
from app.errors import AppError
from app.services.evaluation import donors
from app.services.participants import withdrawal
from worker.compute import baseline_fitting
from worker.compute.pools import Lane
from worker.jobs.runtime import records
from worker.jobs.runtime.context import Step, WorkerContext
from worker.jobs.runtime.records import Job


class LoanEnded(AppError):
    """Whose filter was to be shown to somebody has withdrawn. Another one is drawn."""


def take(context: WorkerContext, job: Job, run_id: int, step: Step, method: EvaluatedMethod) -> dict[str, object]:
    """The artefact of the controller, what is to be said about it, and a mark of the draw. Raises LoanEnded.

    Steps return files and marks, never who it is: the engine's notes are the borrower's, and stay when a donor goes.
    """
    started = time.time()
    mark = step("draw", _mark_of, context, job, method)
    artefact, notes = step("lent", _lent, context, job, run_id, method, mark)
    return {"artefact": artefact, "notes": notes, "seconds": round(time.time() - started, 1), "draw": mark}


def check(session: Session, job: Job, method: str, mark: object) -> DonorDraw:
    """What was drawn, if it still stands. Raises LoanEnded."""
    drawn = donors.find(session, job.participant, method)
    if drawn is None or _mark(drawn) != mark:
        raise LoanEnded
    return drawn


def take_over_films(session: Session, model: Model) -> None:
    """Films that were made ahead, of the same loan, are films of the model that it has become."""
    ahead = update(Film).where(Film.participant_id == model.participant_id, Film.model_id.is_(None))
    session.execute(ahead.where(Film.method == model.metrics["method"]).values(model_id=model.id))


def _mark(drawn: DonorDraw) -> str:
    """Ids may be given again."""
    return f"{drawn.id} {drawn.created_at.isoformat()}"


def _mark_of(context: WorkerContext, job: Job, method: EvaluatedMethod) -> str:
    with context.database.reading() as session:
        drawn = donors.find(session, job.participant, method)
    if drawn is None:
        raise LoanEnded
    return _mark(drawn)


def _lent(context: WorkerContext, job: Job, run_id: int, method: EvaluatedMethod, mark: str) -> tuple[str, list[str]]:
    """The controller of whose filter it is, with its notes."""
    with context.database.reading() as session:
        drawn = check(session, job, method, mark)
    controller, notes = controller_of(context, job, run_id, drawn)
    return context.store.put(controller), notes


def controller_of(context: WorkerContext, job: Job, run_id: int, drawn: DonorDraw) -> tuple[bytes, list[str]]:
    """The controller of what was drawn, with its notes; not stored, so that it goes when its donor does.

    Raises LoanEnded.
    """
    with context.database.reading() as session:
        study = session.get_one(Study, job.study_id)
        if drawn.donors.share_a_filter:
            shared = donors.shared_filter(session, study, drawn.donors)
            if shared is None or shared.artefact_sha256 is None or shared.metrics is None:
                raise LoanEnded
            return context.store.read(shared.artefact_sha256), list(shared.metrics["notes"])
        weights = context.store.read(_filter_of(session, study, drawn))
    beat = context.beat(run_id)
    return context.compute.run(Lane.LEARNING, beat, baseline_fitting.controller_of_filter, study.task, weights), []


def forget(context: WorkerContext, session: Session, files: Collection[str]) -> None:
    """Delete what was made of a loan that has ended."""
    for sha256 in set(files) - withdrawal.in_use(session, files):
        context.store.delete(sha256)


def _filter_of(session: Session, study: Study, drawn: DonorDraw) -> str:
    """The artefact of the newest filter of the one person whose it is. Raises LoanEnded."""
    theirs = select(Participant.id).where(Participant.study_id == study.id)
    person = session.scalar(theirs.where(Participant.number.in_(drawn.donors.people)))
    model = None if person is None else records.newest_model(session, person, ModelKind.FILTER)
    if model is None:
        raise LoanEnded
    return model.artefact_sha256
