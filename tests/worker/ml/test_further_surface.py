"""Modes of somebody whom weighted sums of signals do not say: what the pool shows, and what trials teach."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.worker import invented
from tests.worker.ml.test_pbarl import CONFIG, FAMILY, POLICY, SPEED, World, mode_act, speed_of, surface
from worker.domain.scenarios import GATE, first_of
from worker.domain.trajectory import SIGNALS, Trajectory
from worker.ml.filters.fitting import mode_search
from worker.ml.filters.fitting.filter_problem import FilterProblem
from worker.ml.filters.fitting.further_surface import FurtherSurface
from worker.ml.filters.fitting.pool import Pool
from worker.ml.filters.fitting.response_surface import ResponseSurface, monomials
from worker.ml.rewards.beyond_sums.terms import FurtherTerms, RicherReward
from worker.ml.rewards.reward_models import StructuredReward

__all__ = ["surface"]
TERMS = FurtherTerms("worst_moments", SIGNALS, (), np.zeros(0), np.zeros(0))
NOTHING = np.zeros((4, len(SIGNALS)))


@pytest.fixture(scope="module")
def reference() -> list[Trajectory]:
    return World().collect(POLICY.mean, first_of(GATE, 6), 0.0, 0)


@pytest.fixture(scope="module")
def pool() -> Pool:
    """Four modes in each of twelve scenarios."""
    rng = np.random.default_rng(5)
    rollouts, described = [], []
    for scenario in range(200, 212):
        for mode in FAMILY.sample(4, rng):
            rollouts += World().collect(mode_act(mode), [scenario], 0.0, 0)
            described.append({"mode": FAMILY.named(mode)})
    return Pool(rollouts, described)


def who_minds_the_fastest_moment(reference: list[Trajectory]) -> RicherReward:
    """And nothing that a sum of signals says."""
    weights = np.zeros((4, TERMS.width))
    weights[:, len(SIGNALS)] = -1.0
    reward = RicherReward.with_terms(StructuredReward(weights), TERMS, NOTHING)
    return reward.normalised_over(reference)


def test_a_mode_is_found_for_what_no_sum_of_signals_says(
    reference: list[Trajectory], surface: ResponseSurface, pool: Pool
) -> None:
    problem = FilterProblem(invented.TASK, POLICY, who_minds_the_fastest_moment(reference), 0, CONFIG)
    unseen = World().collect(POLICY.mean, range(20), 0.0, 0)
    plain = np.mean([each.signals[:, SPEED].mean() for each in unseen])
    found = mode_search.find_mode(problem, surface, pool, reference, World().collect)
    assert found.weights.gate == 1.0
    assert speed_of(found) < 0.7 * plain
    nobody = mode_search.find_mode(problem, surface, Pool(), reference, World().collect)
    assert nobody.weights.moves_nothing, "without a pool nothing is known to try"


def test_of_all_that_are_tried_the_best_is_taken_and_no_more_are_tried_than_the_settings_say(
    reference: list[Trajectory], surface: ResponseSurface, pool: Pool
) -> None:
    config = replace(CONFIG, mode_attempts_beyond_sums=4)
    problem = FilterProblem(invented.TASK, POLICY, who_minds_the_fastest_moment(reference), 0, config)
    found = mode_search.find_mode(problem, surface, pool, reference, World().collect)
    assert 2 <= len(found.trials) <= 4
    assert found.trials[-1].preference == max(trial.preference for trial in found.trials)


def test_what_a_trial_shows_counts_more_than_what_the_pool_lets_expect(reference: list[Trajectory], pool: Pool) -> None:
    reward = who_minds_the_fastest_moment(reference)
    known = FurtherSurface.of_pool(reward, NOTHING[0], pool, FAMILY)
    mode = FAMILY.sample(1, np.random.default_rng(9))[0]
    driven = World().collect(mode_act(mode), [each.scenario for each in reference] * 20, 0.0, 0)
    truly = (reward.returns(driven) - reward.returns(reference * 20)).mean()
    expected, learned = (
        monomials(mode) @ each.coefficients for each in (known, known.with_observed(mode, reference * 20, driven))
    )
    assert abs(learned - truly) < 0.1 * abs(truly) < abs(expected - truly)


def test_only_episodes_in_which_nothing_but_the_mode_differed_say_what_modes_do(reference: list[Trajectory]) -> None:
    slow = {FAMILY.names[0]: -0.5}
    dressed: list[dict[str, Any]] = [{"mode": slow, "temperature": 0.4}, {"checkpoint": "early"}]
    of_another_version = {"mode": {"hop": 1.0}}
    described = [{}, {"mode": slow}, *dressed, of_another_version, {}]
    modes, rollouts = Pool(reference, described).in_modes(FAMILY)
    assert modes[:, 0].tolist() == [0.0, -0.5, 0.0]
    assert rollouts == [reference[0], reference[1], reference[5]]
    forged: list[dict[str, Any]] = [
        {"mode": each} for each in (7, ["x"], {FAMILY.names[0]: "x"}, {FAMILY.names[0]: 1e200})
    ]
    assert not len(Pool(reference[:4], forged).in_modes(FAMILY)[0])
    with pytest.raises(ValueError, match="as many descriptions"):
        Pool(reference, described[1:])
