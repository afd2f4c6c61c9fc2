"""Filters that somebody is shown although they are not theirs: another participant's, and one for everybody.

Whose it is, app.services.evaluation.donors draws. Another participant's filter is taken as it is; one for a type of
user or for the mean of several people is fitted as personal filters are, with the study's seed.
"""

import time

from sqlalchemy import select
from sqlalchemy.orm import Session

from app.domain.evaluation import DonorDraw
from app.domain.models import Model, ModelKind
from app.domain.protocol import EvaluatedMethod
from app.domain.studies import Participant, Study
from app.errors import AppError
from app.services.evaluation import donors
from worker.compute import baseline_fitting, shared_reward
from worker.compute.pools import Lane
from worker.jobs.learning import dataset, filters
from worker.jobs.runtime import records
from worker.jobs.runtime.context import Step, WorkerContext
from worker.jobs.runtime.records import Job

STAGES = ("mode", "residual", "gate", "promise")


class LoanEnded(AppError):
    """Whose filter was to be shown to somebody has withdrawn. Another one is drawn."""


def make(context: WorkerContext, job: Job, run_id: int, step: Step, method: EvaluatedMethod) -> dict[str, object]:
    """The artefact of the controller, what is to be said about it, and a mark of the draw; empty: nobody needs it.

    Steps return files and marks, never who it is: the engine's notes are the borrower's, and stay when a donor goes.
    """
    started = time.time()
    mark = step("draw", _draw, context, job, method)
    artefact, notes = step("lent", _lent, context, job, run_id, method, mark)
    if not artefact:
        reward, draft = step("wishes", _wishes, context, job, run_id, method, mark), ""
        for stage in STAGES:
            if step(f"is-outdated-before-{stage}", filters.is_outdated, context, job, True):
                return {}
            draft = step(stage, filters.fit_stage, context, run_id, job, reward, draft, stage, True)
        artefact, notes = step("prove", _prove, context, job, run_id, reward, draft)
    return {"artefact": artefact, "notes": notes, "seconds": round(time.time() - started, 1), "draw": mark}


def check(session: Session, job: Job, method: str, mark: object) -> None:
    """Whether what was drawn still stands. Raises LoanEnded."""
    drawn = donors.find(session, job.participant, method)
    if drawn is None or _mark(drawn) != mark:
        raise LoanEnded


def _mark(drawn: DonorDraw) -> str:
    """Ids may be given again."""
    return f"{drawn.id} {drawn.created_at.isoformat()}"


def _draw(context: WorkerContext, job: Job, method: EvaluatedMethod) -> str:
    with context.database.writing() as session:
        study, participant = session.get_one(Study, job.study_id), session.get_one(Participant, job.participant)
        return _mark(donors.draw(session, study, participant, method, shared_reward.types_of(study.task)))


def _lent(context: WorkerContext, job: Job, run_id: int, method: EvaluatedMethod, mark: str) -> tuple[str, list[str]]:
    """The controller of the one person or type whose filter it is, with its notes; empty when it has to be fitted."""
    with context.database.reading() as session:
        check(session, job, method, mark)
        known = _made_before(session, job, method)
        if known is not None:
            return known.artefact_sha256, list(known.metrics["notes"])
        if method is EvaluatedMethod.AVERAGE:
            return "", []
        models = _models_of_donors(session, job, method, ModelKind.FILTER)
        task = session.get_one(Study, job.study_id).task
    if not models:
        return "", []
    weights = context.store.read(models[0])
    beat = context.beat(run_id)
    controller = context.compute.run(Lane.LEARNING, beat, baseline_fitting.controller_of_filter, task, weights)
    return context.store.put(controller), []


def _made_before(session: Session, job: Job, method: str) -> Model | None:
    """What was fitted in this study to the same types of users: they want the same of everybody."""
    drawn = donors.find(session, job.participant, method)
    if drawn is None or not drawn.donors.types:
        return None
    earlier = select(DonorDraw).join(Participant, Participant.id == DonorDraw.participant_id)
    earlier = earlier.where(Participant.study_id == job.study_id, DonorDraw.id != drawn.id)
    for each in session.scalars(earlier.where(DonorDraw.method == method).order_by(DonorDraw.id)):
        if each.donors.types == drawn.donors.types:
            models = records.models_of(session, each.participant_id, ModelKind.METHOD)
            known = next((model for model in models if model.metrics.get("method") == method), None)
            if known is not None:
                return known
    return None


def _wishes(context: WorkerContext, job: Job, run_id: int, method: EvaluatedMethod, mark: str) -> str:
    """The artefact of the reward model that the filter is fitted to."""
    with context.database.reading() as session:
        check(session, job, method, mark)
        task = session.get_one(Study, job.study_id).task
        drawn = donors.find(session, job.participant, method)
        types = drawn.donors.types if drawn else ()
        rewards = [context.store.read(each) for each in _models_of_donors(session, job, method, ModelKind.REWARD)]
        scale = dataset.signal_scale(session, context.store, job.study_id)
    beat = context.beat(run_id)
    if types:
        return context.store.put(context.compute.run(Lane.LEARNING, beat, shared_reward.of_types, task, types, scale))
    return context.store.put(context.compute.run(Lane.LEARNING, beat, shared_reward.of_people, task, rewards, scale))


def _prove(context: WorkerContext, job: Job, run_id: int, reward: str, draft: str) -> tuple[str, list[str]]:
    """The same burden of proof as of a personal filter, for the wishes it was fitted to."""
    fitting = filters.fitting(context, run_id, job, reward, shared=True)
    proven = fitting.prove(filters.load_draft(context, draft))
    weights = proven.draft.weights.to_bytes()
    beat = context.beat(run_id)
    controller = context.compute.run(Lane.LEARNING, beat, baseline_fitting.controller_of_filter, fitting.task, weights)
    return context.store.put(controller), list(proven.draft.notes)


def _models_of_donors(session: Session, job: Job, method: str, kind: ModelKind) -> list[str]:
    """The artefact of the newest model of this kind of everybody whose filter it is. Raises LoanEnded."""
    drawn = donors.find(session, job.participant, method)
    if drawn is None:
        raise LoanEnded
    found = []
    for number in drawn.donors.people:
        who = select(Participant.id).where(Participant.study_id == job.study_id, Participant.number == number)
        model: Model | None = records.newest_model(session, session.scalars(who).one(), kind)
        if model is None:
            raise LoanEnded
        found.append(model.artefact_sha256)
    return found
