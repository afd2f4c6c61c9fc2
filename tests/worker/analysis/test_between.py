"""Tests between people, and of order and period: as scipy, statsmodels, and paper and pencil have them."""

import csv
import math
from itertools import combinations

import numpy as np
import pandas as pd
import pytest
import statsmodels.formula.api as formulas
from scipy import stats
from statsmodels.stats.anova import anova_lm
from statsmodels.stats.weightstats import ttost_ind

from tests.benchmarks import between as simulation
from worker.analysis.study.between import (
    BETWEEN_TESTS,
    equivalence_between,
    hedges_g,
    means_of,
    only_one_of,
    permutation,
    welch_t,
)
from worker.analysis.study.cumulative_link import cumulative_link_between
from worker.analysis.study.order_effects import order_report
from worker.analysis.study.statistics import rating_report

FIRST, SECOND = np.array([2.0, 3.0, 3.5, 2.5, 4.0]), np.array([4.0, 4.5, 3.0, 5.0])


def test_welch_is_scipys_and_hedges_g_is_by_hand() -> None:
    outcome, got = stats.ttest_ind(SECOND, FIRST, equal_var=False), welch_t(FIRST, SECOND)
    assert [got["statistic"], got["p"], got["degrees_of_freedom"]] == pytest.approx(
        [outcome.statistic, outcome.pvalue, outcome.df]
    )
    assert [got["low"], got["high"]] == pytest.approx(list(outcome.confidence_interval(0.95)))
    pooled = ((4 * FIRST.var(ddof=1) + 3 * SECOND.var(ddof=1)) / 7) ** 0.5
    effect = hedges_g(FIRST, SECOND)
    assert effect["g"] == pytest.approx((1 - 3 / (4 * 7 - 1)) * (SECOND.mean() - FIRST.mean()) / pooled, rel=2e-3)
    noncentral = stats.nct(
        7, effect["g_low"] / (effect["g"] / (SECOND.mean() - FIRST.mean()) * pooled) / (1 / 5 + 1 / 4) ** 0.5
    )
    assert noncentral.sf(stats.ttest_ind(SECOND, FIRST).statistic) == pytest.approx(0.025, abs=1e-6)


def test_equivalence_between_people_is_statsmodels_two_one_sided_welch_tests() -> None:
    p, above, below = ttost_ind(SECOND, FIRST, -1.5, 1.5, usevar="unequal")
    got = equivalence_between(FIRST, SECOND, 1.5)
    assert [got["p"], got["statistic"], got["degrees_of_freedom"]] == pytest.approx([p, -below[0], above[2]])
    ends = stats.ttest_ind(SECOND, FIRST, equal_var=False).confidence_interval(0.90)
    assert [got["low_90"], got["high_90"]] == pytest.approx(list(ends))
    exchanged = equivalence_between(SECOND, FIRST, 1.5)
    assert [exchanged["p"], exchanged["difference"]] == pytest.approx([got["p"], -got["difference"]])


def test_the_cumulative_link_model_between_people_as_r_has_it() -> None:
    """By hand in R 4.2: clmm(rating ~ group + (1 | person), nAGQ = 30) of ordinal 2022.11-16; its estimates, with every
    person's likelihood integrated by integrate(), its scores by numDeriv, and from them a sandwich with n / (n - 1) of
    each group and Welch's degrees of freedom."""
    first = [np.array(each, float) for each in ([2, 3, 3], [3, 3, 4], [1, 2, 2], [4, 3, 4], [2, 2, 3])]
    second = [np.array(each, float) for each in ([3, 4, 4], [5, 4, 5], [2, 3, 3], [4, 4, 3])]
    got = cumulative_link_between(first, second)
    assert (got["n_first"], got["n_second"], got["n_ratings"]) == (5, 4, 27)
    assert [got["difference"], got["sd_between_people"]] == pytest.approx([3.2699453, 2.1624500], rel=1e-6)
    expected = [1.76063916, 6.40387052, 0.109560134, -0.973172224, 7.51306273]
    names = ("standard_error", "degrees_of_freedom", "p", "low", "high")
    assert [got[name] for name in names] == pytest.approx(expected, rel=1e-5)


def test_the_permutation_test_counts_the_divisions_that_are_as_far_apart() -> None:
    values = np.concatenate([FIRST, SECOND])
    far, seen = 0, abs(stats.ttest_ind(SECOND, FIRST, equal_var=False).statistic)
    for chosen in combinations(range(9), 5):
        rest = [place for place in range(9) if place not in chosen]
        far += abs(stats.ttest_ind(values[rest], values[list(chosen)], equal_var=False).statistic) >= seen - 1e-9
    assert permutation(FIRST, SECOND)["p"] == pytest.approx(far / 126)
    assert permutation(FIRST, SECOND)["exact"]


def test_drawn_divisions_come_near_the_exact_ones_and_are_the_same_every_time() -> None:
    rng = np.random.default_rng(1)
    first, second = rng.normal(0, 1, 14), rng.normal(0.8, 1, 14)
    got = permutation(first, second)
    assert not got["exact"]
    assert got == permutation(first, second)
    assert got["p"] == pytest.approx(stats.ttest_ind(first, second).pvalue, abs=0.01)


def test_who_rated_both_is_in_neither_group_and_few_people_give_reasons() -> None:
    cells = {("P1", "a"): [1.0, 2.0], ("P2", "b"): [2.0], ("P3", "a"): [3.0], ("P3", "b"): [4.0]}
    first, second = only_one_of({whose: np.array(said) for whose, said in cells.items()}, "a", "b")
    assert (list(means_of(first)), list(means_of(second))) == ([1.5], [2.0])
    few = means_of(first), means_of(second)
    for result in (welch_t(*few), equivalence_between(*few, 0.5), cumulative_link_between(first, second)):
        assert result == {"not_computable": "1 and 1 people rated one of the two alone; 3 of each are needed"}
    same = np.full(4, 3.0)
    for result in (permutation(same, same + 1), equivalence_between(same, same + 1, 0.5)):
        assert "no spread" in result["not_computable"]
    alike, above = [np.full(2, 3.0)] * 4, [np.full(2, 5.0)] * 4
    assert "all ratings of the two are the same" in cumulative_link_between(alike, alike)["not_computable"]
    assert "no finite model" in cumulative_link_between(alike, above)["not_computable"]


def crossover(people: int = 12, drift: float = 0.0, seed: int = 3) -> pd.DataFrame:
    """Three methods in all six orders, two trials of each."""
    rng, orders, rows = (
        np.random.default_rng(seed),
        [(0, 1, 2), (1, 2, 0), (2, 0, 1), (2, 1, 0), (0, 2, 1), (1, 0, 2)],
        [],
    )
    for person in range(people):
        level = rng.normal(0, 0.6)
        for period, method in enumerate(orders[person % 6]):
            for trial in range(2):
                said = 3 + level + 0.3 * method + drift * period + rng.normal(0, 0.5)
                rows.append((f"P{person}", f"m{method}", 2 * period + trial + 1, said, said))
    return pd.DataFrame(rows, columns=["participant", "method", "order", "satisfaction", "personalisation"])


@pytest.mark.filterwarnings("ignore:The design matrix is rank-deficient")
def test_period_and_carryover_are_statsmodels_analysis_of_variance() -> None:
    rows = crossover(drift=0.4)
    cells = rows.groupby(["participant", "method"], as_index=False).agg({"satisfaction": "mean", "order": "min"})
    cells = cells.sort_values(["participant", "order"])
    cells["period"] = cells.groupby("participant").cumcount()
    cells["before"] = cells.groupby("participant")["method"].shift(1, fill_value="")
    base = "satisfaction ~ C(participant) + C(method)"
    fits = [formulas.ols(base + more, cells).fit() for more in ("", " + C(period)", " + C(period) + C(before)")]
    report = order_report(rows, "satisfaction")
    for name, without, whole in (("period", fits[0], fits[1]), ("carryover", fits[1], fits[2])):
        expected = anova_lm(without, whole)
        assert report[name]["F"] == pytest.approx(expected["F"][1])
        assert report[name]["p"] == pytest.approx(expected["Pr(>F)"][1])
    estimate = report["by_period"][1]
    assert estimate["difference"] == pytest.approx(fits[1].params["C(period)[T.2]"])
    assert [estimate["low"], estimate["high"]] == pytest.approx(list(fits[1].conf_int().loc["C(period)[T.2]"]))


def test_where_everybody_met_one_method_there_is_no_order() -> None:
    rows = crossover()
    report = order_report(rows[rows["method"] == "m0"], "satisfaction")
    assert "nobody met two methods" in report["period"]["not_computable"]
    one_order = rows[rows["participant"].isin(["P0", "P6"])]
    assert "2 people" in order_report(one_order, "satisfaction")["period"]["not_computable"]


def test_a_report_between_subjects_has_its_tests_and_corrects_them() -> None:
    rows = crossover()
    mine = rows.apply(lambda row: row["method"] == f"m{int(row['participant'][1:]) % 3}", axis=1)
    report = rating_report(rows[mine], ["m0", "m1", "m2"], between=True, bound=0.4)
    for comparison in report["scales"]["satisfaction"]["comparisons"]:
        assert comparison["welch_t"]["n_first"] == 4
        assert comparison["welch_t"]["corrected_over"] == 3
        for test in BETWEEN_TESTS:
            assert comparison[test]["p_holm"] >= comparison[test]["p"]
        assert comparison["equivalence_between"]["bound"] == 0.4
        assert comparison["cumulative_link_between"]["n_ratings"] == 16
        assert "not_computable" in comparison["paired_t"]


def test_error_rates_small() -> None:
    """Within three standard errors."""
    most = 5.0 + 3 * (5.0 * 95.0 / 80) ** 0.5
    found = simulation.between_row(simulation.Truth("unequal", (8, 8), (0.3, 1.0), better=0.5), 80)
    for name in ("welch_t_misses", "cumulative_link_misses", "equivalence"):
        assert found[f"{name}_percent"] <= most


def test_what_is_offered_between_arms_never_erred_clearly_more_often_than_promised() -> None:
    """By the committed table; beside it the model's usual errors, which do."""
    with (simulation.RESULTS / "between.csv").open() as file:
        rows = list(csv.DictReader(file))
    alike, bound = ([row for row in rows if float(row["better"]) == better] for better in (0.0, 0.5))
    assert len(alike) == len(bound) == 16
    level = [row for row in alike if len(set(row["people"].split(" and "))) == 1]

    def errs(row: dict[str, str], test: str) -> bool:
        return float(row[f"{test}_percent"]) > 5.0 + 3 * math.sqrt(5.0 * 95.0 / int(row["studies"]))

    for test, those in (("cumulative_link", alike), ("equivalence", bound), ("welch_t", level), ("permutation", level)):
        assert not [row for row in those if errs(row, test)], test
    for test in ("usual_errors", "welch_t", "permutation"):
        assert [row for row in alike if errs(row, test)], f"The page says that {test} may err."
    order = simulation.order_row(8, 0.0, 30)
    assert order["period_percent"] <= 5.0 + 3 * (5.0 * 95.0 / 30) ** 0.5
