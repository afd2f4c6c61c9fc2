"""How well the items of a scale agree: Cronbach's alpha, McDonald's omega, and of two items Spearman-Brown.

Input is (N, K): N filled-in questionnaires of different people, K items, those that are reversed mirrored already.

alpha = K / (K - 1) (1 - sum of item variances / variance of the sum) (Cronbach 1951), with the F interval of Feldt,
Woodruff and Salih (1987): (1 - true) / (1 - found) ~ F(N - 1, (N - 1)(K - 1)). It is exact where items are normal and
equally good; how far it is off elsewhere is in docs/results/reliability.md. Where items are not equally good, alpha is
below the reliability. omega = (sum of loadings)^2 / ((sum of loadings)^2 + sum of unique variances) of one factor,
fitted by maximum likelihood (McDonald 1999), allows for that. Two items do not identify a factor: there, as Eisinga,
te Grotenhuis and Pelzer (2013) advise, it is Spearman-Brown's 2 r / (1 + r).
"""

from typing import Any

import numpy as np
from scipy import optimize, stats

from worker.analysis.study.hypothesis_tests import not_computable, plain
from worker.domain.type_aliases import FloatArray

FEWEST = 3
"""Filled-in questionnaires."""
LEAST_UNIQUE = 0.005
CONFIDENCE = 0.95


def reliability_report(items: FloatArray) -> dict[str, Any]:
    """people, items; alpha with low and high; omega or spearman_brown (None: not computable); or not_computable."""
    people, count = items.shape
    found: dict[str, Any] = {"people": people, "items": count}
    if count < 2:
        return found | not_computable("one item cannot agree with itself")
    if people < FEWEST:
        return found | not_computable(f"{people} filled it in; {FEWEST} are needed")
    covariance = np.cov(items, rowvar=False)
    if covariance.sum() <= 0 or (np.diag(covariance) <= 0).any():
        return found | not_computable("everybody gave the same answer to an item, or the answers cancel out")
    value = alpha(covariance)
    low, high = alpha_interval(value, people, count)
    two = count == 2
    return found | {
        "alpha": plain(value),
        "low": plain(low),
        "high": plain(high),
        "omega": None if two else _plain_or_none(omega(covariance, people)),
        "spearman_brown": plain(spearman_brown(covariance)) if two else None,
    }


def alpha(covariance: FloatArray) -> float:
    """Cronbach's alpha of items with this covariance. (K, K)"""
    count = len(covariance)
    return float(count / (count - 1) * (1 - np.trace(covariance) / covariance.sum()))


def alpha_interval(value: float, people: int, items: int) -> tuple[float, float]:
    """The 95 % interval of alpha after Feldt, Woodruff and Salih (1987), equation 9."""
    freedom = people - 1, (people - 1) * (items - 1)
    tail = (1 - CONFIDENCE) / 2
    return 1 - (1 - value) * float(stats.f.ppf(1 - tail, *freedom)), 1 - (1 - value) * float(
        stats.f.ppf(tail, *freedom)
    )


def omega(covariance: FloatArray, people: int) -> float | None:
    """McDonald's omega of items with this covariance, one factor; None where it cannot be fitted. (K, K)

    Fewer people than items, or items that determine each other, leave no likelihood to maximise. It is maximised over
    the unique variances (Lawley and Maxwell 1971, ch. 4), within the bounds of R's factanal: at least LEAST_UNIQUE of
    an item is its own, or the likelihood may have no maximum (Heywood). With few people it has several, so the best is
    sought from factanal's start, and from one for every item in which the factor is that item.
    """
    scale = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(scale, scale)
    if people <= len(covariance) or np.linalg.eigvalsh(correlation)[0] < 1e-8:
        return None
    usual = (1 - 0.5 / len(covariance)) / np.diag(np.linalg.inv(correlation))
    roughly = [_fitted(correlation, start, ftol=1e-7) for start in (usual, *(0.9 - 0.8 * np.eye(len(covariance))))]
    best = min(roughly, key=lambda found: float(found.fun)).x
    exactly = _fitted(correlation, best, ftol=1e-15, gtol=1e-10, maxiter=10_000, maxfun=100_000).x
    unique = exactly * scale**2
    common = float((_loadings(exactly, correlation) * scale).sum() ** 2)
    return common / (common + float(unique.sum()))


def _fitted(correlation: FloatArray, start: FloatArray, **options: float) -> Any:
    """What scipy finds from here: unique variances x, their misfit fun."""
    bounds = [(LEAST_UNIQUE, 1.0)] * len(start)
    return optimize.minimize(
        _misfit, start, args=(correlation,), method="L-BFGS-B", jac=True, bounds=bounds, options=options
    )


def _loadings(unique: FloatArray, correlation: FloatArray) -> FloatArray:
    """The best ones given the unique variances. (K,) -> (K,)"""
    root = np.sqrt(unique)
    values, vectors = np.linalg.eigh(correlation / np.outer(root, root))
    return np.asarray(root * vectors[:, -1] * max(values[-1] - 1, 0.0) ** 0.5, np.float64)


def _misfit(unique: FloatArray, correlation: FloatArray) -> tuple[float, FloatArray]:
    """What maximum likelihood minimises, and its gradient."""
    root = np.sqrt(unique)
    rest = np.linalg.eigvalsh(correlation / np.outer(root, root))[:-1]
    loadings = _loadings(unique, correlation)
    left = np.outer(loadings, loadings) + np.diag(unique) - correlation
    return float((rest - np.log(rest) - 1).sum()), np.asarray(np.diag(left) / unique**2, np.float64)


def spearman_brown(covariance: FloatArray) -> float:
    """Of a scale with two items. (2, 2)"""
    correlation = float(covariance[0, 1] / np.sqrt(covariance[0, 0] * covariance[1, 1]))
    return 2 * correlation / (1 + correlation)


def _plain_or_none(value: float | None) -> float | None:
    return None if value is None else plain(value)
