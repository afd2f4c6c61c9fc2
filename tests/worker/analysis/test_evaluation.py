"""Numbers about a filter: paired differences, and their intervals."""

import json

import numpy as np
import pytest
from scipy import stats
from statsmodels.stats.proportion import proportion_confint

from app.services.answers import accuracy
from tests.worker import invented
from worker.analysis.filters.evaluation import evaluate, mean_change, success_change
from worker.analysis.wilson import wilson_interval
from worker.domain.trajectory import COSTS, Trajectory


def test_wilson_s_interval_matches_published_values() -> None:
    """Newcombe (1998), Statistics in Medicine 17, table I, method 3: 81/263 and 0/20."""
    assert wilson_interval(81, 263) == pytest.approx((0.2553, 0.3662), abs=1e-4)
    assert wilson_interval(0, 20) == pytest.approx((0.0, 0.1611), abs=1e-4)


@pytest.mark.parametrize(("correct", "scored"), [(0, 0), (3, 2), (-1, 5)])
def test_a_proportion_of_nothing_is_refused(correct: int, scored: int) -> None:
    with pytest.raises(ValueError, match="not a proportion"):
        wilson_interval(correct, scored)


@pytest.mark.parametrize(("correct", "scored"), [(0, 1), (1, 1), (2.5, 7), (8, 8), (30, 200)])
def test_both_servers_have_the_same_interval_and_it_is_that_of_statsmodels(correct: float, scored: int) -> None:
    here, there = wilson_interval(correct, scored), accuracy.wilson(correct, scored)
    assert here == pytest.approx(proportion_confint(correct, scored, method="wilson"))
    assert here == pytest.approx((there.low, there.high))


def episodes(count: int, rng: np.random.Generator, cost: float = 0.0, success: bool = True) -> list[Trajectory]:
    """One episode per scenario; scenarios differ much more than filters do."""
    return [
        invented.trajectory(
            np.random.default_rng(scenario),
            scenario=scenario,
            success=success,
            costs=np.full((20, len(COSTS)), 1.0 + scenario + cost) + 0.01 * rng.standard_normal((20, len(COSTS))),
        )
        for scenario in range(count)
    ]


def test_pairing_by_scenario_finds_a_small_difference_among_large_ones() -> None:
    rng = np.random.default_rng(0)
    found = evaluate(episodes(50, rng), episodes(50, rng, cost=0.1), np.arange(50), np.arange(50) + 1.0, invented.TASK)
    change = found["costs"]["C_v"]
    assert change["delta"] == pytest.approx(2.0, abs=0.1)
    assert change["low"] > 1.9
    assert change["high"] < 2.1


def test_preference_is_in_standard_deviations_of_the_reference_s_returns() -> None:
    rng = np.random.default_rng(0)
    before = rng.standard_normal(50) * 40
    found = evaluate(episodes(50, rng), episodes(50, rng), before, before + 80, invented.TASK)
    assert found["preference"]["delta"] == pytest.approx(80 / before.std())


def test_the_result_is_plain_and_complete() -> None:
    rng = np.random.default_rng(0)
    found = json.loads(
        json.dumps(evaluate(episodes(5, rng), episodes(5, rng), np.zeros(5), np.zeros(5), invented.TASK))
    )
    assert found["scenarios"] == 5
    assert set(found["costs"]) == set(COSTS)
    assert set(found["success"]) == {"reference", "filter", "delta", "low", "high"}


def test_different_scenarios_cannot_be_compared() -> None:
    rng = np.random.default_rng(0)
    with pytest.raises(ValueError, match="same scenarios"):
        evaluate(episodes(5, rng), episodes(5, rng)[::-1], np.zeros(5), np.zeros(5), invented.TASK)


def test_the_success_interval_covers_the_truth_about_as_often_as_it_says() -> None:
    rng = np.random.default_rng(0)
    covered = 0
    for _ in range(200):
        before = (rng.random(150) < 0.95).astype(float)
        after = np.where(rng.random(150) < 0.06, 0.0, before)
        found = success_change(before, after)
        covered += found["low"] <= -0.06 * 0.95 <= found["high"]
    assert covered > 0.92 * 200


def test_the_success_interval_matches_a_published_example() -> None:
    """Newcombe (1998), table III, method 10: 2 x 2 counts 36, 12, 2, 0 give 0.2 with 0.0569 to 0.3404."""
    before = np.repeat([1.0, 0.0, 1.0, 0.0], [36, 12, 2, 0])
    after = np.repeat([1.0, 1.0, 0.0, 0.0], [36, 12, 2, 0])
    found = success_change(before, after)
    assert (found["delta"], found["low"], found["high"]) == pytest.approx((0.2, 0.0569, 0.3404), abs=2e-4)


def test_success_that_never_changed_is_still_uncertain() -> None:
    found = success_change(np.ones(80), np.ones(80))
    assert found["delta"] == 0.0
    assert found["low"] < 0.0 < found["high"]


def test_a_difference_of_means_has_students_interval() -> None:
    change = np.random.default_rng(1).standard_normal(12)
    found = mean_change(np.zeros(12), change)
    assert [found["low"], found["high"]] == pytest.approx(stats.ttest_1samp(change, 0).confidence_interval())


@pytest.mark.parametrize("before", [99, 98, 97, 91])
def test_a_loss_of_success_is_as_large_as_the_episodes_say(before: int) -> None:
    """Three of 100 are within a tolerance of 3 points, though .96 - .99 is a little less than -.03."""
    episodes = np.arange(100)
    change = success_change((episodes < before).astype(float), (episodes < before - 3).astype(float))
    assert change["delta"] >= -0.03
