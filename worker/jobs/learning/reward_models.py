"""Reward models: learn from everything one participant has said, then choose and predict what comes next."""

from typing import Any, NamedTuple

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from app.domain.choices import Strategy
from app.domain.models import Model, ModelKind
from app.domain.preferences import NO_OBVIOUS_PAIR, Query
from app.domain.studies import Participant, Study
from app.services.answers import stopping_advice
from worker.compute import learning
from worker.compute.pools import Lane
from worker.jobs.learning import dataset, query_selection, reward_metrics
from worker.jobs.learning.dataset import Preferences
from worker.jobs.runtime import records
from worker.jobs.runtime.context import Step, WorkerContext
from worker.jobs.runtime.records import Job

MOST_EARLIER = 100
"""Participants whose weights make up a pooled prior."""


def train_reward(context: WorkerContext, job: Job, run_id: int, step: Step) -> None:
    """Fit the participant's reward model and let it look ahead."""
    step("fit", _fit, context, run_id, job.participant)
    step("look-ahead", _look_ahead, context, job.participant)


def _fit(context: WorkerContext, run_id: int, participant_id: int) -> None:
    fitted = fit(context, run_id, participant_id, Lane.REWARDS)
    if fitted is None:
        return
    artefact = context.store.put(fitted.stored)
    with context.database.reading() as session:
        notes = notes_on_pairs(session, participant_id)
    metrics = fitted.metrics | {"notes": notes, **reward_metrics.insight(context, participant_id, fitted.stored)}
    with context.database.writing() as session:
        records.set_labels(session, run_id, fitted.labels.label_count, fitted.labels.label_hash)
        records.save_model(session, run_id, ModelKind.REWARD, artefact, metrics)
        participant = session.get_one(Participant, participant_id)
        stopping_advice.note(session, session.get_one(Study, participant.study_id), participant)


class Fitted(NamedTuple):
    """A reward model."""

    stored: bytes
    metrics: dict[str, Any]
    labels: Preferences


def fit(
    context: WorkerContext, run_id: int, participant_id: int, lane: Lane, first: int | None = None
) -> Fitted | None:
    """The reward model of a participant's labels, or of their ``first`` ones; None: nothing but "can't tell" so far."""
    with context.database.reading() as session:
        participant = session.get_one(Participant, participant_id)
        study = session.get_one(Study, participant.study_id)
        task, kind = study.task, study.settings.reward_kind
        earlier = earlier_models(session, participant, study) if study.settings.pooled_prior else []
        preferences = dataset.load_preferences(session, context.store, participant_id, first)
        scale = dataset.signal_scale(session, context.store, participant.study_id)
        recorded_signals = None if study.material is None else dataset.signal_names(study)
    if preferences.pairs is None:
        return None
    context.report(run_id, f"learning from {preferences.label_count} labels", 0.2)
    stored, metrics = context.compute.run(
        lane,
        context.beat(run_id),
        learning.fit_reward,
        task,
        kind.value,
        preferences.pairs,
        preferences.targets,
        scale,
        participant.seed,
        [context.store.read(model.artefact_sha256) for model in earlier],
        recorded_signals,
        preferences.mattered,
        preferences.hints,
    )
    return Fitted(stored, metrics, preferences)


def notes_on_pairs(session: Session, participant_id: int) -> list[str]:
    """What should be known about the pairs this participant was given."""
    substitutes = select(func.count(Query.id)).where(
        Query.participant_id == participant_id, Query.strategy == NO_OBVIOUS_PAIR
    )
    count = session.scalar(substitutes) or 0
    if not count:
        return []
    return [
        f"{count} catch pairs could not be had: the pool had no pair with an obvious answer. Repeats took the place."
    ]


def earlier_models(session: Session, participant: Participant, study: Study) -> list[Model]:
    """The finished models of those who joined before: what they said later must not change what was learned here."""
    wanted = study.settings.labels_per_participant
    others = records.models_of_others(session, participant.id, ModelKind.REWARD, wanted, MOST_EARLIER)
    return [model for model in others if model.participant_id is not None and model.participant_id < participant.id]


def _look_ahead(context: WorkerContext, participant_id: int) -> None:
    with context.database.reading() as session:
        participant = session.get_one(Participant, participant_id)
        settings = session.get_one(Study, participant.study_id).settings
    if settings.strategy is not Strategy.UNIFORM or settings.following_share:
        query_selection.choose_anew(context, participant_id)
    query_selection.predict_waiting(context, participant_id)
