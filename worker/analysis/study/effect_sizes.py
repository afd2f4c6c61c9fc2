"""Effect sizes of paired differences with 95 % intervals, and Holm's correction."""

from collections.abc import Sequence

import numpy as np
from scipy import optimize, stats

from worker.analysis.wilson import wilson_interval
from worker.domain.type_aliases import FloatArray

_TAIL = 0.025


def d_z_interval(t: float, n: int) -> tuple[float, float]:
    """Exact interval of Cohen's d_z = t / sqrt(n): the noncentral t distributions in whose tails this t just lies.

    Steiger & Fouladi (1997). ``n``: number of pairs.
    """
    low, high = noncentrality_interval(t, n - 1)
    return low / n**0.5, high / n**0.5


def noncentrality_interval(t: float, degrees_of_freedom: int) -> tuple[float, float]:
    """The noncentral t distributions in whose tails this t just lies."""
    return _noncentrality(t, degrees_of_freedom, 1 - _TAIL), _noncentrality(t, degrees_of_freedom, _TAIL)


def _noncentrality(t: float, degrees_of_freedom: int, share_below: float) -> float:
    """The noncentrality under which so large a share of t values lies below this one."""

    def excess(noncentrality: float) -> float:
        return float(stats.nct.cdf(t, degrees_of_freedom, noncentrality)) - share_below

    # Outwards in small steps: far from t the distribution function underflows, and scipy answers NaN.
    step = 0.25 * (1 + abs(t)) * (1 if excess(t) > 0 else -1)
    inner, outer = t, t + step
    while excess(outer) * excess(inner) > 0:
        inner, outer = outer, outer + step
    return float(optimize.brentq(excess, *sorted((inner, outer)), xtol=1e-9))


def rank_biserial(differences: FloatArray) -> float:
    """Matched-pairs rank-biserial correlation: favourable minus unfavourable share of ranks. (P,) -> [-1, 1]

    Kerby (2014). Zeros are dropped, as in Wilcoxon's test. Raises ValueError when nothing is left.
    """
    moved = differences[differences != 0]
    if len(moved) == 0:
        raise ValueError("All differences are zero.")
    ranks = stats.rankdata(np.abs(moved))
    return float((ranks * np.sign(moved)).sum() / ranks.sum())


def rank_biserial_interval(correlation: float, n: int) -> tuple[float, float]:
    """Approximate interval, after Wilson (1927). ``n``: number of differences that are not zero.

    Signs that are positive half the time give the correlation a variance of 1 / m with m = 3 n (n + 1) / (2 (2 n + 1));
    others, as a share of m trials would have it, about (1 - r^2) / m. So it is Wilson's interval of that share, which
    says something sensible also where all differences point the same way. How often it misses:
    docs/results/error_rates.md.
    """
    trials = 3 * n * (n + 1) / (2 * (2 * n + 1))
    low, high = wilson_interval(trials * (1 + correlation) / 2, trials)
    return max(2 * low - 1, -1.0), min(2 * high - 1, 1.0)


def holm(p_values: Sequence[float | None]) -> list[float | None]:
    """Holm's (1979) step-down p values in the order given; None stands for a test that could not be computed.

    The family is what was to be tested: a test without a result counts in it, as one with p = 1 would.
    """
    known = [index for index, p in enumerate(p_values) if p is not None]
    corrected: list[float | None] = [None] * len(p_values)
    largest = 0.0
    for place, index in enumerate(sorted(known, key=lambda index: p_values[index] or 0.0)):
        largest = max(largest, min(1.0, (p_values[index] or 0.0) * (len(p_values) - place)))
        corrected[index] = largest
    return corrected
