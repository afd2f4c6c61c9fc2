"""Preferential Bayesian optimisation over modes: no reward model, no signals, only duels of whole episodes.

A Gaussian process over the mode's coordinates is the utility, a logistic likelihood the answer (Chu and Ghahramani
2005, with Laplace's approximation), and duels are drawn by Thompson sampling twice (Gonzalez et al. 2017, arXiv
1704.03651; Takeno et al. 2023). As in CrashPBO (arXiv 2604.01776) nothing is tried that is expected to lose the task;
here the response surface, which is made once for everybody, says so. It tests what a reward that is linear in measured
signals costs: this one assumes none.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.linalg import cho_factor, cho_solve
from scipy.special import expit, log_expit

from worker.domain.scenarios import RESIDUAL, first_of
from worker.domain.type_aliases import FloatArray
from worker.ml.filters.fitting.filter_problem import Collect, FilterProblem
from worker.ml.filters.fitting.mode_worth import SUCCESS_TOLERANCE
from worker.ml.filters.fitting.response_surface import CAUTION, ResponseSurface
from worker.ml.methods.kept_task import in_mode
from worker.ml.methods.people import Person

BATCH = 10
"""duels between two fits, as everybody's labels"""
CANDIDATES = 400
"""random modes among which a duel is drawn"""
LENGTHS = (0.3, 0.6, 1.2, 2.4)
"""of the kernel, in ranges of an axis; the one with the largest evidence is used"""
VARIANCE = 9.0
"""of the utility, in log odds: three is 95 to 5"""
JITTER = 1e-6
NEWTON_STEPS = 30

Duels = npt.NDArray[np.int64]
"""(N, 2) rows of the points: loser, winner"""
Duel = Callable[[FloatArray, FloatArray], float]
"""two points (A,) -> P(second preferred) in {0, 1/2, 1}"""


@dataclass(frozen=True)
class Utility:
    """Posterior of the utility at M points in [0, 1]^A: N(mean, covariance) elsewhere by the kernel."""

    points: FloatArray
    """(M, A)"""
    length: float
    weights: FloatArray
    """(M,) K^-1 of the mode"""
    shrink: FloatArray
    """(M, M) such that the covariance is k(x, x') - k(x, points) shrink k(points, x')"""
    evidence: float
    """log p(answers), Laplace's approximation"""

    def mean(self, points: FloatArray) -> FloatArray:
        """(N, A) -> (N,)"""
        mean: FloatArray = kernel(points, self.points, self.length) @ self.weights
        return mean

    def sample(self, points: FloatArray, rng: np.random.Generator) -> FloatArray:
        """One joint draw, (N, A) -> (N,)"""
        across = kernel(points, self.points, self.length)
        covariance = kernel(points, points, self.length) - across @ self.shrink @ across.T
        root = np.linalg.cholesky(covariance + 1e-4 * VARIANCE * np.eye(len(points)))
        drawn: FloatArray = across @ self.weights + root @ rng.standard_normal(len(points))
        return drawn


def kernel(left: FloatArray, right: FloatArray, length: float) -> FloatArray:
    """Squared exponential with deviation sqrt(VARIANCE), (N, A), (M, A) -> (N, M)"""
    squared = ((left[:, None] - right[None]) ** 2).sum(axis=-1)
    return np.asarray(VARIANCE * np.exp(-0.5 * squared / length**2))


def fit_utility(points: FloatArray, answers: FloatArray) -> Utility:
    """``points`` (2 N, A): both of a duel one after the other; ``answers`` (N,): P(second preferred)."""
    return max((_laplace(points, answers, each) for each in LENGTHS), key=lambda found: found.evidence)


def _laplace(points: FloatArray, answers: FloatArray, length: float) -> Utility:
    prior = kernel(points, points, length) + JITTER * np.eye(len(points))
    contrast = np.kron(np.eye(len(answers)), np.array([[-1.0, 1.0]]))
    spread = contrast @ prior @ contrast.T  # of the differences, of which alone anything is seen
    differences = np.zeros(len(answers))
    for _ in range(NEWTON_STEPS):
        chance = expit(differences)
        noise = np.diag(1.0 / np.maximum(chance * (1.0 - chance), 1e-9))
        target = differences + np.diag(noise) * (answers - chance)
        step = spread @ cho_solve(cho_factor(spread + noise), target) - differences
        differences = differences + step * min(1.0, 3.0 / max(float(np.abs(step).max()), 1e-12))
        if np.abs(step).max() < 1e-6:
            break
    chance = expit(differences)
    noise = np.diag(1.0 / np.maximum(chance * (1.0 - chance), 1e-9))
    factor = cho_factor(spread + noise)
    said = float((answers * log_expit(differences) + (1.0 - answers) * log_expit(-differences)).sum())
    pull = answers - chance  # at the mode K^-1 f, in differences
    volume = np.linalg.slogdet(np.eye(len(answers)) + spread / np.diag(noise))[1]
    evidence = said - 0.5 * float(differences @ pull) - 0.5 * float(volume)
    return Utility(points, length, contrast.T @ pull, contrast.T @ cho_solve(factor, contrast), evidence)


def best_by_duels(
    duel: Duel, safe: Callable[[int, np.random.Generator], FloatArray], count: int, seed: int
) -> FloatArray:
    """(A,) the point of the largest posterior mean after so many duels.

    ``safe``: so many random points in [0, 1]^A that may be tried, the first of which is always the same.
    """
    rng = np.random.default_rng([seed, 22])
    points, answers = np.empty((0, safe(1, rng).shape[1])), np.empty(0)
    utility: Utility | None = None
    while len(answers) < count:
        for _ in range(min(BATCH, count - len(answers))):
            first, second = _pair(utility, safe(CANDIDATES, rng), rng)
            points = np.concatenate([points, first[None], second[None]])
            answers = np.append(answers, duel(first, second))
        utility = fit_utility(points, answers)
    if utility is None:
        return np.asarray(safe(1, rng)[0])
    candidates = np.concatenate([safe(5000, rng), points])
    return np.asarray(candidates[int(np.argmax(utility.mean(candidates)))])


def _pair(utility: Utility | None, candidates: FloatArray, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Two different candidates, in a random order."""
    if utility is None:
        rows = rng.choice(len(candidates), 2, replace=False)
    else:
        first = int(np.argmax(utility.sample(candidates, rng)))
        again = utility.sample(candidates, rng)
        again[first] = -np.inf
        rows = rng.permutation([first, int(np.argmax(again))])
    return candidates[rows[0]], candidates[rows[1]]


def best_mode_by_duels(
    person: Person, problem: FilterProblem, surface: ResponseSurface, collect: Collect, count: int
) -> FloatArray:
    """(A,) the mode that so many duels lead to; both of a duel are whole episodes of one scenario."""
    scenarios = iter(first_of(RESIDUAL, max(count, 1)))
    rng = np.random.default_rng([problem.seed, 23])
    width = surface.high - surface.low

    def duel(first: FloatArray, second: FloatArray) -> float:
        scenario = next(scenarios)
        left, right = (
            collect(in_mode(problem, surface.low + each * width), [scenario], 0.0, problem.seed)[0]
            for each in (first, second)
        )
        return person.prefers(left, right, rng)

    def safe(wanted: int, draws: np.random.Generator) -> FloatArray:
        """The reference policy's own way, and what is not expected to lose the task."""
        drawn = draws.uniform(surface.low, surface.high, (8 * wanted, len(width)))
        keeps = surface.predict(drawn, CAUTION)[1] >= -SUCCESS_TOLERANCE
        modes = np.concatenate([np.zeros((1, len(width))), drawn[keeps]])[:wanted]
        return np.asarray((modes - surface.low) / width)

    return surface.low + best_by_duels(duel, safe, count, problem.seed) * width
