"""What each participant is asked next, and what the newest model expects them to say."""

import numpy as np
from sqlalchemy import select
from sqlalchemy.orm import Session

from app.domain.clips import Clip
from app.domain.models import ModelKind
from app.domain.preferences import Query
from app.domain.studies import Participant, Strategy, Study
from worker import dataset, laboratory, lessons, records
from worker.ml import acquisition
from worker.ml.teachers import OMEGA, User
from worker.sim.costs import preference_rewards
from worker.tasks import Task
from worker.workplace import Workplace

OTHERS_LABELS = 20
"""So many answers a participant has given before their model speaks for them to others."""
MOST_OTHERS = 12
"""More people cost time and hardly change on which pairs people differ."""


def refill_queries(place: Workplace, participant_id: int) -> None:
    """Make the queries the participant will meet next. Safe to call at any time, by any number of workers."""
    with place.database.reading() as session:
        participant = session.get_one(Participant, participant_id)
        study = session.get_one(Study, participant.study_id)
        ordinal, wanted = records.next_queries(session, participant_id, study.settings)
        pairs = _unused_pairs(session, participant)
        scores = _scores(place, session, participant, pairs, study.settings.strategy) if wanted and pairs else None
    if not wanted or not pairs:
        return
    choice = acquisition.choose(
        wanted,
        len(pairs),
        np.random.default_rng([participant.seed, ordinal]),
        rule="uniform" if scores is None else study.settings.strategy.value,
        scores=scores,
        random_share=study.settings.random_share,
    )
    rows = []
    for turn, index in enumerate(choice.indices):
        left, right = reversed(pairs[index]) if choice.swapped[turn] else pairs[index]
        rows.append(
            {
                "ordinal": ordinal + turn,
                "left_clip_id": left.id,
                "right_clip_id": right.id,
                "strategy": Strategy.UNIFORM if scores is None else study.settings.strategy,
                "propensity": float(choice.propensities[turn]),
            }
        )
    with place.database.writing() as session:
        records.save_queries(session, participant_id, ordinal, rows)
    predict_waiting(place, participant_id)


def predict_waiting(place: Workplace, participant_id: int) -> None:
    """Write the newest model's prediction to every query that has never been answered: honest by construction."""
    with place.database.reading() as session:
        model = records.newest_model(session, participant_id, ModelKind.REWARD)
        queries = records.unanswered(session, participant_id, *dataset.CLIPS_AND_ROLLOUTS)
        if model is None or all(query.predicted_by_model_id == model.id for query in queries):
            return
        pairs = dataset.segment_pairs(place.store, [(query.left_clip, query.right_clip) for query in queries])
        ids = [query.id for query in queries]
    probabilities = lessons.probability_right(place.store.read(model.artefact_sha256), pairs)
    with place.database.writing() as session:
        records.save_predictions(session, model.id, dict(zip(ids, probabilities, strict=True)))


def _scores(
    place: Workplace, session: Session, participant: Participant, pairs: list[tuple[Clip, Clip]], strategy: Strategy
) -> acquisition.Floats | None:
    """How much every candidate is worth asking; None when the choice is to be uniform."""
    if strategy is Strategy.CONTESTED:
        return acquisition.contested(_answers_of_others(place, session, participant, pairs))
    model = records.newest_model(session, participant.id, ModelKind.REWARD)
    if strategy is Strategy.UNIFORM or model is None:
        return None
    segments = dataset.segment_pairs(place.store, pairs)
    members = lessons.member_probabilities(place.store.read(model.artefact_sha256), segments)
    return acquisition.score(strategy.value, members)


def _answers_of_others(
    place: Workplace, session: Session, participant: Participant, pairs: list[tuple[Clip, Clip]]
) -> acquisition.Floats:
    """(U, M) what other people would say about each pair: participants, or the paper's users while there are few."""
    others = records.models_of_others(session, participant.id, ModelKind.REWARD, OTHERS_LABELS, MOST_OTHERS)
    if len(others) >= 2:
        segments = dataset.segment_pairs(place.store, pairs)
        said = [lessons.probability_right(place.store.read(model.artefact_sha256), segments) for model in others]
        return np.array(said, np.float64)
    task = laboratory.task(session.get_one(Study, participant.study_id).task)
    returns = {clip.id: _stand_ins(place, task, clip) for pair in pairs for clip in pair}
    return acquisition.expected_answers(np.array([returns[right.id] - returns[left.id] for left, right in pairs]).T)


def _stand_ins(place: Workplace, task: Task, clip: Clip) -> acquisition.Floats:
    """(3,) what the paper's users would feel about what a clip shows, by their own costs."""
    shown, steps = dataset.shown(place.store, clip), slice(clip.first_step, clip.first_step + clip.step_count)
    costs, signals = shown.costs[steps], shown.signals[steps]
    return np.array([preference_rewards(task, costs, signals, OMEGA[user]).sum() for user in User])


def _unused_pairs(session: Session, participant: Participant) -> list[tuple[Clip, Clip]]:
    """Pairs of clips of one scenario that this participant has not been given yet, on either side."""
    clips = dataset.pool_clips(session, participant.study_id)
    used = {
        frozenset(pair)
        for pair in session.execute(
            select(Query.left_clip_id, Query.right_clip_id).where(Query.participant_id == participant.id)
        )
    }
    return [pair for pair in dataset.matched_pairs(clips) if frozenset(clip.id for clip in pair) not in used]
