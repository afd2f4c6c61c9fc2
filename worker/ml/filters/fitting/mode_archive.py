"""Modes that were tried, and what is expected of modes like them: what a response surface errs by, how hard they press.

Gaussian process regression (Kennedy & O'Hagan 2001 for a simulator's errors), decisions 187 to 190.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np

from worker.domain.type_aliases import FloatArray
from worker.ml.filters.fitting.mode_worth import price_of_failures

LENGTH = 0.5
"""of the axes' ranges, over which modes are alike"""
NOISE = 0.1
"""Variance of what was measured that is expected to be chance, in units of that which is not."""
PRESSED = 0.035
"""Share of scenarios in which the largest force grows by more than is said of a mode."""


@dataclass(frozen=True)
class ModeArchive:
    """K modes that people drawn from a population would be given by a response surface.

    The surface errs by some percent where it promises most, so that what is best for one of them by measurement often
    serves others better than what the surface calls best for these (decision 187).
    """

    modes: FloatArray
    """(K, A)"""
    signals: FloatArray
    """(K, S) mean change of the episode's summed signals"""
    success: FloatArray
    """(K,) change of the share of episodes in which the task is done"""
    force_growth_n: FloatArray
    """(K,) of an episode's largest force on the person, see tail_growth_n()"""

    def best(self, weights: FloatArray, most_growth_n: float = np.inf) -> FloatArray | None:
        """(A,) the mode with the best return for these weights on the signals, (S,) or (E, S) for E members.

        ``most_growth_n``: by which the largest force may grow. None: no mode is better than the reference policy.
        """
        returns = self.signals @ np.atleast_2d(weights).mean(axis=0)
        unit = max(float(returns.std()), 1e-9)
        worth = returns / unit - price_of_failures(self.success)
        worth = np.where(self.force_growth_n <= most_growth_n, worth, -np.inf)
        best = int(np.argmax(worth))
        return self.modes[best] if returns[best] > 0.0 and np.isfinite(worth[best]) else None


@dataclass(frozen=True)
class ModeForces:
    """How much harder people are pressed in K modes that were tried, and what is expected of others (decision 189)."""

    modes: FloatArray
    """(K, A)"""
    growth_n: FloatArray
    """(K,) of an episode's largest force on the person, see tail_growth_n()"""
    width: FloatArray
    """(A,) of the axes' ranges"""

    def growth_n_of(self, modes: FloatArray) -> FloatArray:
        """(..., A) -> (...) expected; 0 where nothing like them was tried."""
        return expected_of_alike(modes, self.modes, self.growth_n, self.width)

    def with_observed(self, mode: FloatArray, growth_n: float) -> Self:
        """After one more mode, (A,), was tried."""
        return type(self)(np.vstack([self.modes, mode]), np.append(self.growth_n, growth_n), self.width)


def tail_growth_n(growth_n: FloatArray) -> FloatArray:
    """(N, ...) by how much the largest force grew in N scenarios -> (...), in N: what PRESSED of them exceed."""
    return np.asarray(np.quantile(growth_n, 1.0 - PRESSED, axis=0))


def expected_of_alike(asked: FloatArray, tried: FloatArray, measured: FloatArray, width: FloatArray) -> FloatArray:
    """(..., A), (K, A), (K, ...) -> (..., ...): what is expected of modes, by what was measured in others.

    The posterior mean of a Gaussian process that is 0 at the reference policy, whose mode is 0. ``width``: (A,) of the
    axes' ranges.
    """
    covariance = _covariance(tried, tried, width) + NOISE * np.eye(len(tried))
    return _covariance(asked, tried, width) @ np.asarray(np.linalg.solve(covariance, measured), np.float64)


def _covariance(first: FloatArray, second: FloatArray, width: FloatArray) -> FloatArray:
    """(..., A), (K, A) -> (..., K), given that the mode 0 changes nothing."""
    left, right = first / (LENGTH * width), second / (LENGTH * width)
    from_reference = ((left**2).sum(axis=-1)[..., None], (right**2).sum(axis=-1))
    both = from_reference[0] + from_reference[1]
    return np.asarray(np.exp(left @ right.T - both / 2) - np.exp(-both / 2), np.float64)
