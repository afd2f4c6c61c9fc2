"""The frozen reference policy: a small Gaussian network, in NumPy for control loops and as a torch module for training.

pi(a | s) is tanh of a Gaussian with state-dependent mean and standard deviation (soft actor-critic's policy), times a
limit below 1: trained at the arm's full speed, it is run more slowly, so that a person may also want it quicker.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Self

import numpy as np
from safetensors.numpy import load_file, save_file

from worker.domain.type_aliases import Float32Array

if TYPE_CHECKING:
    pass


LOG_STD_LOW, LOG_STD_HIGH = -4.0, 1.0
ACTION_STD_FLOOR = 0.05
"""Where the policy is almost deterministic an action still counts as this uncertain."""
LAYERS = 3


class GaussianPolicy:
    """Inference without torch. Every method takes observations (..., D) and works on any leading axes."""

    def __init__(self, weights: dict[str, Float32Array]) -> None:
        """``weights``: offset (D,), scale (D,), and per layer i weight_i (in, out) and bias_i (out,); action_limit (1,)
        when actions are to be smaller than the tanh gives."""
        self.weights = {name: np.ascontiguousarray(array, np.float32) for name, array in weights.items()}
        self._layers = [(self.weights[f"weight_{index}"], self.weights[f"bias_{index}"]) for index in range(LAYERS)]
        self._limit = np.float32(self.action_limit)
        self.action_size = len(self.weights[f"bias_{LAYERS - 1}"]) // 2

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read a policy.safetensors."""
        return cls(load_file(path))

    def save(self, path: Path) -> None:
        """Write a policy.safetensors."""
        save_file(self.weights, path)

    @property
    def offset(self) -> Float32Array:
        """(D,) subtracted from an observation before the first layer."""
        return self.weights["offset"]

    @property
    def scale(self) -> Float32Array:
        """(D,) multiplies what is left."""
        return self.weights["scale"]

    @property
    def action_limit(self) -> float:
        """Largest absolute action, in (0, 1]."""
        return float(self.weights["action_limit"][0]) if "action_limit" in self.weights else 1.0

    def mean(self, observations: Float32Array) -> Float32Array:
        """The deterministic action limit * tanh(mu), (..., 7)."""
        action: Float32Array = self._limit * np.tanh(self._raw(observations)[..., : self.action_size])
        return action

    def mean_and_std(self, observations: Float32Array) -> tuple[Float32Array, Float32Array]:
        """Deterministic action after the tanh and standard deviation before it, (..., 7) each."""
        raw = self._raw(observations)
        return self._limit * np.tanh(raw[..., : self.action_size]), np.exp(self._log_std(raw))

    def action_std(self, observations: Float32Array) -> Float32Array:
        """How far actions spread around the deterministic one, in action units, (..., 7).

        The Gaussian's deviation times the slope of the tanh at its mean, at least ACTION_STD_FLOOR.
        """
        action, deviation = self.mean_and_std(observations)
        slope = self._limit * (1 - (action / self._limit) ** 2)
        spread: Float32Array = np.maximum(deviation * slope, ACTION_STD_FLOOR)
        return spread

    def sample(self, observations: Float32Array, rng: np.random.Generator, temperature: float = 1.0) -> Float32Array:
        """An action drawn from the policy, (..., 7), its deviation multiplied by a temperature."""
        raw = self._raw(observations)
        centre = raw[..., : self.action_size]
        noise = rng.standard_normal(centre.shape, np.float32)
        action: Float32Array = self._limit * np.tanh(
            centre + np.float32(temperature) * np.exp(self._log_std(raw)) * noise
        )
        return action

    def _log_std(self, raw: Float32Array) -> Float32Array:
        share = 0.5 * (np.tanh(raw[..., self.action_size :]) + 1)
        return np.asarray(LOG_STD_LOW + (LOG_STD_HIGH - LOG_STD_LOW) * share, np.float32)

    def _raw(self, observations: Float32Array) -> Float32Array:
        hidden = (np.asarray(observations, np.float32) - self.offset) * self.scale
        for matrix, bias in self._layers[:-1]:
            hidden = np.maximum(hidden @ matrix + bias, 0.0)
        matrix, bias = self._layers[-1]
        return np.asarray(hidden @ matrix + bias, np.float32)
