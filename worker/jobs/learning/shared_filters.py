"""Filters for several people or types of users together: fitted as personal ones are, with the study's seed."""

import time

from sqlalchemy import select
from sqlalchemy.orm import Session

from app.domain.evaluation import SharedFilter
from app.domain.models import ModelKind
from app.domain.studies import Participant, Study
from app.services.participants import withdrawal
from worker.compute import baseline_fitting, filter_finishing, shared_reward, stages
from worker.compute.pools import Lane
from worker.jobs.learning import dataset, filters, fits
from worker.jobs.runtime import due_lending, records
from worker.jobs.runtime.context import Step, WorkerContext
from worker.jobs.runtime.records import Job


def fit(context: WorkerContext, job: Job, run_id: int, step: Step) -> None:
    """Fit the filter that a row asks for; every stage is a step. Nothing is left when it is no longer asked for."""
    started = time.time()
    reward, draft = step("wishes", _wishes, context, job, run_id), ""
    with context.database.reading() as session:
        settings = session.get_one(Study, job.study_id).settings
    for stage in stages.before_finish(fits.stages_of(settings, job)):
        if not reward or step(f"is-outdated-before-{stage}", _is_outdated, context, job):
            return
        draft = step(stage, filters.fit_stage, context, run_id, job, reward, draft, stage, True)
    step("prove", _prove, context, job, run_id, reward, draft, started)


def _is_outdated(context: WorkerContext, job: Job) -> bool:
    with context.database.reading() as session:
        return due_lending.find(session, job) is None


def _wishes(context: WorkerContext, job: Job, run_id: int) -> str:
    """The artefact of the reward model that the filter is fitted to; empty when nobody needs it any more."""
    with context.database.reading() as session:
        shared = due_lending.find(session, job)
        if shared is None:
            return ""
        task, types = session.get_one(Study, job.study_id).task, shared.donors.types
        rewards = [context.store.read(each) for each in _rewards(session, job, shared)]
        scale = dataset.signal_scale(session, context.store, job.study_id)
    beat = context.beat(run_id)
    if types:
        return context.store.put(context.compute.run(Lane.LEARNING, beat, shared_reward.of_types, task, types, scale))
    return context.store.put(context.compute.run(Lane.LEARNING, beat, shared_reward.of_people, task, rewards, scale))


def _rewards(session: Session, job: Job, shared: SharedFilter) -> list[str]:
    """The artefact of the newest reward model of every donor."""
    there = select(Participant.id).where(Participant.study_id == job.study_id)
    people = session.scalars(there.where(Participant.number.in_(shared.donors.people)).order_by(Participant.number))
    found = [records.newest_model(session, person, ModelKind.REWARD) for person in people.all()]
    return [model.artefact_sha256 for model in found if model is not None]


def _prove(context: WorkerContext, job: Job, run_id: int, reward: str, draft: str, started: float) -> None:
    """The same burden of proof as of a personal filter, for the wishes it was fitted to."""
    fitting = fits.fitting(context, run_id, job, context.store.read(reward), shared=True)
    proven = filter_finishing.prove(fitting, fits.load_draft(context, draft))
    weights, beat = proven.draft.weights.to_bytes(), context.beat(run_id)
    controller = context.compute.run(Lane.LEARNING, beat, baseline_fitting.controller_of_filter, fitting.task, weights)
    artefact = context.store.put(controller)
    with context.database.writing() as session:
        shared = due_lending.find(session, job)
        if shared is None:
            for sha256 in {artefact} - withdrawal.in_use(session, [artefact]):
                context.store.delete(sha256)
            return
        shared.artefact_sha256 = artefact
        shared.metrics = {"notes": list(proven.draft.notes), "seconds": round(time.time() - started, 1)}
