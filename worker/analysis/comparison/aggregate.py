"""Many runs in one number: interquartile means, probabilities of improvement, profiles (Agarwal et al. 2021).

The definitions are those of rliable (arXiv 2108.13264), which was archived in 2025. A stratum is what they call a task,
here a task of the robot and a user; a run is one seed, and its score the mean over its scenarios. The bootstrap is
stratified: within each stratum seeds are drawn with replacement, and within each drawn seed scenarios, which are the
same for two methods that are compared. With one seed per stratum only scenarios are drawn, so an interval says nothing
about another training.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.stats import trim_mean

from worker.domain.type_aliases import FloatArray

DRAWS, CHUNK = 2_000, 100
"""of the bootstrap, and so many at once"""
LEVEL = 0.95
Strata = Sequence[FloatArray]
"""per stratum (seeds, scenarios) what was gained"""


class Estimate(NamedTuple):
    """A number with its bootstrap interval (percentiles)."""

    value: float
    low: float
    high: float


def interquartile_mean(runs: Sequence[FloatArray]) -> FloatArray:
    """Mean of the middle half of all runs of all strata. Per stratum (..., seeds) -> (...)"""
    return np.asarray(trim_mean(np.concatenate(runs, axis=-1), 0.25, axis=-1))


def probability_of_improvement(runs: Sequence[FloatArray], others: Sequence[FloatArray]) -> FloatArray:
    """Mean over strata of P(a run is better than one of the others), ties half. Per stratum (..., seeds) -> (...)"""
    shares = []
    for own, other in zip(runs, others, strict=True):
        change = own[..., :, None] - other[..., None, :]
        shares.append((change > 0).mean(axis=(-1, -2)) + 0.5 * (change == 0).mean(axis=(-1, -2)))
    return np.asarray(np.mean(shares, axis=0))


def difference(runs: Sequence[FloatArray], others: Sequence[FloatArray]) -> FloatArray:
    """Of the interquartile means."""
    return interquartile_mean(runs) - interquartile_mean(others)


def profile(strata: Strata, thresholds: Sequence[float]) -> list[float]:
    """Share of runs that gain more than each threshold."""
    runs = np.concatenate(_scores(strata))
    return [float((runs > each).mean()) for each in thresholds]


def estimate(strata: Strata, seed: int = 0) -> Estimate:
    """The interquartile mean of one method."""
    return compare(strata, strata, lambda runs, _: interquartile_mean(runs), seed)


def compare(
    strata: Strata,
    others: Strata,
    measure: Callable[[Sequence[FloatArray], Sequence[FloatArray]], FloatArray],
    seed: int = 0,
) -> Estimate:
    """A measure of two methods with the same seeds and scenarios in every stratum. Raises ValueError when they differ.

    Drawn seeds are the same for both, too: labels of a seed are shared.
    """
    if [each.shape for each in strata] != [each.shape for each in others] or not strata:
        raise ValueError("Both methods need the same seeds and scenarios in every stratum, and one at least.")
    rng = np.random.default_rng(seed)
    pairs = [_resampled(own, other, rng) for own, other in zip(strata, others, strict=True)]
    drawn = measure([own for own, _ in pairs], [other for _, other in pairs])
    low, high = np.quantile(drawn, [0.5 - 0.5 * LEVEL, 0.5 + 0.5 * LEVEL])
    return Estimate(float(measure(_scores(strata), _scores(others))), float(low), float(high))


def _scores(strata: Strata) -> list[FloatArray]:
    return [each.mean(axis=1) for each in strata]


def _resampled(own: FloatArray, other: FloatArray, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Scores (DRAWS, seeds) of seeds and scenarios drawn anew."""
    drawn: list[tuple[FloatArray, FloatArray]] = []
    for _ in range(DRAWS // CHUNK):
        seeds = rng.integers(own.shape[0], size=(CHUNK, own.shape[0], 1))
        scenarios = rng.integers(own.shape[1], size=(CHUNK, *own.shape))
        drawn.append((own[seeds, scenarios].mean(axis=-1), other[seeds, scenarios].mean(axis=-1)))
    first, second = zip(*drawn, strict=True)
    return np.concatenate(first), np.concatenate(second)
