"""Power by simulation: what theory says where it knows, and no more than 5 % where there is nothing to find."""

from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy import stats
from statsmodels.stats.power import TTestIndPower, TTestPower

from app.domain.power_plan import PowerTest
from worker.analysis.study.between import BETWEEN_TESTS
from worker.analysis.study.effect_sizes import holm
from worker.analysis.study.power import Truth, _is_found, _ratings_find, enough, power_at, ratings_p
from worker.analysis.study.statistics import scale_report

PAIRED = Truth(
    methods=2,
    better=1,
    compared=0,
    arms=((0, 1),),
    trials=3,
    head_to_heads=0,
    ties=True,
    effect=0.6,
    spread=0.5,
    levels=0.4,
    noise=0.8,
    dropout=0.0,
)
BETWEEN = replace(PAIRED, arms=((0,), (1,)))
STUDIES, ERROR = 400, 3 * (0.25 / 400) ** 0.5


def test_the_paired_power_is_that_of_theory() -> None:
    """Rounding to whole points adds a variance of 1/12 to every rating."""
    sd = (PAIRED.spread**2 + 2 * (PAIRED.noise**2 + 1 / 12) / PAIRED.trials) ** 0.5
    expected = TTestPower().power(PAIRED.effect / sd, nobs=12, alpha=0.05)
    assert power_at(PAIRED, 12, STUDIES, 1)["ratings"]["power"] == pytest.approx(expected, abs=ERROR + 0.03)


def test_the_power_between_arms_is_that_of_theory_and_smaller() -> None:
    sd = (PAIRED.spread**2 / 2 + PAIRED.levels**2 + (PAIRED.noise**2 + 1 / 12) / PAIRED.trials) ** 0.5
    expected = TTestIndPower().power(PAIRED.effect / sd, nobs1=12, alpha=0.05)
    found = power_at(BETWEEN, 24, STUDIES, 1)["ratings"]["power"]
    assert found == pytest.approx(expected, abs=ERROR + 0.03)
    assert found < power_at(PAIRED, 24, STUDIES, 1)["ratings"]["power"]


MIXED = replace(PAIRED, methods=3, better=1, compared=2, arms=((0, 1), (0, 2)))


@pytest.mark.parametrize("test", ["difference", "cumulative_link", "equivalence"])
@pytest.mark.parametrize("truth", [replace(PAIRED, methods=3, arms=((0, 1, 2),)), BETWEEN, MIXED])
def test_an_invented_study_is_tested_and_corrected_as_the_page_of_results_does(truth: Truth, test: Any) -> None:
    """Also where everybody meets the reference, so that only one of three comparisons is between people."""
    truth = replace(truth, test=test, bound=0.4)
    rng, groups = np.random.default_rng(4), [f"method {place}" for place in range(truth.methods)]
    ratings = rng.integers(1, 6, (24, truth.methods, truth.trials)).astype(float)
    meets = np.array(
        [[method in truth.arms[person % len(truth.arms)] for method in range(truth.methods)] for person in range(24)]
    )
    rows = [(person, groups[method], said) for person, method in np.argwhere(meets) for said in ratings[person, method]]
    table = pd.DataFrame(rows, columns=["participant", "method", "satisfaction"])
    report = scale_report(table, "satisfaction", "method", groups, compare=True, between=BETWEEN_TESTS, bound=0.4)
    paired = any({truth.better, truth.compared} <= set(arm) for arm in truth.arms)
    name = PowerTest(test).planned(paired=paired).value
    expected = [comparison[name].get("p_holm") for comparison in report["comparisons"]]
    assert any(expected)
    assert holm(ratings_p(truth, ratings, meets)) == pytest.approx(expected)


def test_what_is_found_before_all_comparisons_are_made_is_what_holm_finds() -> None:
    truth, meets, rng = replace(PAIRED, methods=3, arms=((0, 1, 2),)), np.ones((12, 3), bool), np.random.default_rng(5)
    found = []
    for _ in range(60):
        better = np.array([0.0, rng.uniform(0, 1.2), rng.uniform(0, 1.2)])[:, None]
        ratings = np.clip(np.rint(3 + better + rng.normal(0, 1.2, (12, 3, 3))), 1, 5)
        found.append(_ratings_find(truth, ratings, meets))
        assert found[-1] == _is_found(truth, ratings_p(truth, ratings, meets))
    assert 10 < sum(found) < 50


@pytest.mark.parametrize("truth", [PAIRED, BETWEEN, replace(PAIRED, methods=3, arms=((0, 1, 2),), head_to_heads=2)])
def test_where_there_is_nothing_hardly_anything_is_found(truth: Truth) -> None:
    found = power_at(replace(truth, effect=0.0), 12, 200, 2)
    for what in ("ratings", "head_to_heads"):
        if found[what] is not None:
            assert found[what]["power"] <= 0.05 + 3 * (0.05 * 0.95 / 200) ** 0.5


@pytest.mark.parametrize(("arms", "people"), [(((0, 1),), 12), (((0,), (1,)), 48)])
def test_the_power_to_show_equivalence_is_that_of_theory(arms: tuple[tuple[int, ...], ...], people: int) -> None:
    """Phillips (1990): the chance that the 90 % interval lies within the bounds, by the mean and the variance."""
    truth = replace(PAIRED, arms=arms, test="equivalence", bound=0.6, effect=0.0)
    one = (truth.noise**2 + 1 / 12) / truth.trials
    if len(arms) == 1:
        error, freedom = ((truth.spread**2 + 2 * one) / people) ** 0.5, people - 1
    else:
        error, freedom = ((truth.spread**2 / 2 + truth.levels**2 + one) * 4 / people) ** 0.5, people - 2
    scale = np.sqrt(np.random.default_rng(6).chisquare(freedom, 200_000) / freedom)
    reach = truth.bound / error - stats.t.ppf(0.95, freedom) * scale
    expected = np.maximum(2 * stats.norm.cdf(reach) - 1, 0).mean()
    found = power_at(truth, people, STUDIES, 1)
    assert found["ratings"]["power"] == pytest.approx(expected, abs=ERROR + 0.03)
    assert found["head_to_heads"] is None


@pytest.mark.parametrize("truth", [PAIRED, BETWEEN], ids=["within", "between"])
def test_the_cumulative_link_model_finds_about_what_the_t_test_does_and_at_the_bound_nothing_is_equal(
    truth: Truth,
) -> None:
    by_order = power_at(replace(truth, test="cumulative_link", effect=0.8), 16, 80, 1)["ratings"]["power"]
    by_mean = power_at(replace(truth, effect=0.8), 16, 80, 1)["ratings"]["power"]
    assert by_order == pytest.approx(by_mean, abs=0.2)
    at_the_bound = replace(truth, test="equivalence", bound=0.5, effect=0.5)
    found = power_at(at_the_bound, 24, STUDIES, 2)["ratings"]["power"]
    assert found <= 0.05 + 3 * (0.05 * 0.95 / STUDIES) ** 0.5


def test_dropouts_cost_power_and_are_counted() -> None:
    found = power_at(replace(PAIRED, dropout=0.5), 16, STUDIES, 3)
    assert found["completed"] == pytest.approx(8, abs=0.4)
    assert found["ratings"]["power"] < power_at(PAIRED, 16, STUDIES, 3)["ratings"]["power"]


def test_the_same_seed_gives_the_same_numbers_and_nobody_finds_nothing() -> None:
    assert power_at(PAIRED, 8, 20, 5) == power_at(PAIRED, 8, 20, 5)
    assert power_at(replace(PAIRED, dropout=0.9), 2, 20, 5)["ratings"]["power"] <= 0.2


def test_enough_is_where_the_lower_end_stays_above_80_percent() -> None:
    lows = [0.1, 0.81, 0.79, 0.85, 0.9]
    rows = [{"people": 8 * (place + 1), "ratings": {"low": low}} for place, low in enumerate(lows)]
    assert enough(rows, "ratings") == 32
    assert enough(rows[:3], "ratings") is None
