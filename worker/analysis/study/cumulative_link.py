"""Cumulative link mixed model of ordinal ratings: proportional odds, a random intercept for every person.

logit P(rating <= k) = threshold_k - effects . x - sd u, u standard normal over people (McCullagh 1980; Hedeker and
Gibbons 1994). Maximum likelihood, u integrated out on an even grid: what R's ``ordinal::clmm(rating ~ x + (1 |
person), nAGQ = 10)`` fits. For one smooth integral over a line an even grid loses hardly a digit (Trefethen and
Weideman 2014); ten to fifteen adaptive Gauss-Hermite nodes lose all beyond the third where people differ much.

Its usual standard errors suppose that a difference is the same to everybody, and promise too much where it is not
(docs/results/likert.md). Tests and intervals here count people: the sandwich over people (Liang and Zeger 1986) with
a t of people - 1 degrees of freedom, as in worker.analysis.study.bradley_terry. Where the two groups are different
people, each group has a variance of its own, and t Welch's degrees of freedom (docs/results/between.md).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import optimize, stats
from scipy.special import expit

from worker.analysis.study.hypothesis_tests import (
    FEWEST_OF_EACH,
    few_of_each,
    not_computable,
    plain,
    too_few,
    welch_freedom,
)
from worker.domain.type_aliases import FloatArray

GRID = np.linspace(-8.0, 8.0, 161)
"""Values of u, in standard deviations over people."""
_LOG_WEIGHTS = -(GRID**2) / 2 - np.log(2 * np.pi) / 2 + np.log(GRID[1] - GRID[0])
FEWEST_PEOPLE = 4
"""Below, a covariance over people says nothing."""
MOST = 12.0
"""Log odds; a fit beyond stands for one that is infinite."""
WIDEST = 8.0
"""Standard deviation of people, likewise; up to it the grid is fine enough."""
NO_SPREAD = 1e-6
"""Standard error up to which all people answered alike, so that nothing says how they scatter."""
ALL_THE_SAME = "all ratings of the two are the same, so there is nothing to compare"
_LEAST = 1e-300
_POLISHING = 3
_STEP = 1e-5
"""Of the finite differences of scores."""


@dataclass(frozen=True)
class Fit:
    """Where the likelihood is largest. Parameters in the order thresholds, effects, sd: (T + E + 1,)."""

    thresholds: FloatArray
    effects: FloatArray
    """log odds ratios of a higher rating, (E,)"""
    sd: float
    """of the people's intercepts"""
    log_likelihood: float
    information: FloatArray
    """observed, (parameters, parameters)"""
    scores: FloatArray
    """(people, parameters)"""
    converged: bool

    def covariance(self) -> FloatArray:
        """From the observed information, as R has it: right if the effects are the same to everybody."""
        return np.asarray(np.linalg.pinv(self.information), np.float64)

    def influences(self) -> FloatArray:
        """What each person moves the first effect by, (people,): their squares make the sandwich over people."""
        return np.asarray(self.scores @ self.covariance()[:, len(self.thresholds)], np.float64)


def cumulative_link(first: Sequence[FloatArray], second: Sequence[FloatArray]) -> dict[str, Any]:
    """The model of two groups of ratings; by person: their ratings of each. ``difference``: log odds, second - first.

    ``odds_ratio``: how many times the odds of a rating above any given one are those of the first group.
    """
    n = len(first)
    ratings = np.concatenate([*first, *second]) if n else np.empty(0)
    reason = _why_not(ratings, n)
    if reason is not None:
        return not_computable(reason)
    return tested(fit_two(first, second), len(ratings))


def cumulative_link_between(first: Sequence[FloatArray], second: Sequence[FloatArray]) -> dict[str, Any]:
    """The model of two groups of different people; by person: their ratings. Numbers as in ``cumulative_link``."""
    reason = why_not_between(first, second)
    if reason is not None:
        return not_computable(reason)
    return tested_between(fit_two(first, second, paired=False), len(first), sum(map(len, (*first, *second))))


def why_not_between(first: Sequence[FloatArray], second: Sequence[FloatArray]) -> str | None:
    """Why there is no model of these groups of people, in words; None where there may be one."""
    if min(len(first), len(second)) < FEWEST_OF_EACH:
        return few_of_each(len(first), len(second))
    return ALL_THE_SAME if np.ptp(np.concatenate([*first, *second])) == 0 else None


def tested(found: Fit, ratings: int) -> dict[str, Any]:
    """What ``cumulative_link`` says of a model of two groups that is fitted to so many ratings."""
    n = len(found.scores)
    variance = n / (n - 1) * float((found.influences() ** 2).sum())
    numbers = _numbers(found, variance, n - 1)
    return numbers if "not_computable" in numbers else {"n": n, "n_ratings": ratings, **numbers}


def tested_between(found: Fit, people: int, ratings: int) -> dict[str, Any]:
    """The same of different people, of whom the first ``people`` are the first group.

    As Welch (1947) has it: a variance for each group, and the degrees of freedom of their sum.
    """
    groups = np.split(found.influences(), [people])
    sizes = [len(each) for each in groups]
    variances = [n / (n - 1) * float((each**2).sum()) for n, each in zip(sizes, groups, strict=True)]
    numbers = _numbers(found, sum(variances), welch_freedom(variances, sizes))
    if "not_computable" in numbers:
        return numbers
    return {"n_first": sizes[0], "n_second": sizes[1], "n_ratings": ratings, **numbers}


def _numbers(found: Fit, variance: float, freedom: float) -> dict[str, Any]:
    difference, error = float(found.effects[0]), variance**0.5
    if not found.converged or abs(difference) > MOST or found.sd > WIDEST:
        return not_computable("the ratings of the two, or of the people, overlap so little that no finite model fits")
    if error < NO_SPREAD:
        return not_computable(f"all {len(found.scores)} people answered alike, so there is no spread to compare with")
    margin = float(stats.t.ppf(0.975, freedom)) * error
    ends = {"low": difference - margin, "high": difference + margin}
    return {
        "difference": plain(difference),
        "standard_error": plain(error),
        **ends,
        "odds_ratio": _odds(difference),
        **{f"odds_ratio_{name}": _odds(end) for name, end in ends.items()},
        "statistic": plain(difference / error),
        "degrees_of_freedom": freedom,
        "p": plain(2 * stats.t.sf(abs(difference / error), freedom)),
        "sd_between_people": plain(found.sd),
    }


def fit_two(first: Sequence[FloatArray], second: Sequence[FloatArray], *, paired: bool = True) -> Fit:
    """rating ~ group + (1 | person); by person: their ratings of each group, or other people's of the second."""
    sizes = [[len(each) for each in group] for group in (first, second)]
    people = [np.arange(len(first)), np.arange(len(second)) + (0 if paired else len(first))]
    person = np.concatenate([np.repeat(who, each) for who, each in zip(people, sizes, strict=True)])
    x = np.repeat([0.0, 1.0], [sum(each) for each in sizes])[:, None]
    return fit(np.concatenate([*first, *second]), x, person)


def _why_not(ratings: FloatArray, people: int) -> str | None:
    if people < FEWEST_PEOPLE:
        return too_few(people, FEWEST_PEOPLE)
    if np.ptp(ratings) == 0:
        return ALL_THE_SAME
    return None


def _odds(log_odds: float) -> float | None:
    return plain(np.exp(log_odds)) if abs(log_odds) < 700 else None


@dataclass(frozen=True)
class _Data:
    """Ratings counted: what is the same of one person adds to the likelihood alike."""

    levels: npt.NDArray[np.int64]
    """of every kind of rating, 0 up to the number of levels that occur, less one: (C,)"""
    x: FloatArray
    """(C, E)"""
    counts: FloatArray
    """how many each person gave of each kind, (P, C)"""


def _counted(levels: npt.NDArray[np.int64], x: FloatArray, person: npt.NDArray[np.int64]) -> _Data:
    kinds, which = np.unique(np.column_stack([levels, x]), axis=0, return_inverse=True)
    counts = np.zeros((int(person.max()) + 1, len(kinds)))
    np.add.at(counts, (person, which.ravel()), 1.0)
    return _Data(kinds[:, 0].astype(np.int64), kinds[:, 1:], counts)


def fit(ratings: FloatArray, x: FloatArray, person: npt.NDArray[np.int64]) -> Fit:
    """``ratings`` (R,), of which two values at least occur; ``x`` (R, E) without intercept; ``person`` (R,) from 0."""
    found, levels = np.unique(ratings, return_inverse=True)
    data = _counted(levels, np.asarray(x, np.float64), person)
    below = np.cumsum(np.bincount(levels))[:-1] / len(levels)
    cuts = np.log(below / (1 - below))
    start = np.concatenate([cuts[:1], np.log(np.diff(cuts)), np.zeros(data.x.shape[1]), [1.0]])
    count = len(found) - 1

    def misfit(free: FloatArray) -> tuple[float, FloatArray]:
        values, scores = _likelihoods(_ordered(free, count), data, count)
        gradient = scores.sum(axis=0)
        later = np.cumsum(gradient[:count][::-1])[::-1]
        gradient[:count] = np.concatenate([later[:1], later[1:] * np.exp(free[1:count])])
        return -float(values.sum()), -gradient

    ends = [(-30.0, 30.0)] + [(-12.0, 3.5)] * (count - 1) + [(-MOST - 1, MOST + 1)] * (len(start) - count)
    best = optimize.minimize(misfit, start, jac=True, method="L-BFGS-B", bounds=ends, options={"ftol": 1e-13})
    parameters = _ordered(best.x, count)
    step = np.linalg.pinv(_information(parameters, data, count))
    for _ in range(_POLISHING):  # Newton's steps find the last digits, which a search along lines does not
        parameters = parameters + step @ _likelihoods(parameters, data, count)[1].sum(axis=0)
    values, scores = _likelihoods(parameters, data, count)
    return Fit(
        thresholds=parameters[:count],
        effects=parameters[count:-1],
        sd=abs(float(parameters[-1])),
        log_likelihood=float(values.sum()),
        information=_information(parameters, data, count),
        scores=scores,
        converged=bool(np.abs(scores.sum(axis=0)).max() < 1e-6),
    )


def _ordered(free: FloatArray, count: int) -> FloatArray:
    """Thresholds from the first one and the logarithms of the gaps; what follows stays."""
    gaps = np.concatenate([free[:1], np.exp(free[1:count])])
    return np.concatenate([np.cumsum(gaps), free[count:]])


def _information(parameters: FloatArray, data: _Data, count: int) -> FloatArray:
    steps = _STEP * np.eye(len(parameters))
    rows = [
        (_likelihoods(parameters - step, data, count)[1] - _likelihoods(parameters + step, data, count)[1]).sum(axis=0)
        for step in steps
    ]
    found = np.array(rows) / (2 * _STEP)
    return np.asarray((found + found.T) / 2, np.float64)


def _likelihoods(parameters: FloatArray, data: _Data, count: int) -> tuple[FloatArray, FloatArray]:
    """Each person's log-likelihood (P,) and its derivatives (P, parameters), by Fisher's identity."""
    ends = np.concatenate([[-np.inf], parameters[:count], [np.inf]])
    shift = (data.x @ parameters[count:-1])[:, None] + parameters[-1] * GRID
    lower, upper = ends[data.levels][:, None], ends[data.levels + 1][:, None]
    at_most, at_least = expit(upper - shift), expit(shift - lower)
    chance = np.maximum(at_most * at_least * -np.expm1(lower - upper), _LEAST)  # no difference of near equals
    logs = data.counts @ np.log(chance) + _LOG_WEIGHTS
    most = logs.max(axis=1, keepdims=True)
    likely = np.exp(logs - most)
    total = likely.sum(axis=1, keepdims=True)
    values, posterior = (most + np.log(total))[:, 0], likely / total

    def expected(slopes: FloatArray) -> FloatArray:
        return np.asarray(data.counts * (posterior @ slopes.T), np.float64)

    by_effect = expected(at_most - at_least)
    by_upper = expected(at_most * (1 - at_most) / chance)
    by_lower = expected(at_least * (1 - at_least) / chance)
    is_upper, is_lower = (data.levels[:, None] == np.arange(count) + lies for lies in (0, 1))
    by_sd = expected((at_most - at_least) * GRID).sum(axis=1)
    return values, np.column_stack([by_upper @ is_upper - by_lower @ is_lower, by_effect @ data.x, by_sd])
