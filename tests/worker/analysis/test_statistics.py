"""The paper's tests exactly, and the right ones beside them: as scipy, statsmodels, and paper and pencil have them."""

import io
from functools import cache
from itertools import combinations, product
from typing import Any

import numpy as np
import pandas as pd
import pytest
import statsmodels.formula.api as formulas
from scipy import stats
from statsmodels.stats.multitest import multipletests

from worker.analysis.study.effect_sizes import d_z_interval, holm, rank_biserial, rank_biserial_interval
from worker.analysis.study.hypothesis_tests import (
    equivalence,
    mixed_model,
    paired_t,
    signed_rank,
    two_sample_t,
    wilcoxon,
)
from worker.analysis.study.statistics import SCALES, paired_differences, rating_report

METHODS = ("reference", "prefft", "pbarl")


def ratings(people: int = 8, trials: int = 3, seed: int = 1) -> pd.DataFrame:
    """Invented ratings of three methods, as they come out of a CSV file."""
    rng, lines = np.random.default_rng(seed), ["participant,method,repetition,satisfaction,personalisation"]
    for person in range(people):
        level = rng.normal(0, 0.6)
        for method, mean in zip(METHODS, (2.6, 3.0, 3.9), strict=True):
            for repetition in range(1, trials + 1):
                said = np.clip(np.round(mean + level + rng.normal(0, 0.8, 2)), 1, 5).astype(int)
                lines.append(f"P{person + 1:02d},{method},{repetition},{said[0]},{said[1]}")
    return pd.read_csv(io.StringIO("\n".join(lines)))


@cache
def report_of(seed: int = 1) -> dict[str, Any]:
    """What the report says of eight people's ratings; nobody changes it."""
    return rating_report(ratings(seed=seed), METHODS)


@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("seed", range(3))
def test_the_papers_test_is_scipys_independent_t_test_on_all_ratings(scale: str, seed: int) -> None:
    rows = ratings(seed=seed)
    for comparison in report_of(seed)["scales"][scale]["comparisons"]:
        first, second = (rows[rows.method == comparison[side]][scale] for side in ("first", "second"))
        outcome, got = stats.ttest_ind(second, first), comparison["two_sample_t"]
        assert (got["n_first"], got["n_second"], got["degrees_of_freedom"]) == (24, 24, 46)
        assert (got["statistic"], got["p"]) == pytest.approx((outcome.statistic, outcome.pvalue))
        assert got["star"] == (outcome.pvalue < 0.01)


@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("seed", range(3))
def test_paired_tests_are_scipys_on_the_means_of_each_person(scale: str, seed: int) -> None:
    rows = ratings(seed=seed)
    means = rows.groupby(["participant", "method"])[scale].mean().unstack()
    comparisons = report_of(seed)["scales"][scale]["comparisons"]
    t_tests = [stats.ttest_rel(means[each["second"]], means[each["first"]]) for each in comparisons]
    for comparison, outcome in zip(comparisons, t_tests, strict=True):
        got, differences = comparison["paired_t"], means[comparison["second"]] - means[comparison["first"]]
        assert (got["statistic"], got["p"]) == pytest.approx((outcome.statistic, outcome.pvalue))
        assert got["d_z"] == pytest.approx(differences.mean() / differences.std())
        if len(np.unique(differences.round(12).abs())) == len(differences):
            signed = stats.wilcoxon(differences, method="exact")
            assert comparison["wilcoxon"]["p"] == pytest.approx(signed.pvalue)
    corrected = multipletests([outcome.pvalue for outcome in t_tests], method="holm")[1]
    assert [each["paired_t"]["p_holm"] for each in comparisons] == pytest.approx(list(corrected))


@pytest.mark.parametrize("scale", SCALES)
def test_with_as_many_ratings_of_everybody_the_mixed_model_is_the_paired_t_test(scale: str) -> None:
    for comparison in report_of()["scales"][scale]["comparisons"]:
        model, paired = comparison["mixed_model"], comparison["paired_t"]
        assert (model["n"], model["n_ratings"], model["degrees_of_freedom"]) == (8, 48, 7)
        for number in ("difference", "low", "high", "statistic", "p"):
            assert model[number] == pytest.approx(paired[number])


def test_the_mixed_model_finds_the_spreads_that_statsmodels_finds() -> None:
    """Where the spread of what a method is to people is large, REML and Paule and Mandel agree."""
    rng, rows = np.random.default_rng(3), []
    for person in range(60):
        level, change = rng.normal(0, 1), rng.normal(0.5, 1.5)
        for method in (0, 1):
            for _ in range(int(rng.integers(2, 6))):
                rows.append((person, method, 3 + level + method * change + rng.normal(0, 0.7)))
    table = pd.DataFrame(rows, columns=["person", "method", "rating"])
    fit = formulas.mixedlm("rating ~ method", table, groups=table.person, re_formula="~method").fit()
    cells = {name: group.to_numpy() for name, group in table.groupby(["person", "method"])["rating"]}
    got = mixed_model(*([cells[person, method] for person in range(60)] for method in (0, 1)))
    assert got["difference"] == pytest.approx(fit.params["method"], abs=0.02)
    assert got["standard_error"] == pytest.approx(fit.bse["method"], rel=0.05)
    assert got["sd_between_people"] == pytest.approx(fit.cov_re.loc["method", "method"] ** 0.5, rel=0.05)
    assert got["sd_within_people"] == pytest.approx(fit.scale**0.5, rel=0.05)


def test_who_gave_more_ratings_counts_more() -> None:
    """A single rating of somebody is noise mostly; the mean of everybody's means would be pulled by it."""
    rng = np.random.default_rng(0)
    first = [rng.normal(3, 1, 12) for _ in range(6)] + [np.array([5.0])]
    second = [values + 0.5 + rng.normal(0, 1, 12) for values in first[:6]] + [np.array([1.0])]
    differences = np.array([b.mean() - a.mean() for a, b in zip(first, second, strict=True)])
    assert differences.mean() < mixed_model(first, second)["difference"] < 1.0


def test_one_rating_of_each_is_enough_for_people_to_count_alike() -> None:
    first, second = ([np.array([value]) for value in values] for values in ((1.0, 2.0, 4.0, 3.0), (3.0, 3.0, 4.0, 5.0)))
    got, paired = mixed_model(first, second), paired_t(np.array([2.0, 1.0, 0.0, 2.0]))
    assert got["p"] == pytest.approx(paired["p"])
    assert got["sd_within_people"] is None


def test_a_paired_t_test_by_hand() -> None:
    got = paired_t(np.array([1.0, 2.0, 3.0]))  # mean 2, sd 1, so t = 2 / (1 / sqrt 3)
    assert got["statistic"] == pytest.approx(2 * 3**0.5)
    assert (got["n"], got["difference"]) == (3, 2)
    assert (got["low"], got["high"]) == pytest.approx((2 - 4.302653 / 3**0.5, 2 + 4.302653 / 3**0.5))


def test_a_signed_rank_test_by_hand() -> None:
    got = wilcoxon(np.array([-1.0, 2.0, 3.0, 4.0, 5.0, 0.0]))  # ranks 1 against 2 + 3 + 4 + 5
    assert (got["n"], got["n_without_ties"], got["statistic"]) == (6, 5, 1)
    assert got["p"] == pytest.approx(4 / 2**5)  # sums of 0 and 1, on either side
    assert got["smallest_p"] == pytest.approx(2 / 2**5)


@pytest.mark.parametrize("seed", range(5))
def test_the_signed_rank_test_is_exact_with_ties(seed: int) -> None:
    """As all 2^P signs, one by one, have it."""
    rng = np.random.default_rng(seed)
    differences = rng.integers(-4, 7, int(rng.integers(3, 13))) / 3
    moved = differences[differences != 0]
    ranks = stats.rankdata(np.abs(moved))
    sums = [
        sum(rank for rank, up in zip(ranks, signs, strict=True) if up) for signs in product((0, 1), repeat=len(moved))
    ]
    statistic, p = signed_rank(differences)
    assert statistic == min(ranks[moved > 0].sum(), ranks[moved < 0].sum())
    assert p == pytest.approx(min(1.0, 2 * np.mean(np.array(sums) <= statistic)))


def test_a_two_sample_t_test_by_hand() -> None:
    got = two_sample_t(np.array([1.0, 2.0, 3.0]), np.array([3.0, 4.0, 5.0]))  # pooled variance 1, so t = 2 / sqrt(2/3)
    assert got["statistic"] == pytest.approx(2 / (2 / 3) ** 0.5)
    assert (got["degrees_of_freedom"], got["star"]) == (4, False)


def test_the_interval_of_an_effect_size_holds_it_as_often_as_it_says() -> None:
    rng, n, true = np.random.default_rng(0), 8, 0.8
    samples = rng.normal(true, 1, (400, n))
    statistics = samples.mean(axis=1) / samples.std(axis=1, ddof=1) * n**0.5
    held = [low <= true <= high for low, high in (d_z_interval(float(t), n) for t in statistics)]
    assert 0.92 <= np.mean(held) <= 0.98


@pytest.mark.parametrize(("t", "n"), [(0.0, 3), (-3.0, 8), (60.0, 4), (30.0, 200)])
def test_the_interval_of_an_effect_size_is_where_the_noncentral_t_says(t: float, n: int) -> None:
    low, high = d_z_interval(t, n)
    assert stats.nct.cdf(t, n - 1, high * n**0.5) == pytest.approx(0.025, abs=1e-6)
    assert stats.nct.sf(t, n - 1, low * n**0.5) == pytest.approx(0.025, abs=1e-6)


def test_few_people_who_all_agree_give_no_interval_of_certainty() -> None:
    assert rank_biserial(np.array([1.0, 2.0, 1.0])) == 1
    low, high = rank_biserial_interval(1.0, 3)
    assert low < 0
    assert high == 1


@pytest.mark.parametrize("n", [8, 16, 30])
def test_the_interval_of_ranks_leaves_out_zero_where_the_exact_test_does(n: int) -> None:
    """For whoever the two disagree about, it is close: p is between 3 and 8 %."""
    rng = np.random.default_rng(n)
    for shift in np.linspace(0, 2, 60):
        differences = rng.normal(shift, 1, n)
        low, high = rank_biserial_interval(rank_biserial(differences), n)
        p = wilcoxon(differences)["p"]
        assert (low > 0 or high < 0) == (p < 0.05) or 0.03 < p < 0.08


@pytest.mark.parametrize(("shift", "true"), [(0.0, 0.0), (0.8, 0.742), (1.3, 0.934)])
def test_the_interval_of_ranks_holds_the_true_one_as_often_as_it_says(shift: float, true: float) -> None:
    """Of normal differences: 2 P(D + D' > 0) - 1."""
    assert true == pytest.approx(2 * stats.norm.cdf(shift * 2**0.5) - 1, abs=1e-3)
    samples = np.random.default_rng(0).normal(shift, 1, (1000, 12))
    ends = [rank_biserial_interval(rank_biserial(sample), 12) for sample in samples]
    assert 0.93 <= np.mean([low <= true <= high for low, high in ends]) <= 0.98


def test_holm_by_hand() -> None:
    assert holm([0.04, 0.01, 0.03]) == pytest.approx([0.06, 0.03, 0.06])


def test_a_test_without_a_result_still_counts_in_holms_family() -> None:
    assert holm([0.02, None, 0.5]) == [pytest.approx(0.06), None, pytest.approx(1.0)]
    rows = ratings()
    rows.loc[rows.method == "pbarl", "satisfaction"] = 5
    rows.loc[rows.method == "prefft", "satisfaction"] = 4  # the difference of these two has no spread
    comparisons = rating_report(rows, METHODS)["scales"]["satisfaction"]["comparisons"]
    first, _, without = (each["paired_t"] for each in comparisons)
    assert "not_computable" in without
    assert first["corrected_over"] == 3
    assert min(each["paired_t"]["p_holm"] / each["paired_t"]["p"] for each in comparisons[:2]) >= 2
    assert max(each["paired_t"]["p_holm"] / each["paired_t"]["p"] for each in comparisons[:2]) == pytest.approx(3)


def test_too_few_people_give_reasons_instead_of_numbers() -> None:
    report = rating_report(ratings(people=2), METHODS)
    for comparison in report["scales"]["satisfaction"]["comparisons"]:
        assert "2 people" in comparison["paired_t"]["not_computable"]
        assert "3 are needed" in comparison["wilcoxon"]["not_computable"]
        assert "3 are needed" in comparison["mixed_model"]["not_computable"]
        assert "p" in comparison["two_sample_t"], "the paper's test sees twelve independent ratings here"


def test_nothing_rated_yet_is_no_error() -> None:
    report = rating_report(ratings().iloc[:0], METHODS)
    assert report["ratings"] == 0
    assert report["scales"]["satisfaction"]["means"][0]["mean"] is None
    for comparison in report["scales"]["satisfaction"]["comparisons"]:
        assert all("not_computable" in comparison[test] for test in ("two_sample_t", "paired_t", "wilcoxon"))


def test_equal_differences_have_no_spread_to_test_with() -> None:
    assert "same difference" in paired_t(np.full(5, 1.0))["not_computable"]
    assert "differently" in wilcoxon(np.zeros(5))["not_computable"]
    assert "no spread" in two_sample_t(np.full(4, 2.0), np.full(4, 3.0))["not_computable"]


def test_people_who_all_rate_alike_have_no_spread_to_test_with() -> None:
    rows = ratings(people=6)
    rows["satisfaction"] = [1, 2, 3, 2, 3, 4, 3, 4, 5] * 6
    for comparison in rating_report(rows, METHODS)["scales"]["satisfaction"]["comparisons"]:
        assert "same difference" in comparison["mixed_model"]["not_computable"]
        assert "same difference" in comparison["paired_t"]["not_computable"]


def test_somebody_who_rated_only_one_of_two_methods_is_left_out_of_their_comparison() -> None:
    rows = ratings()
    rows = rows[~((rows.participant == "P03") & (rows.method == "prefft"))]
    assert len(paired_differences(rows, "satisfaction", "method", "reference", "prefft")) == 7
    assert len(paired_differences(rows, "satisfaction", "method", "reference", "pbarl")) == 8


def test_letters_are_not_compared_while_they_hide_methods() -> None:
    rows = ratings().rename(columns={"method": "letter"})
    report = rating_report(rows, METHODS, by="letter", compare=False)
    assert [scale["comparisons"] for scale in report["scales"].values()] == [[], []]
    assert report["scales"]["satisfaction"]["means"][0]["ratings"] == 24


def test_every_pair_of_methods_is_compared_once_second_minus_first() -> None:
    report = rating_report(ratings(), METHODS)["scales"]["satisfaction"]
    assert [(each["first"], each["second"]) for each in report["comparisons"]] == list(combinations(METHODS, 2))
    means = {each["group"]: each["mean"] for each in report["means"]}
    for each in report["comparisons"]:
        assert each["two_sample_t"]["difference"] == pytest.approx(means[each["second"]] - means[each["first"]])


@pytest.mark.parametrize("bound", [0.2, 0.4, 0.6])
def test_equivalence_is_shown_by_the_larger_of_two_one_sided_tests(bound: float) -> None:
    """Which is below 5 % just when the 90 % interval lies between the bounds (Schuirmann 1987)."""
    differences = np.array([0.3, -0.1, 0.4, 0.0, 0.2, 0.1, 0.3, -0.2])
    sides = [
        stats.ttest_1samp(differences, -bound, alternative="greater").pvalue,
        stats.ttest_1samp(differences, bound, alternative="less").pvalue,
    ]
    got = equivalence(differences, bound)
    assert got["p"] == pytest.approx(max(sides))
    assert (got["p"] < 0.05) == (-bound < got["low_90"] and got["high_90"] < bound)
    assert equivalence(-differences, bound)["p"] == pytest.approx(got["p"])


def test_few_people_cannot_show_equivalence_by_not_finding_a_difference() -> None:
    differences = np.array([-1.0, 1.0, 0.5, -0.5])
    assert paired_t(differences)["p"] > 0.9
    assert equivalence(differences, 0.5)["p"] > 0.05
    assert "3 are needed" in equivalence(differences[:2], 0.5)["not_computable"]
