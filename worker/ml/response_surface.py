"""What each execution mode changes, for everybody: a small regression fitted once from rollouts of random modes.

It predicts how the summed signals of an episode and its chance of success differ from the reference policy's in the
same scenario. Given a person's weights on the signals, their best mode is then found without any further rollout.
"""

import json
from dataclasses import dataclass, replace
from itertools import combinations_with_replacement
from pathlib import Path
from typing import Self

import numpy as np
import numpy.typing as npt
from safetensors.numpy import load, save

from worker.ml.reward_models import stored_config
from worker.modes import ModeFamily
from worker.trajectory import SIGNALS

Floats = npt.NDArray[np.float64]

RIDGE = 1.0
OUTLIER_SHARE = 0.005
"""Share at either end of every column that is cut to the quantile: a few crashes must not bend the surface."""

SUCCESS_TOLERANCE = 0.015
SUCCESS_PENALTY = 20.0
"""Standard deviations of predicted return per unit of success lost beyond the tolerance."""
DRAWS = 20_000
CAUTION = 1.0
"""Standard deviations over the reward model's members that are subtracted from a mode's predicted return."""


@dataclass(frozen=True)
class ResponseSurface:
    """psi(mode) @ coefficients = change of the summed signals (S columns) and of success (last column)."""

    coefficients: Floats
    """(M, S + 1)"""
    low: Floats
    """(A,) range of the modes it was fitted on"""
    high: Floats
    axes: tuple[str, ...]
    gram: Floats
    """(M, M) of the rollouts it was fitted to, ridge included: how sure it is in which direction"""

    def predict(self, modes: npt.ArrayLike) -> tuple[Floats, Floats]:
        """(..., A) -> changes of the summed signals (..., S) and of the success probability (...)."""
        changes = monomials(np.asarray(modes, np.float64)) @ self.coefficients
        return changes[..., :-1], changes[..., -1]

    def with_observed(self, mode: Floats, signal_deltas: Floats, success_deltas: Floats) -> Self:
        """The surface after N more paired rollouts of one mode (A,), by recursive least squares.

        signal_deltas (N, S) and success_deltas (N,) as in fit(). Nearby modes are predicted anew, too; others hardly.
        """
        outcomes = np.concatenate([signal_deltas, np.asarray(success_deltas, np.float64)[:, None]], axis=1)
        features = monomials(mode)
        gram = self.gram + len(outcomes) * np.outer(features, features)
        moments = self.gram @ self.coefficients + np.outer(features, outcomes.sum(axis=0))
        coefficients = np.asarray(np.linalg.solve(gram, moments), np.float64)
        return replace(self, coefficients=coefficients, gram=gram)

    def to_bytes(self) -> bytes:
        """One safetensors file."""
        config = {"axes": list(self.axes), "kind": "response surface", "signals": list(SIGNALS)}
        tensors = {"coefficients": self.coefficients, "low": self.low, "high": self.high, "gram": self.gram}
        return save(
            {name: np.ascontiguousarray(array, np.float32) for name, array in tensors.items()},
            metadata={"config": json.dumps(config, sort_keys=True)},
        )

    @classmethod
    def from_bytes(cls, stored: bytes, family: ModeFamily) -> Self:
        """Read what to_bytes() wrote. Raises ValueError when it was fitted for other signals or axes than today's."""
        config = stored_config(stored)
        if config.get("signals") != list(SIGNALS) or config.get("axes") != list(family.names):
            raise ValueError(
                "This response surface was fitted for other signals or axes; run `python -m worker explore --task ...`."
            )
        tensors = {name: array.astype(np.float64) for name, array in load(stored).items()}
        return cls(tensors["coefficients"], tensors["low"], tensors["high"], family.names, tensors["gram"])

    def save(self, path: Path) -> None:
        """Write to_bytes() to a file."""
        path.write_bytes(self.to_bytes())

    @classmethod
    def load(cls, path: Path, family: ModeFamily) -> Self:
        """Read a file written by save()."""
        return cls.from_bytes(path.read_bytes(), family)


def monomials(modes: Floats) -> Floats:
    """(..., A) -> (..., M): first order, second order with cross terms, pure third order. No constant: 0 maps to 0."""
    columns = [modes[..., axis] for axis in range(modes.shape[-1])]
    products = [first * second for first, second in combinations_with_replacement(columns, 2)]
    return np.stack([*columns, *products, *(column**3 for column in columns)], axis=-1)


def fit(family: ModeFamily, modes: Floats, signal_deltas: Floats, success_deltas: Floats) -> ResponseSurface:
    """Ridge regression of N paired rollouts.

    modes (N, A); signal_deltas (N, S): summed signals of the rollout with this mode minus those of the reference
    rollout of the same scenario; success_deltas (N,): 1, 0 or -1.
    """
    outcomes = np.concatenate([signal_deltas, np.asarray(success_deltas, np.float64)[:, None]], axis=1)
    low, high = np.quantile(outcomes[:, :-1], [OUTLIER_SHARE, 1 - OUTLIER_SHARE], axis=0)
    outcomes[:, :-1] = np.clip(outcomes[:, :-1], low, high)
    features = monomials(np.asarray(modes, np.float64))
    gram = features.T @ features + RIDGE * np.eye(features.shape[1])
    return ResponseSurface(
        np.linalg.solve(gram, features.T @ outcomes),
        np.array([axis.low for axis in family.axes]),
        np.array([axis.high for axis in family.axes]),
        family.names,
        gram,
    )


def best_mode(
    surface: ResponseSurface,
    weights: Floats,
    seed: int,
    *,
    tolerance: float = SUCCESS_TOLERANCE,
    penalty: float = SUCCESS_PENALTY,
) -> Floats:
    """(A,) the mode with the best predicted return for these weights on the signals, (S,) or (E, S) for E members.

    With members the return counts as their mean less their standard deviation: what few labels leave open is then not
    gambled on (docs/method.md has what this gains). Random search with two local refinements; the mode 0 is always
    among the candidates and wins ties, so that somebody for whom nothing is better keeps the reference policy.
    """
    rng = np.random.default_rng(seed)
    width = surface.high - surface.low
    members = np.atleast_2d(weights)
    reference = np.zeros((1, len(width)))
    candidates = np.concatenate([reference, rng.uniform(surface.low, surface.high, (DRAWS, len(width)))])
    unit = max(float((surface.predict(candidates)[0] @ members.mean(axis=0)).std()), 1e-9)

    def value(modes: Floats) -> Floats:
        signals, success = surface.predict(modes)
        returns = signals @ members.T / unit
        worth: Floats = returns.mean(axis=-1) - CAUTION * returns.std(axis=-1)
        return worth - penalty * np.maximum(-success - tolerance, 0.0)

    for spread in (0.2, 0.05):
        best = candidates[np.argsort(value(candidates))[-40:]]
        around = np.repeat(best, 100, axis=0) + spread * width * rng.standard_normal((4000, len(width)))
        candidates = np.concatenate([reference, best, np.clip(around, surface.low, surface.high)])
    winner: Floats = candidates[np.argmax(value(candidates))]
    return winner
