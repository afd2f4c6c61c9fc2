"""Power by simulation: what theory says where it knows, and no more than 5 % where there is nothing to find."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from statsmodels.stats.power import TTestIndPower, TTestPower

from worker.analysis.study.effect_sizes import holm
from worker.analysis.study.power import Truth, enough, power_at, ratings_p
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


@pytest.mark.parametrize("truth", [replace(PAIRED, methods=3, arms=((0, 1, 2),)), BETWEEN, MIXED])
def test_an_invented_study_is_tested_and_corrected_as_the_page_of_results_does(truth: Truth) -> None:
    """Also where everybody meets the reference, so that only one of three comparisons is between people."""
    rng, groups = np.random.default_rng(4), [f"method {place}" for place in range(truth.methods)]
    means = rng.integers(3, 16, (24, truth.methods)) / 3
    meets = np.array(
        [[method in truth.arms[person % len(truth.arms)] for method in range(truth.methods)] for person in range(24)]
    )
    rows = [(person, groups[method], means[person, method]) for person, method in np.argwhere(meets)]
    table = pd.DataFrame(rows, columns=["participant", "method", "satisfaction"])
    report = scale_report(table, "satisfaction", "method", groups, compare=True, between=True)
    test = "paired_t" if any({truth.better, truth.compared} <= set(arm) for arm in truth.arms) else "welch_t"
    expected = [comparison[test].get("p_holm") for comparison in report["comparisons"]]
    assert any(expected)
    assert holm(ratings_p(truth, means, meets)) == pytest.approx(expected)


@pytest.mark.parametrize("truth", [PAIRED, BETWEEN, replace(PAIRED, methods=3, arms=((0, 1, 2),), head_to_heads=2)])
def test_where_there_is_nothing_hardly_anything_is_found(truth: Truth) -> None:
    found = power_at(replace(truth, effect=0.0), 12, 200, 2)
    for what in ("ratings", "head_to_heads"):
        if found[what] is not None:
            assert found[what]["power"] <= 0.05 + 3 * (0.05 * 0.95 / 200) ** 0.5


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
