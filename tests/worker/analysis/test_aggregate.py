"""Interquartile means, probabilities of improvement and their bootstrap, beside cases worked out by hand."""

import numpy as np
import pytest

from worker.analysis.comparison import aggregate
from worker.domain.type_aliases import FloatArray


def strata(*means: tuple[float, ...], scenarios: int = 50, spread: float = 0.0) -> list[FloatArray]:
    """Per stratum and seed a mean; its scenarios lie around it."""
    noise = spread * np.random.default_rng(0).standard_normal(scenarios)
    return [np.array([mean + noise - noise.mean() for mean in seeds]) for seeds in means]


def test_the_interquartile_mean_is_that_of_the_middle_half_of_all_runs() -> None:
    runs = [np.array([100.0, 3.0, 4.0, -100.0]), np.array([5.0, 6.0, 1.0, 8.0])]
    assert aggregate.interquartile_mean(runs) == pytest.approx((3 + 4 + 5 + 6) / 4)


def test_the_probability_of_improvement_counts_all_pairs_of_runs_and_ties_half() -> None:
    own, other = [np.array([1.0, 3.0]), np.array([5.0, 5.0])], [np.array([2.0, 3.0]), np.array([0.0, 0.0])]
    assert aggregate.probability_of_improvement(own, other) == pytest.approx((1.5 / 4 + 1.0) / 2)


def test_profiles_are_shares_of_runs() -> None:
    assert aggregate.profile(strata((0.0, 0.1), (0.2, 0.3)), (-1.0, 0.15, 0.4)) == [1.0, 0.5, 0.0]


def test_a_method_beside_itself_differs_by_nothing_whatever_is_drawn() -> None:
    same = strata((0.1, 0.3), (0.2, 0.7), spread=1.0)
    assert aggregate.compare(same, same, aggregate.difference) == (0.0, 0.0, 0.0)
    assert aggregate.compare(same, same, aggregate.probability_of_improvement).value == 0.5


def test_intervals_see_scenarios_with_one_seed_and_seeds_where_there_are_several() -> None:
    scenarios = np.random.default_rng(1).standard_normal(400)
    alone = aggregate.estimate([scenarios[None]])
    assert (alone.low, alone.high) == pytest.approx(
        (scenarios.mean() - 1.96 * 0.05 * scenarios.std(), scenarios.mean() + 1.96 * 0.05 * scenarios.std()), abs=0.015
    )
    apart = aggregate.estimate(strata((0.0, 1.0, 2.0, 3.0), spread=0.01))
    assert apart.value == pytest.approx(1.5)
    assert apart.low < 1.0 < 2.0 < apart.high


def test_methods_without_the_same_seeds_and_scenarios_are_not_compared() -> None:
    with pytest.raises(ValueError, match="same seeds"):
        aggregate.compare(strata((0.1, 0.2)), strata((0.1,)), aggregate.difference)
