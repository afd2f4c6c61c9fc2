"""How well the items of a scale agree: Cronbach's alpha, McDonald's omega, and of two items Spearman-Brown.

Input is (N, K): N filled-in questionnaires of different people, K items, those that are reversed mirrored already.

alpha = K / (K - 1) (1 - sum of item variances / variance of the sum) (Cronbach 1951), with the F interval of Feldt,
Woodruff and Salih (1987): (1 - true) / (1 - found) ~ F(N - 1, (N - 1)(K - 1)). It is exact where items are normal and
equally good; how far it is off elsewhere is in docs/results/reliability.md. Where items are not equally good, alpha is
below the reliability. omega = (sum of loadings)^2 / ((sum of loadings)^2 + sum of unique variances) of one factor,
fitted by maximum likelihood (McDonald 1999), allows for that. Two items do not identify a factor: there, as Eisinga,
te Grotenhuis and Pelzer (2013) advise, it is Spearman-Brown's 2 r / (1 + r).
"""

import warnings
from typing import Any

import numpy as np
from scipy import stats

from worker.analysis.study.hypothesis_tests import not_computable, plain
from worker.domain.type_aliases import FloatArray

FEWEST = 3
"""Filled-in questionnaires."""
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

    Fewer people than items, or items that determine each other, leave no likelihood to maximise.
    """
    from statsmodels.multivariate.factor import Factor  # a second to load, and few reports need it

    scale = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(scale, scale)
    if people <= len(covariance) or np.linalg.eigvalsh(correlation)[0] < 1e-8:
        return None
    with warnings.catch_warnings():  # a fit at the edge of what is possible is judged by its result
        warnings.simplefilter("ignore")
        try:
            fit = Factor(corr=correlation, n_factor=1, method="ml", nobs=people).fit()
        except (np.linalg.LinAlgError, ValueError):
            return None
    loadings = np.asarray(fit.loadings)[:, 0] * scale
    unique = np.asarray(fit.uniqueness) * scale**2
    if not (np.isfinite(loadings).all() and np.isfinite(unique).all() and (unique >= 0).all()):
        return None
    common = float(loadings.sum() ** 2)
    return common / (common + float(unique.sum()))


def spearman_brown(covariance: FloatArray) -> float:
    """Of a scale with two items. (2, 2)"""
    correlation = float(covariance[0, 1] / np.sqrt(covariance[0, 0] * covariance[1, 1]))
    return 2 * correlation / (1 + correlation)


def _plain_or_none(value: float | None) -> float | None:
    return None if value is None else plain(value)
