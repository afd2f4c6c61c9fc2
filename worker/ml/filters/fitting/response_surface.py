"""What each execution mode changes, for everybody: a small regression fitted once from rollouts of random modes.

It predicts how the summed signals of an episode and its chance of success differ from the reference policy's in the
same scenario. Given a person's weights on the signals, their best mode is then found without any further rollout.
"""

import json
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Self

import numpy as np
import numpy.typing as npt
from safetensors.numpy import load, save
from scipy.special import expit, logit

from worker.domain.modes import ModeFamily
from worker.domain.trajectory import SIGNALS
from worker.domain.type_aliases import FloatArray
from worker.ml.filters.fitting.mode_archive import ModeArchive, ModeForces, expected_of_alike
from worker.ml.filters.fitting.mode_worth import SUCCESS_PENALTY, price_of_failures
from worker.ml.rewards.reward_models import stored_config

RIDGE = 1.0
OUTLIER_SHARE = 0.005
"""Share at either end of every column that is cut to the quantile: a few crashes must not bend the surface."""

DRAWS = 20_000
CAUTION = 1.0
"""Standard deviations that are subtracted from a mode's predicted log odds of success, and where nothing is expected of
a person (see best_mode) from its predicted return: the best of many is the one that is most likely overestimated."""
REFERENCE_PRECISION = 0.1
"""Of the prior of the reference policy's log odds of success: it is known from data alone."""
NEWTON_STEPS = 15
LONGEST_STEP = 3.0
_ARCHIVE = "archive/"


@dataclass(frozen=True)
class ResponseSurface:
    """psi(mode) @ coefficients: change of the summed signals; sigmoid([1, psi(mode)] @ log_odds): chance of success.

    What the first gets wrong in the modes of an archive is expected of modes like them, too. Of success it is not: what
    200 scenarios say of that is half chance, and the luckiest would be sought (decision 188).
    """

    coefficients: FloatArray
    """(M, S)"""
    gram: FloatArray
    """(M, M) of the rollouts behind the coefficients, ridge included: how sure they are in which direction"""
    log_odds: FloatArray
    """(1 + M,) of success; the first belongs to the reference policy"""
    precision: FloatArray
    """(1 + M, 1 + M) of the log odds (Laplace approximation of their posterior)"""
    low: FloatArray
    """(A,) range of the modes it was fitted on"""
    high: FloatArray
    axes: tuple[str, ...]
    signals: tuple[str, ...] = SIGNALS
    """names of the columns of the coefficients"""
    archive: ModeArchive | None = None
    """modes that were tried for everybody; None: none were"""

    def predict(self, modes: npt.ArrayLike, caution: float = 0.0) -> tuple[FloatArray, FloatArray]:
        """(..., A) -> changes of the summed signals (..., S) and of the chance of success (...).

        With ``caution`` the log odds of success are taken so many of their standard deviations lower.
        """
        at = np.asarray(modes, np.float64)
        signals, success = self._regressed(at, caution)
        if self.archive is None:
            return signals, success
        tried = self.archive.modes
        errors = self.archive.signals - self._regressed(tried)[0]
        return signals + expected_of_alike(at, tried, errors, self.high - self.low), success

    @property
    def forces(self) -> ModeForces:
        """What is known of modes' forces before any was tried for a person: nothing without an archive."""
        width = self.high - self.low
        if self.archive is None:
            return ModeForces(np.zeros((0, len(width))), np.zeros(0), width)
        return ModeForces(self.archive.modes, self.archive.force_growth_n, width)

    def _regressed(self, modes: FloatArray, caution: float = 0.0) -> tuple[FloatArray, FloatArray]:
        features = monomials(modes)
        doubt = np.linalg.inv(self.precision)[1:, 1:]
        deviation = np.sqrt(np.maximum(((features @ doubt) * features).sum(axis=-1), 0.0))
        change = features @ self.log_odds[1:] - caution * deviation
        return features @ self.coefficients, expit(self.log_odds[0] + change) - expit(self.log_odds[0])

    def with_observed(self, mode: FloatArray, signal_deltas: FloatArray, successes: FloatArray) -> Self:
        """The surface after N more rollouts of one mode (A,): as if it had been fitted with them.

        signal_deltas (N, S) and successes (N,) as in fit(). Nearby modes are predicted anew, too; others hardly.
        """
        features = monomials(mode)
        gram = self.gram + len(signal_deltas) * np.outer(features, features)
        moments = self.gram @ self.coefficients + np.outer(features, signal_deltas.sum(axis=0))
        repeated = np.repeat(_with_one(features[None]), len(successes), axis=0)
        log_odds, precision = _logistic(repeated, successes, self.log_odds, self.precision)
        coefficients = np.asarray(np.linalg.solve(gram, moments), np.float64)
        return replace(self, coefficients=coefficients, gram=gram, log_odds=log_odds, precision=precision)

    def to_bytes(self) -> bytes:
        """One safetensors file."""
        config = {"axes": list(self.axes), "kind": "response surface", "signals": list(self.signals)}
        names = ("coefficients", "gram", "log_odds", "precision", "low", "high")
        tensors = {name: getattr(self, name) for name in names}
        if self.archive:
            tensors |= {f"{_ARCHIVE}{name}": array for name, array in vars(self.archive).items()}
        return save(
            {name: np.ascontiguousarray(array, np.float32) for name, array in tensors.items()},
            metadata={"config": json.dumps(config, sort_keys=True)},
        )

    @classmethod
    def from_bytes(cls, stored: bytes, family: ModeFamily, signals: tuple[str, ...] = SIGNALS) -> Self:
        """Read what to_bytes() wrote. Raises ValueError when it was fitted for other signals or axes than today's."""
        config = stored_config(stored)
        if config.get("signals") != list(signals) or config.get("axes") != list(family.names):
            raise ValueError(
                "This response surface was fitted for other signals or axes; `python -m worker explore` fits another."
            )
        tensors = {name: array.astype(np.float64) for name, array in load(stored).items()}
        archived = [name for name in tensors if name.startswith(_ARCHIVE)]
        of_archive = {name.removeprefix(_ARCHIVE): tensors.pop(name) for name in archived}
        of_today = set(of_archive) == {each.name for each in fields(ModeArchive)}  # none, or without forces: not used
        archive = ModeArchive(**of_archive) if of_today else None
        return cls(**tensors, axes=family.names, signals=signals, archive=archive)

    def save(self, path: Path) -> None:
        """Write to_bytes() to a file."""
        path.write_bytes(self.to_bytes())

    @classmethod
    def load(cls, path: Path, family: ModeFamily, signals: tuple[str, ...] = SIGNALS) -> Self:
        """Read a file written by save()."""
        return cls.from_bytes(path.read_bytes(), family, signals)


def monomials(modes: FloatArray) -> FloatArray:
    """(..., A) -> (..., M): first order, second order with cross terms, pure third order. No constant: 0 maps to 0."""
    axes = np.ascontiguousarray(np.moveaxis(modes, -1, 0))  # whole columns at a time: half the time of going by modes
    first, second = np.triu_indices(len(axes))
    found = np.concatenate([axes, axes[first] * axes[second], axes**3])
    return np.ascontiguousarray(np.moveaxis(found, 0, -1))


def fit(
    family: ModeFamily,
    modes: FloatArray,
    signal_deltas: FloatArray,
    successes: FloatArray,
    signals: tuple[str, ...] = SIGNALS,
) -> ResponseSurface:
    """Ridge regression of the signals and logistic regression of success, from N paired rollouts.

    modes (N, A); signal_deltas (N, S): summed signals of the rollout with this mode minus those of the reference
    rollout of the same scenario; successes (N,): 1 or 0.
    """
    low, high = np.quantile(signal_deltas, [OUTLIER_SHARE, 1 - OUTLIER_SHARE], axis=0)
    features = monomials(np.asarray(modes, np.float64))
    gram = features.T @ features + RIDGE * np.eye(features.shape[1])
    unsure = np.diag([REFERENCE_PRECISION, *np.full(features.shape[1], RIDGE)])
    usual = np.array([logit(np.clip(np.mean(successes), 0.01, 0.99)), *np.zeros(features.shape[1])])
    log_odds, precision = _logistic(_with_one(features), np.asarray(successes, np.float64), usual, unsure)
    return ResponseSurface(
        np.asarray(np.linalg.solve(gram, features.T @ np.clip(signal_deltas, low, high)), np.float64),
        gram,
        log_odds,
        precision,
        np.array([axis.low for axis in family.axes]),
        np.array([axis.high for axis in family.axes]),
        family.names,
        signals,
    )


def _with_one(features: FloatArray) -> FloatArray:
    return np.concatenate([np.ones((len(features), 1)), features], axis=1)


def _logistic(
    features: FloatArray, successes: FloatArray, mean: FloatArray, precision: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Mode and precision of the posterior of log odds (P,) with the prior N(mean, precision^-1), by Newton's method."""
    weights = mean
    for _ in range(NEWTON_STEPS):
        chance = expit(features @ weights)
        gradient = features.T @ (chance - successes) + precision @ (weights - mean)
        hessian = features.T @ (features * (chance * (1.0 - chance))[:, None]) + precision
        step = np.linalg.solve(hessian, gradient)
        weights = weights - step * min(1.0, LONGEST_STEP / max(float(np.linalg.norm(step)), 1e-12))
    chance = expit(features @ weights)
    return weights, features.T @ (features * (chance * (1.0 - chance))[:, None]) + precision


def best_mode(
    surface: ResponseSurface,
    weights: FloatArray,
    seed: int,
    *,
    penalty: float = SUCCESS_PENALTY,
    caution: float = 0.0,
    success_caution: float = CAUTION,
    forces: ModeForces | None = None,
    most_growth_n: float = np.inf,
    further: FloatArray | None = None,
) -> FloatArray:
    """(A,) the mode with the best predicted return for these weights on the signals, (S,) or (E, S) for E members.

    The return counts as the members' mean less ``caution`` of their standard deviations. With a prior that expects
    something of people caution costs more than it saves, however few the labels (docs/results/few_answers.md). The
    chance of success is taken ``success_caution`` of its standard deviations lower. ``most_growth_n``: by which the
    largest force on the person may grow, as far as ``forces`` foresee it. ``further``: (M,) coefficients of what a mode
    changes of the return beyond the signals. Random search with two local refinements; the mode 0 is always among the
    candidates and wins ties, so that somebody for whom nothing is better keeps the reference policy.
    """
    rng = np.random.default_rng(seed)
    width = surface.high - surface.low
    members = np.atleast_2d(weights)
    reference = np.zeros((1, len(width)))
    candidates = np.concatenate([reference, rng.uniform(surface.low, surface.high, (DRAWS, len(width)))])
    beyond = np.zeros(len(monomials(reference[0]))) if further is None else further
    signals, success = surface.predict(candidates, success_caution)
    unit = max(float((signals @ members.mean(axis=0) + monomials(candidates) @ beyond).std()), 1e-9)

    def value() -> FloatArray:
        returns = (signals @ members.T + (monomials(candidates) @ beyond)[:, None]) / unit
        worth: FloatArray = returns.mean(axis=-1) - caution * returns.std(axis=-1)
        kept = worth - price_of_failures(success, penalty)
        return kept if forces is None else np.where(forces.growth_n_of(candidates) <= most_growth_n, kept, -np.inf)

    for spread in (0.2, 0.05):
        best = candidates[np.argsort(value())[-40:]]
        around = np.repeat(best, 100, axis=0) + spread * width * rng.standard_normal((4000, len(width)))
        candidates = np.concatenate([reference, best, np.clip(around, surface.low, surface.high)])
        signals, success = surface.predict(candidates, success_caution)
    winner: FloatArray = candidates[np.argmax(value())]
    return winner
