"""Pairs that are made for one person while they answer: what their filter would do now, beside a variation of it.

After every reward model of FROM_ANSWER labels or more a few are made, each in a scenario of its own that nothing else
uses; as soon as one is there, the pairs that nobody has seen are chosen anew. A pair counts until there is a newer
model: then others are made, and it is not shown any more, if it was not before.
"""

from dataclasses import replace
from math import ceil

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from app.domain.clips import Rollout
from app.domain.models import ModelKind, RunKind
from app.domain.run_keys import MADE, RunKey
from app.domain.studies import Participant, Study
from app.domain.study_settings import StudySettings
from worker.compute import made_pairs, simulation
from worker.compute.behaviours import Behaviour
from worker.compute.pools import Lane
from worker.domain import scenarios
from worker.jobs.clips.stored_video import rows_of_clip
from worker.jobs.learning import query_selection
from worker.jobs.runtime import records
from worker.jobs.runtime.context import Step, WorkerContext
from worker.jobs.runtime.records import QUERIES_AHEAD, Job

FROM_ANSWER = 10
"""A model of fewer answers has no say: it names modes almost at random."""


def due(session: Session, study: Study, reward: RunKey) -> list[Job]:
    """Pairs for whoever goes on answering after the reward model of ``reward``; not for previews, of which no archive
    and no export may know."""
    if not study.settings.following_share or (reward.labels or 0) < FROM_ANSWER:
        return []
    if session.get_one(Participant, reward.participant_id).is_preview:
        return []
    return [Job(replace(reward, kind=RunKind.CLIPS, subject=MADE), study.id)]


def is_about(job: Job) -> bool:
    """Whether the job makes pairs for somebody."""
    return job.about.subject == MADE


def at_most(settings: StudySettings) -> int:
    """How many pairs are made after one model: as many as can be expected to be shown before the next."""
    return ceil(settings.following_share * min(settings.retrain_every_labels, QUERIES_AHEAD))


def make(context: WorkerContext, job: Job, run_id: int, step: Step) -> None:
    """Make the pairs one after the other, as long as no newer model is there."""
    model_id, first, count = step("plan", _plan, context, job)
    for index in range(count):
        context.report(run_id, f"filming a pair that follows, {index + 1} of {count}", index / count)
        if not step(f"pair-{index}", _make_one, context, run_id, job, model_id, first + index):
            return
        step(f"choose-{index}", query_selection.choose_anew, context, job.participant)


def _plan(context: WorkerContext, job: Job) -> list[int]:
    """The model that is followed, the number of the first pair, and how many to make."""
    with context.database.reading() as session:
        model = records.newest_model(session, job.participant, ModelKind.REWARD)
        theirs = select(func.count(Rollout.id)).where(Rollout.participant_id == job.participant)
        first = (session.scalar(theirs) or 0) // 2
        count = at_most(session.get_one(Study, job.study_id).settings)
    return [model.id, first, min(count, scenarios.MOST_MADE - first)] if model is not None else [0, 0, 0]


def _make_one(context: WorkerContext, run_id: int, job: Job, model_id: int, number: int) -> bool:
    """Whether the pair is there now; False when there is a newer model, or nothing to vary."""
    with context.database.reading() as session:
        study, participant = session.get_one(Study, job.study_id), session.get_one(Participant, job.participant)
        model = records.newest_model(session, participant.id, ModelKind.REWARD)
    if model is None or model.id != model_id:
        return False
    settings, beat = study.settings, context.beat(run_id)
    stored = context.store.read(model.artefact_sha256)
    asked = (study.task, stored, settings.clip_steps, participant.seed, number)
    modes = context.compute.run(Lane.REWARDS, beat, made_pairs.modes_of_pair, *asked)
    scenario, quality = scenarios.of_made(study.seed, number), settings.clip_quality.value
    behaviours = [Behaviour(mode) for mode in modes]
    shots = [(study.task, quality, scenario, each, 0, settings.clip_steps) for each in behaviours]
    recorded = context.compute.run_all(Lane.CLIPS, beat, simulation.record_clip, shots)
    numbered = enumerate(zip(recorded, behaviours, strict=True), 2 * participant.number)
    rows = [
        rows_of_clip(context.store, each, scenario, place, behaviour, settings.clip_steps)
        for place, (each, behaviour) in numbered
    ]
    with context.database.writing() as session:
        for rollout, clip in rows:
            records.save_clip(session, study.id, {**rollout, "participant_id": participant.id}, clip)
    return bool(rows)
