"""The cumulative link mixed model against R's, and what its intervals count."""

import numpy as np
import pytest

from worker.analysis.study.cumulative_link import cumulative_link, fit

WINE = ("23344455", "12132354", "23325544", "32323253", "23433333", "32322454", "11222323", "22233334", "12323244")
"""Bitterness of eight wines by nine judges: Randall (1989), data set wine of R's package ordinal."""
COLD_TO_WARM, NO_CONTACT = [0, 0, 0, 0, 1, 1, 1, 1], [0, 0, 1, 1, 0, 0, 1, 1]


def test_the_wine_as_r_fits_it() -> None:
    """R. H. B. Christensen, "A Tutorial on fitting Cumulative Link Mixed Models with clmm2" (vignette of ordinal):
    clmm2(rating ~ temp + contact, random = judge, nAGQ = 10, Hess = TRUE)."""
    ratings = np.array([float(each) for judge in WINE for each in judge])
    x = np.tile(np.array([COLD_TO_WARM, NO_CONTACT], float).T, (len(WINE), 1))
    found = fit(ratings, x, np.repeat(np.arange(len(WINE)), 8))
    assert found.effects == pytest.approx([3.0619, 1.8334], abs=1e-4)
    assert found.thresholds == pytest.approx([-1.6235, 1.5128, 4.2271, 6.0862], abs=1e-4)
    assert found.sd == pytest.approx(1.134787, abs=1e-4)
    assert found.log_likelihood == pytest.approx(-81.53246, abs=1e-5)
    errors = [0.6834, 0.6044, 0.8090, 0.9719, 0.5951, 0.5122]
    assert np.sqrt(np.diag(found.covariance()))[:-1] == pytest.approx(errors, abs=1e-4)


def rated(seed: int, people: int = 8, better: float = 0.0) -> tuple[list[np.ndarray], list[np.ndarray]]:
    random = np.random.default_rng(seed)
    level = random.normal(3.0, 0.6, people)
    groups = [level[:, None] + random.normal(by, 0.8, (people, 3)) for by in (0.0, better)]
    first, second = (list(np.clip(np.rint(group), 1, 5)) for group in groups)
    return first, second


def test_only_the_order_of_ratings_matters() -> None:
    first, second = rated(1, better=0.6)
    stretched = [[each**3 for each in group] for group in (first, second)]
    assert cumulative_link(*stretched)["difference"] == pytest.approx(cumulative_link(first, second)["difference"])


def test_exchanging_the_two_turns_the_sign() -> None:
    first, second = rated(2, better=0.6)
    one, other = cumulative_link(first, second), cumulative_link(second, first)
    assert one["difference"] == pytest.approx(-other["difference"])
    assert one["p"] == pytest.approx(other["p"])
    assert one["odds_ratio"] == pytest.approx(1 / other["odds_ratio"])


def test_the_same_ratings_thrice_from_everybody_are_no_more_people() -> None:
    """Unlike the errors that suppose one effect for all, which shrink by the root of three."""
    first, second = rated(3, better=0.4)
    once = cumulative_link(first, second)
    thrice = cumulative_link(*([np.tile(each, 3) for each in group] for group in (first, second)))
    assert thrice["n"] == once["n"]
    assert thrice["standard_error"] > 0.9 * once["standard_error"]


def test_what_has_no_finite_fit_is_said() -> None:
    low, high = [np.array([1.0, 2.0])] * 5, [np.array([4.0, 5.0])] * 5
    assert "no finite model" in cumulative_link(low, high)["not_computable"]
    assert "are the same" in cumulative_link([np.ones(2)] * 5, [np.ones(2)] * 5)["not_computable"]
    assert "4 are needed" in cumulative_link(low[:3], high[:3])["not_computable"]
    assert "0 people" in cumulative_link([], [])["not_computable"]
