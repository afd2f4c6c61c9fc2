"""Cronbach's alpha and McDonald's omega against hand calculations, and what standard questionnaires report."""

from typing import Any

import numpy as np
import pytest
from scipy import stats

from worker.analysis.study.reliability import alpha, alpha_interval, omega, reliability_report, spearman_brown
from worker.analysis.study.scales import scale_reports


def test_equally_good_items_have_one_reliability_whatever_it_is_called() -> None:
    """Four items that share a variance of 6: 96 of the sum's 118 is true, and alpha is 4/3 (1 - 46/118), the same."""
    covariance = np.full((4, 4), 6.0) + np.diag([4.0, 5.0, 6.0, 7.0])
    assert alpha(covariance) == pytest.approx(96 / 118)
    assert omega(covariance, people=100) == pytest.approx(96 / 118, abs=1e-4)


def test_omega_knows_that_items_are_not_equally_good_and_alpha_is_below_it() -> None:
    """Loadings 1, 2, 3, 4 and unique variances 1, 2, 3, 4: omega is 100 / 110."""
    loadings = np.array([1.0, 2.0, 3.0, 4.0])
    covariance = np.outer(loadings, loadings) + np.diag(loadings)
    assert omega(covariance, people=100) == pytest.approx(100 / 110, abs=1e-4)
    assert alpha(covariance) == pytest.approx(4 / 3 * (1 - 40 / 110)), "30 and 10 of 110 stand on the diagonal"


def test_alpha_is_the_share_of_variance_that_an_analysis_of_variance_finds_between_people() -> None:
    """Hoyt (1941): 1 - residual mean square / mean square of people."""
    items = np.random.default_rng(1).normal(size=(12, 5)) + np.random.default_rng(2).normal(size=(12, 1))
    people, columns, mean = items.mean(axis=1, keepdims=True), items.mean(axis=0, keepdims=True), items.mean()
    residual = ((items - people - columns + mean) ** 2).sum() / (11 * 4)
    between = 5 * ((people - mean) ** 2).sum() / 11
    assert alpha(np.cov(items, rowvar=False)) == pytest.approx(1 - residual / between)


def test_the_interval_of_alpha_is_that_of_the_f_distribution() -> None:
    low, high = alpha_interval(0.8, people=21, items=5)
    assert stats.f.cdf((1 - low) / 0.2, 20, 80) == pytest.approx(0.975)
    assert stats.f.cdf((1 - high) / 0.2, 20, 80) == pytest.approx(0.025)


def test_two_items_get_spearman_brown() -> None:
    assert spearman_brown(np.array([[4.0, 3.0], [3.0, 9.0]])) == pytest.approx(2 * 0.5 / 1.5)
    r = 2.5 / (5 * 2.75) ** 0.5
    report = reliability_report(np.array([[1.0, 2], [2, 2], [3, 4], [4, 3]]))
    assert (report["omega"], report["spearman_brown"]) == (None, pytest.approx(2 * r / (1 + r)))


@pytest.mark.parametrize(
    ("items", "because"),
    [
        (np.ones((5, 1)), "one item"),
        (np.ones((2, 3)), "2 filled it in"),
        (np.ones((5, 3)), "the same answer"),
        (np.array([[1.0, 5], [2, 4], [3, 3], [4, 2]]), "cancel out"),
    ],
)
def test_what_cannot_be_computed_says_why(items: Any, because: str) -> None:
    assert because in reliability_report(items)["not_computable"]


def test_fewer_people_than_items_have_an_alpha_and_no_omega() -> None:
    report = reliability_report(np.random.default_rng(3).integers(1, 6, (6, 10)).astype(float))
    assert ("alpha" in report, report["omega"]) == (True, None)


def test_scores_about_robots_are_compared_within_people_and_not_while_letters_hide_methods() -> None:
    score = {"name": "warmth", "title": "Warmth", "lowest": 1, "highest": 9, "items": ["social", "kind"]}
    rows = [
        {
            "participant": f"P{person}",
            "group": group,
            "scores": {"warmth": None if (person, group) == (5, "b") else value},
            "items": {"social": value - 0.5, "kind": value + 0.5},
        }
        for person in range(6)
        for group, value in (("a", 3.0 + person / 2), ("b", 5.0 + person))
    ]
    instrument = {"name": "x", "title": "X", "measures": "warmth", "scores": [score], "filled_in": rows}
    (part,) = scale_reports([instrument], ["a", "b"], compare=True)[0]["parts"]
    (found,) = part["scores"]
    assert [mean["participant_mean"] for mean in found["means"]] == [pytest.approx(4.25), pytest.approx(7.0)]
    assert found["comparisons"][0]["paired_t"]["difference"] == pytest.approx(np.mean([2, 2.5, 3, 3.5, 4]))
    assert (found["left_out"], found["comparisons"][0]["paired_t"]["n"]) == (1, 5)
    assert [each["people"] for each in found["reliability"]] == [6, 5]
    blinded = scale_reports([instrument], ["a", "b"], compare=False)[0]["parts"][0]["scores"][0]
    assert blinded["comparisons"] == []


def test_omega_is_that_of_the_best_fit_and_not_of_the_nearest_one() -> None:
    """R 4.2: factanal(items, 1, control = list(nstart = 200)); from its one usual start it comes to 0.590."""
    people = (
        "23454",
        "34354",
        "43444",
        "23344",
        "34332",
        "33434",
        "24253",
        "43434",
        "23344",
        "33322",
        "34322",
        "23343",
    )
    items = np.array([[float(point) for point in person] for person in people])
    assert omega(np.cov(items, rowvar=False), len(people)) == pytest.approx(0.3133654, abs=1e-6)


def test_scores_about_robots_are_compared_between_people_where_arms_met_different_ones() -> None:
    """Welch's t of 3, 4, 5 against 6, 7, 9, by hand: difference 10/3, error root of 1/3 + 7/9."""
    score = {"name": "effort", "title": "Effort", "lowest": 0, "highest": 100, "items": ["effort"]}
    values = {
        "P1": ("a", 3.0),
        "P2": ("a", 4.0),
        "P3": ("a", 5.0),
        "P4": ("b", 6.0),
        "P5": ("b", 7.0),
        "P6": ("b", 9.0),
    }
    rows = [
        {"participant": person, "group": group, "scores": {"effort": value}, "items": {"effort": value}}
        for person, (group, value) in values.items()
    ]
    instrument = {"name": "x", "title": "X", "measures": "effort", "scores": [score], "filled_in": rows}
    (part,) = scale_reports([instrument], ["a", "b"], compare=True, between=True)[0]["parts"]
    (compared,) = part["scores"][0]["comparisons"]
    assert compared["welch_t"]["statistic"] == pytest.approx(10 / 3 / (1 / 3 + 7 / 9) ** 0.5)
    assert compared["permutation"]["p"] == pytest.approx(2 / 20), "of twenty ways these and their mirror image"
    assert "equivalence_between" not in compared, "the study's bound is in points of its ratings"


def test_omega_is_the_same_every_time_also_where_a_unique_variance_would_vanish() -> None:
    answers = np.array([[1.0, 1, 1], [2, 2, 1], [3, 3, 4], [4, 4, 2], [5, 5, 3], [4, 5, 1]])
    covariance = np.cov(answers, rowvar=False)
    first = omega(covariance, people=6)
    assert first is not None
    assert 0 < first < 1
    assert omega(covariance, people=6) == first
