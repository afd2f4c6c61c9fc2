"""Which pairs a participant gets, and that every prediction comes before its label."""

from collections import Counter
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from sqlalchemy import select

from app.db import Database
from app.domain.choices import Strategy
from app.domain.clips import Clip
from app.domain.models import ModelKind, Run
from app.domain.preferences import Query, Response
from app.domain.studies import Participant, Study
from app.storage import ArtefactDamaged, ArtefactStore
from tests import stored_files
from tests.waiting import until
from worker.compute.pools import Compute
from worker.domain.trajectory import SIGNALS
from worker.jobs.learning import dataset, query_selection, reward_models
from worker.jobs.runtime import records
from worker.jobs.runtime.context import WorkerContext
from worker.ml import acquisition
from worker.ml.rewards import reward_training
from worker.ml.rewards.reward_models import StructuredReward

AddClips = Callable[..., list[Clip]]
Answer = Callable[[Clip, Clip, Response], Query]
FIRST_SIGNAL = np.eye(len(SIGNALS))[0]
"""Weights of somebody who cares for one signal alone."""


@pytest.fixture
def context(database: Database, store: ArtefactStore) -> WorkerContext:
    return WorkerContext(database, store, Compute(1))


def queries_of(database: Database, participant: Participant) -> list[Query]:
    with database.reading() as session:
        return list(
            session.scalars(select(Query).where(Query.participant_id == participant.id).order_by(Query.ordinal))
        )


def test_no_pair_comes_twice_on_whichever_side(
    context: WorkerContext, participant: Participant, add_clips: AddClips
) -> None:
    for scenario in (1, 2, 3):
        add_clips(scenario)
    for _ in range(3):
        query_selection.refill_queries(context, participant.id)
    queries = queries_of(context.database, participant)
    pairs = Counter(frozenset((query.left_clip_id, query.right_clip_id)) for query in queries)
    assert len(queries) == records.QUERIES_AHEAD
    assert set(pairs.values()) == {1}
    assert [query.ordinal for query in queries] == list(range(1, len(queries) + 1))
    assert all(0.0 < query.propensity <= 1.0 for query in queries)


def test_the_same_study_gives_a_participant_the_same_pairs(
    context: WorkerContext, participant: Participant, add_clips: AddClips
) -> None:
    for scenario in (1, 2, 3):
        add_clips(scenario)
    query_selection.refill_queries(context, participant.id)
    first = [(query.left_clip_id, query.right_clip_id) for query in queries_of(context.database, participant)]
    with context.database.writing() as session:
        records.drop_unseen_queries(session, participant.id, keep=0)
    query_selection.refill_queries(context, participant.id)
    assert [(query.left_clip_id, query.right_clip_id) for query in queries_of(context.database, participant)] == first


def test_two_workers_refilling_at_once_make_the_queries_once(
    context: WorkerContext, participant: Participant, add_clips: AddClips
) -> None:
    clips = add_clips(1)
    row = {
        "ordinal": 1,
        "left_clip_id": clips[0].id,
        "right_clip_id": clips[1].id,
        "strategy": "uniform",
        "propensity": 1.0,
    }
    for _ in range(2):
        with context.database.writing() as session:
            records.save_queries(session, participant.id, [row])
    assert len(queries_of(context.database, participant)) == 1


def test_a_query_that_was_answered_in_the_meantime_keeps_its_older_prediction(
    context: WorkerContext, participant: Participant, add_clips: AddClips, answer: Answer
) -> None:
    clips = add_clips(1)
    answered = answer(clips[0], clips[1], Response.LEFT)
    with context.database.writing() as session:
        waiting = Query(
            participant_id=participant.id,
            ordinal=2,
            left_clip_id=clips[1].id,
            right_clip_id=clips[2].id,
            strategy="uniform",
            propensity=1.0,
        )
        session.add(waiting)
    model_id = save_reward_model(context, participant)
    with context.database.writing() as session:
        records.save_predictions(session, model_id, {answered.id: 0.9, waiting.id: 0.8})
    by_ordinal = queries_of(context.database, participant)
    assert [query.predicted_right for query in by_ordinal] == [None, 0.8]


def test_waiting_queries_are_predicted_by_the_newest_model(
    context: WorkerContext, participant: Participant, add_clips: AddClips, answer: Answer
) -> None:
    clips = add_clips(1)
    for left, right in ((0, 1), (1, 2), (2, 3)):
        answer(clips[left], clips[right], Response.RIGHT)
    model_id = save_reward_model(context, participant)
    query_selection.refill_queries(context, participant.id)
    waiting = queries_of(context.database, participant)[3:]
    assert waiting
    assert {query.predicted_by_model_id for query in waiting} == {model_id}
    assert all(query.predicted_right is not None and 0.0 < query.predicted_right < 1.0 for query in waiting)


@pytest.mark.parametrize("strategy", [Strategy.ENTROPY, Strategy.INFORMATION_GAIN, Strategy.DISAGREEMENT])
def test_a_strategy_needs_a_model_and_until_then_pairs_are_random(
    context: WorkerContext, participant: Participant, add_clips: AddClips, answer: Answer, strategy: Strategy
) -> None:
    settle_on(context, strategy)
    clips = add_clips(1) + add_clips(2) + add_clips(3)
    for left, right in ((0, 1), (1, 2), (2, 3)):
        answer(clips[left], clips[right], Response.RIGHT)
    query_selection.refill_queries(context, participant.id)
    assert {query.strategy for query in queries_of(context.database, participant)[3:]} == {"uniform"}
    with context.database.writing() as session:
        records.drop_unseen_queries(session, participant.id, keep=0)
    save_reward_model(context, participant)
    query_selection.refill_queries(context, participant.id)
    chosen = queries_of(context.database, participant)[3:]
    assert {query.strategy for query in chosen} == {strategy, "uniform"}, "a share is always drawn at random"
    assert len({query.propensity for query in chosen[:1]} | {1 / 15}) == 2, "not every pair was equally likely"


def test_contested_pairs_are_found_with_the_paper_s_users_before_others_have_answered(
    context: WorkerContext, participant: Participant, add_clips: AddClips
) -> None:
    settle_on(context, Strategy.CONTESTED)
    add_clips(1)
    add_clips(2)
    query_selection.refill_queries(context, participant.id)
    queries = queries_of(context.database, participant)
    assert {query.strategy for query in queries} == {Strategy.CONTESTED, "uniform"}
    assert all(query.propensity >= 0.5 / 12 for query in queries), "half of the chance is spread over all pairs"


def test_contested_pairs_are_those_other_participants_disagree_about(
    context: WorkerContext, participant: Participant, add_clips: AddClips, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two others who want opposite things about a single signal: where it differs most they disagree most."""
    settle_on(context, Strategy.CONTESTED)
    add_clips(1)
    two_who_disagree_about_the_first_signal(context, participant)
    seen: list[npt.NDArray[np.float64]] = []

    def contested(said: npt.NDArray[np.float64], own: None) -> npt.NDArray[np.float64]:
        seen.append(disagreement(said, own))
        return seen[-1]

    disagreement = acquisition.contested
    monkeypatch.setattr(acquisition, "contested", contested)
    query_selection.refill_queries(context, participant.id)
    differences = differences_of_pairs(context, participant)
    assert np.argsort(seen[0]).tolist() == np.argsort(differences).tolist()


def test_contested_pairs_are_not_asked_where_this_person_s_own_model_is_sure(
    context: WorkerContext, participant: Participant, add_clips: AddClips, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Others disagree about one signal, and this person's model is sure of just that."""
    settle_on(context, Strategy.CONTESTED)
    add_clips(1)
    two_who_disagree_about_the_first_signal(context, participant)
    save_model_of(context, participant.study_id, participant.id, 1e4 * FIRST_SIGNAL, labels=5)
    scores: list[npt.NDArray[np.float64]] = []
    choose = acquisition.choose

    def chosen(*arguments: Any, **named: Any) -> acquisition.Choice:
        scores.append(named["scores"])
        return choose(*arguments, **named)

    monkeypatch.setattr(acquisition, "choose", chosen)
    query_selection.refill_queries(context, participant.id)
    differs = differences_of_pairs(context, participant) > 0.0
    assert differs.any()
    assert scores[0][differs].max() < 1e-6


def test_a_pooled_prior_is_of_those_who_joined_before_and_have_answered_everything(
    context: WorkerContext, participant: Participant
) -> None:
    wish = np.ones(len(SIGNALS))
    finished = somebody_else(context, participant, 2, wish, labels=20)
    somebody_else(context, participant, 3, wish, labels=19)
    last = somebody_else(context, participant, 4, wish, labels=20)
    with context.database.reading() as session:
        study = session.scalars(select(Study)).one()
        newcomers = [session.get_one(Participant, each) for each in (participant.id, finished, last)]
        earlier = [reward_models.earlier_models(session, each, study) for each in newcomers]
    assert [[model.participant_id for model in each] for each in earlier] == [[], [], [finished]]


def two_who_disagree_about_the_first_signal(context: WorkerContext, participant: Participant) -> None:
    """Add two other participants who want the opposite of each other."""
    for number, sign in ((2, 1.0), (3, -1.0)):
        somebody_else(context, participant, number, sign * FIRST_SIGNAL, query_selection.OTHERS_LABELS)


def differences_of_pairs(context: WorkerContext, participant: Participant) -> npt.NDArray[np.float64]:
    """By how much the clips of each pair that may be asked differ in the first signal, (P,)."""
    with context.database.reading() as session:
        clips = dataset.pool_clips(session, participant.study_id)
    sums = {clip.id: dataset.shown(context.store, clip).signals[:, 0].sum() for clip in clips}
    return np.array([abs(sums[left.id] - sums[right.id]) for left, right in dataset.matched_pairs(clips)])


def somebody_else(
    context: WorkerContext, participant: Participant, number: int, weights: npt.NDArray[np.float64], labels: int
) -> int:
    """Another participant of the study with a reward model of these weights; returns their id."""
    with context.database.writing() as session:
        other = Participant(study_id=participant.study_id, number=number, token_sha256=f"{number:064}", seed=1)
        session.add(other)
        session.flush()
        other_id = other.id
    save_model_of(context, participant.study_id, other_id, weights, labels)
    return other_id


def test_without_its_newest_model_s_file_the_pairs_are_chosen_and_foreseen_by_the_one_before(
    context: WorkerContext, participant: Participant, add_clips: AddClips
) -> None:
    add_clips(1)
    settle_on(context, Strategy.ENTROPY)
    save_model_of(context, participant.study_id, participant.id, FIRST_SIGNAL, labels=5)
    save_model_of(context, participant.study_id, participant.id, 2 * FIRST_SIGNAL, labels=10)
    with context.database.reading() as session:
        newest, older = records.models_of(session, participant.id, ModelKind.REWARD)
    stored_files.damage(context.store, newest.artefact_sha256)
    with pytest.raises(ArtefactDamaged):  # nobody knew
        query_selection.refill_queries(context, participant.id)
    assert until(lambda: newest.artefact_sha256 in context.store.lost())
    query_selection.refill_queries(context, participant.id)
    queries = queries_of(context.database, participant)
    assert queries
    assert {query.predicted_by_model_id for query in queries} == {older.id}


def save_model_of(
    context: WorkerContext, study_id: int, participant_id: int, weights: npt.NDArray[np.float64], labels: int
) -> None:
    """Give a participant a reward model of these weights."""
    stored = StructuredReward(np.tile(weights, (8, 1))).to_bytes()
    with context.database.writing() as session:
        name = f"reward-{participant_id}-{labels}"
        run = Run(workflow_id=name, kind="reward", study_id=study_id, participant_id=participant_id, seed=0)
        session.add(run)
        session.flush()
        records.set_labels(session, run.id, labels, "hash")
        records.save_model(session, run.id, ModelKind.REWARD, context.store.put(stored), {})


def settle_on(context: WorkerContext, strategy: Strategy, **shares: float) -> None:
    """Have the study choose its pairs like this."""
    with context.database.writing() as session:
        study = session.scalars(select(Study)).one()
        study.stored_settings = {**study.stored_settings, "strategy": strategy, **shares}


def save_reward_model(context: WorkerContext, participant: Participant) -> int:
    """A reward model fitted to whatever the participant has said."""
    with context.database.reading() as session:
        preferences = dataset.load_preferences(session, context.store, participant.id)
    assert preferences.pairs is not None
    fitted = reward_training.fit(preferences.pairs, preferences.targets, "structured", 0)
    with context.database.writing() as session:
        run = Run(workflow_id="reward", kind="reward", study_id=participant.study_id, participant_id=participant.id)
        session.add(run)
        session.flush()
        run.seed = 0
        records.set_labels(session, run.id, preferences.label_count, preferences.label_hash)
        artefact = context.store.put(fitted.model.to_bytes())
        return records.save_model(session, run.id, ModelKind.REWARD, artefact, fitted.metrics).id
