"""Tests between people who met one method and people who met the other: Welch's, a permutation test, equivalence.

One number per person, the mean of their ratings of the method; who rated both methods is in neither group, for the two
numbers of one person are not independent. The cumulative link model, which takes every rating as an order, is in
cumulative_link.py. A difference is second minus first. Measured error rates: docs/results/between.md.
"""

import math
import warnings
from collections.abc import Mapping, Sequence
from functools import lru_cache
from itertools import combinations
from typing import Any

import numpy as np
from scipy import stats

from worker.analysis.study.effect_sizes import noncentrality_interval
from worker.analysis.study.hypothesis_tests import (
    FEWEST_OF_EACH,
    few_of_each,
    not_computable,
    plain,
    two_one_sided,
    welch_freedom,
)
from worker.domain.type_aliases import FloatArray

BETWEEN_TESTS = ("welch_t", "permutation", "cumulative_link_between", "equivalence_between")
"""Names as in app.domain.protocol.PlannedTest."""
MOST_EXACT = 20_000
"""Ways to divide the people; where there are more, as many are drawn."""
_SEED = 112


def welch_t(first: FloatArray, second: FloatArray) -> dict[str, Any]:
    """Welch's (1947) t-test of two independent groups, variances unequal. (P,), (Q,)"""
    reason = why_not(first, second)
    if reason is not None:
        return not_computable(reason)
    with warnings.catch_warnings():  # scipy warns of a group whose people all agree: its variance is 0 exactly
        warnings.simplefilter("ignore", RuntimeWarning)
        outcome = stats.ttest_ind(second, first, equal_var=False)
    interval = outcome.confidence_interval(0.95)
    return {
        "n_first": len(first),
        "n_second": len(second),
        "difference": plain(second.mean() - first.mean()),
        "low": plain(interval.low),
        "high": plain(interval.high),
        "statistic": plain(outcome.statistic),
        "degrees_of_freedom": plain(outcome.df),
        "p": plain(outcome.pvalue),
    }


def equivalence_between(first: FloatArray, second: FloatArray, bound: float) -> dict[str, Any]:
    """Two one-sided Welch tests: is the difference of the means between -bound and bound? (P,), (Q,), bound in points.

    Dannenberg, Dette and Munk (1994) have Welch's degrees of freedom in Schuirmann's tests. ``p`` and ``low_90`` to
    ``high_90`` as in hypothesis_tests.equivalence.
    """
    reason = why_not(first, second)
    if reason is not None:
        return not_computable(reason)
    variances, sizes = [float(group.var(ddof=1)) / len(group) for group in (first, second)], [len(first), len(second)]
    difference, freedom = float(second.mean() - first.mean()), welch_freedom(variances, sizes)
    return {
        "n_first": sizes[0],
        "n_second": sizes[1],
        **two_one_sided(difference, sum(variances) ** 0.5, freedom, bound),
    }


def hedges_g(first: FloatArray, second: FloatArray) -> dict[str, Any]:
    """The difference in pooled standard deviations, corrected for small groups (Hedges 1981), of groups with a spread.

    Its interval comes from the noncentral t distribution and supposes equal variances.
    """
    freedom, scale = len(first) + len(second) - 2, (1 / len(first) + 1 / len(second)) ** 0.5
    small = math.exp(math.lgamma(freedom / 2) - math.lgamma((freedom - 1) / 2)) / (freedom / 2) ** 0.5
    within = ((first - first.mean()) ** 2).sum() + ((second - second.mean()) ** 2).sum()
    g = float(second.mean() - first.mean()) / (within / freedom) ** 0.5
    low, high = noncentrality_interval(g / scale, freedom)
    return {"g": plain(small * g), "g_low": plain(small * low * scale), "g_high": plain(small * high * scale)}


def permutation(first: FloatArray, second: FloatArray) -> dict[str, Any]:
    """Two-sided p of Welch's statistic among all ways to divide the people (Janssen 1997: variances may differ).

    Exact up to MOST_EXACT ways; else among that many drawn with a fixed seed and the one that was seen.
    """
    reason = why_not(first, second)
    if reason is not None:
        return not_computable(reason)
    values = np.concatenate([first, second])
    n, size = len(values), len(first)
    exact, first_group = _divisions(n, size)
    found, mine = np.abs(_statistics(values, first_group)), (np.arange(n) < size)[None].astype(np.float64)
    seen = float(np.abs(_statistics(values, mine))[0])
    return {
        "n_first": size,
        "n_second": n - size,
        "difference": plain(second.mean() - first.mean()),
        "p": float((found >= seen - 1e-9).mean()),
        "exact": exact,
        "ways": len(first_group),
    }


@lru_cache(maxsize=8)
def _divisions(n: int, size: int) -> tuple[bool, FloatArray]:
    """Whether these are all, and the ways to divide n people, (ways, n): 1 for who is in the first group, else 0."""
    if math.comb(n, size) > MOST_EXACT:
        ranks = np.random.default_rng(_SEED).random((MOST_EXACT, n)).argsort(axis=1)
        return False, np.vstack([np.arange(n) < size, ranks < size]).astype(np.float64)
    chosen = np.array(list(combinations(range(n), size)))
    first_group = np.zeros((len(chosen), n))
    first_group[np.arange(len(chosen))[:, None], chosen] = 1.0
    return True, first_group


def _statistics(values: FloatArray, first_group: FloatArray) -> FloatArray:
    """Welch's t of every division, (ways,). No spread within the groups: infinite."""
    centred = values - values.mean()
    size = first_group[0].sum()
    counts = (size, len(values) - size)
    sums, squares = first_group @ centred, first_group @ centred**2
    means = sums / counts[0], -sums / counts[1]
    rest = squares, (centred**2).sum() - squares
    errors = sum(
        np.maximum(square - count * mean**2, 0.0) / (count - 1) / count
        for square, count, mean in zip(rest, counts, means, strict=True)
    )
    difference = means[1] - means[0]
    with np.errstate(divide="ignore", invalid="ignore"):
        t = difference / np.sqrt(np.where(errors < 1e-12, 0.0, errors))
    return np.where(np.abs(difference) < 1e-12, 0.0, t)


def why_not(first: FloatArray, second: FloatArray) -> str | None:
    """Why there is no test between these groups, in words; None where there is one."""
    if min(len(first), len(second)) < FEWEST_OF_EACH:
        return few_of_each(len(first), len(second))
    if np.ptp(first.round(12)) == 0 and np.ptp(second.round(12)) == 0:
        return "all people of each of the two gave the same ratings, so there is no spread to compare with"
    return None


def only_one_of(
    ratings: Mapping[tuple[str, str], FloatArray], first: str, second: str
) -> tuple[list[FloatArray], list[FloatArray]]:
    """Of people who rated ``first`` and not ``second``, and the other way round. ``ratings``: by person and method."""
    of_first, of_second = (
        [given for (person, method), given in ratings.items() if method == mine and (person, other) not in ratings]
        for mine, other in ((first, second), (second, first))
    )
    return of_first, of_second


def means_of(people: Sequence[FloatArray]) -> FloatArray:
    """A number per person, the mean of their ratings, (P,)."""
    return np.array([each.mean() for each in people], np.float64).round(12)
