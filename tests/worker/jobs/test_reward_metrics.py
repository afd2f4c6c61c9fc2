"""What a reward model says beside its predictions: the clips it likes, and whether more labels would still pay."""

from collections.abc import Callable

import numpy as np
import pytest

from app.db import Database
from app.domain.choices import Strategy
from app.domain.clips import Clip
from app.domain.studies import Participant
from app.storage import ArtefactStore
from tests.worker.jobs import test_query_selection
from worker.compute.made_pairs import modes_of_pair
from worker.compute.pools import Compute
from worker.compute.simulation import surface_file
from worker.domain.trajectory import COSTS, SIGNALS
from worker.jobs.learning import dataset, query_selection, reward_metrics
from worker.jobs.runtime.context import WorkerContext
from worker.ml.filters.fitting.response_surface import ResponseSurface
from worker.ml.rewards.beyond_sums.terms import FurtherTerms, RicherReward
from worker.ml.rewards.reward_models import StructuredReward
from worker.ml.stopping import relative_regret
from worker.tasks.registry import task

AddClips = Callable[..., list[Clip]]


@pytest.fixture
def context(database: Database, store: ArtefactStore) -> WorkerContext:
    return WorkerContext(database, store, Compute(1))


def test_clips_are_ranked_by_what_the_model_likes(
    context: WorkerContext, participant: Participant, add_clips: AddClips
) -> None:
    add_clips(1)
    add_clips(2)
    likes_one_signal = StructuredReward(np.tile(np.eye(len(SIGNALS))[2], (8, 1)))
    ranking = reward_metrics.insight(context, participant.id, likes_one_signal.to_bytes())["ranking"]
    with context.database.reading() as session:
        clips = dataset.pool_clips(session, participant.study_id)
        sums = {
            (clip.rollout.scenario, clip.rollout.behaviour): dataset.shown(context.store, clip).signals[:, 2].sum()
            for clip in clips
        }
    assert [(scenario, behaviour) for scenario, behaviour, _ in ranking] == sorted(sums, key=lambda name: -sums[name])
    returns = np.array([value for *_, value in ranking])
    assert returns.mean() == pytest.approx(0.0, abs=1e-3)
    assert returns.std() == pytest.approx(1.0, abs=1e-2)


def test_what_a_model_thinks_of_the_six_costs_is_found_whatever_it_was_learned_from(rng: np.random.Generator) -> None:
    costs = rng.standard_normal((60, 6)) * (1.0, 10.0, 0.1, 5.0, 1.0, 0.0)
    wishes = np.array([0.0, -0.3, 0.0, -0.2, 0.0, 0.0]) + 0.02 * rng.standard_normal((6, 6))
    found = reward_metrics.weights_of_costs(costs, wishes @ costs.T)
    weights = found["weights"]
    assert list(weights) == ["C_d", "C_v", "C_f", "C_hf", "C_fd"], "the last one is the same in all clips"
    assert [name for name, each in weights.items() if each["high"] < 0] == ["C_v", "C_hf"]
    assert weights["C_v"]["mean"] < weights["C_hf"]["mean"]
    assert found["explained"] > 0.95


def test_a_model_that_wants_something_else_explains_little_by_the_costs(rng: np.random.Generator) -> None:
    costs, returns = rng.standard_normal((200, 6)), rng.standard_normal((8, 200))
    found = reward_metrics.weights_of_costs(costs, returns)
    assert found["explained"] < 0.2
    assert np.mean([each["low"] < 0 < each["high"] for each in found["weights"].values()]) > 0.6


def test_a_model_says_what_it_thinks_of_the_costs_of_the_studys_clips(
    context: WorkerContext, participant: Participant, add_clips: AddClips
) -> None:
    fears_spilling = StructuredReward(np.tile(-np.eye(len(SIGNALS))[SIGNALS.index("spilled_on_person")], (8, 1)))
    add_clips(1)
    assert "costs" not in reward_metrics.insight(context, participant.id, fears_spilling.to_bytes()), (
        "too few clips to tell"
    )
    for scenario in (2, 3, 4, 5):
        add_clips(scenario)
    with context.database.reading() as session:
        clips = dataset.pool_clips(session, participant.study_id)
        assert len(clips) >= reward_metrics.FEWEST_CLIPS
    found = reward_metrics.insight(context, participant.id, fears_spilling.to_bytes())["costs"]
    assert list(found["weights"]) == list(COSTS)
    assert 0.0 <= found["explained"] <= 1.0


def test_nobody_is_advised_to_stop_by_sums_that_do_not_say_what_they_want(
    context: WorkerContext, participant: Participant
) -> None:
    terms = FurtherTerms("worst_moments", SIGNALS, (), np.zeros(0), np.zeros(0))
    weights = np.random.default_rng(3).standard_normal((8, terms.width))
    linear = StructuredReward(weights[:, : len(SIGNALS)])
    richer = RicherReward.with_terms(StructuredReward(weights), terms, linear.weights)
    assert "advice" in reward_metrics.insight(context, participant.id, linear.to_bytes())
    assert "advice" not in reward_metrics.insight(context, participant.id, richer.to_bytes())
    assert modes_of_pair("feeding", linear.to_bytes(), 60, 0, 0)
    assert not modes_of_pair("feeding", richer.to_bytes(), 60, 0, 0), "nor is a pair made by such sums"


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(5)


@pytest.fixture(scope="module")
def surface() -> ResponseSurface:
    return ResponseSurface.load(surface_file("feeding"), task("feeding").modes)


def test_somebody_who_is_known_for_certain_leaves_nothing_to_gain(surface: ResponseSurface) -> None:
    wish = np.random.default_rng(1).standard_normal(len(SIGNALS))
    assert relative_regret(surface, np.tile(wish, (8, 1))) == pytest.approx(0.0, abs=1e-9)


def test_the_less_is_known_the_more_could_be_gained(surface: ResponseSurface) -> None:
    rng = np.random.default_rng(2)
    wish, doubt = rng.standard_normal(len(SIGNALS)), rng.standard_normal((8, len(SIGNALS)))
    regrets = [relative_regret(surface, wish + spread * doubt) for spread in (0.05, 0.5, 5.0)]
    assert 0.0 <= regrets[0] < regrets[1] < regrets[2]
    louder = relative_regret(surface, 7.0 * (wish + 0.5 * doubt))
    assert louder == pytest.approx(regrets[1]), "nobody has to answer more because they feel more strongly"


def test_of_somebody_who_minds_nothing_nothing_is_asked(surface: ResponseSurface) -> None:
    assert relative_regret(surface, np.zeros((8, len(SIGNALS)))) == 0.0


def test_a_share_of_the_pairs_is_drawn_at_random_and_stored_as_such(
    context: WorkerContext, participant: Participant, add_clips: AddClips
) -> None:
    """Only these measure a model without bias."""
    test_query_selection.settle_on(context, Strategy.CONTESTED)
    for scenario in (1, 2, 3, 4):
        add_clips(scenario)
    query_selection.refill_queries(context, participant.id)
    queries = test_query_selection.queries_of(context.database, participant)
    uniform = [query for query in queries if query.strategy == Strategy.UNIFORM]
    chosen = [query for query in queries if query.strategy == Strategy.CONTESTED]
    assert uniform
    assert len(uniform) + len(chosen) == len(queries)
    assert np.mean([query.propensity for query in chosen]) > np.mean([query.propensity for query in uniform])
