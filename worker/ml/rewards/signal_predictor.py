"""What a step will measure, foreseen from the robot's state and the action alone.

The structured reward model is linear in measured signals. A real robot has no sensors for some of them (UNSENSED), and
of an action that nobody has executed nothing was measured at all. A network fills both gaps: trained once per task on
simulated rollouts, without any labels (worker.experiments.train_signal_predictor), it gives
the expected signals of a step.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np
from safetensors.numpy import load, save

from worker.domain.trajectory import SIGNALS
from worker.domain.type_aliases import Float32Array, FloatArray
from worker.ml import dense_network

UNSENSED = (
    "force_at_target_n",
    "force_away_n",
    "high_force_n",
    "spilled_on_person",
    "spilled",
    "intake_speed_m_s",
    "undelivered",
    "force_squared_n2",
    "strokes",
)
"""Needs sensors on the person, or somebody who counts drops. All other signals follow from the robot's own motion and
from where the person is, which its policy has to know anyway."""
_UNSENSED_COLUMNS = [SIGNALS.index(name) for name in UNSENSED]
_STANDARDS = ("offset", "scale", "mean", "spread", "most")
INPUT_CLIP = 6.0
"""Standard deviations at which inputs are cut: far from what it has seen a network says anything."""


@dataclass(frozen=True)
class SignalPredictor:
    """A network on (observation, action); inputs and outputs are standardised over its training's rollouts."""

    layers: dense_network.Layers
    offset: Float32Array
    scale: Float32Array
    """(D + 7,)"""
    mean: Float32Array
    spread: Float32Array
    most: Float32Array
    """(S,); nothing larger than ``most`` is ever foreseen"""

    def predict(self, observations: Float32Array, actions: Float32Array) -> FloatArray:
        """Expected signals of each step. (..., D), (..., 7) -> (..., S)

        The change from the previous action is not known and is therefore what it usually is in this state.
        """
        inputs = np.concatenate([observations, actions], axis=-1)
        standard = np.clip((inputs - self.offset) / self.scale, -INPUT_CLIP, INPUT_CLIP).astype(np.float32)
        flat = dense_network.run(self.layers, standard.reshape(-1, standard.shape[-1]))
        signals: FloatArray = np.minimum(flat.astype(np.float64) * self.spread + self.mean, self.most)
        return signals.reshape(*inputs.shape[:-1], -1)

    def completed(self, signals: Float32Array, observations: Float32Array, actions: Float32Array) -> FloatArray:
        """Measured signals (..., S) with the columns of UNSENSED replaced by what is foreseen."""
        known = np.array(signals, np.float64)
        known[..., _UNSENSED_COLUMNS] = self.predict(observations, actions)[..., _UNSENSED_COLUMNS]
        return known

    def tensors(self) -> dict[str, Float32Array]:
        """Everything learned, by name."""
        whole = {name: getattr(self, name) for name in _STANDARDS}
        return {
            name: np.ascontiguousarray(array, np.float32)
            for name, array in (whole | dense_network.named(self.layers)).items()
        }

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, Float32Array]) -> Self:
        """What tensors() gave."""
        return cls(dense_network.of_named(tensors), *(tensors[name] for name in _STANDARDS))

    def save(self, path: Path) -> None:
        """Write a safetensors file."""
        path.write_bytes(save(self.tensors()))

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read what save() wrote."""
        return cls.from_tensors(load(path.read_bytes()))
