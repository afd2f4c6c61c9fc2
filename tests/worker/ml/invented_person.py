"""Somebody who dislikes the first joint's action and is asked about invented episodes."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from tests.worker import invented
from worker.domain.trajectory import SIGNALS, Trajectory
from worker.domain.type_aliases import FloatArray
from worker.ml.methods.people import Labels
from worker.ml.rewards import reward_training
from worker.ml.rewards.reward_models import RewardModel
from worker.ml.rewards.signal_scale import SignalScale

SPEED = SIGNALS.index("speed_m_s")


def answers(count: int, wanted: FloatArray, seed: int) -> Labels:
    """Of somebody whose reward is linear in the signals and who never errs."""
    pairs = invented.pairs(count, np.random.default_rng(seed))
    return Labels(pairs, invented.answers_of(pairs, wanted))


def wants(**weights: float) -> FloatArray:
    """(S,) by the names of the signals."""
    return np.array([weights.get(name, 0.0) for name in SIGNALS])


@dataclass(frozen=True)
class InventedPerson:
    """See worker.ml.methods.people.Person."""

    speed: float = -1.0
    kinds: tuple[float, ...] = (-1.0, 1.0)
    """what others think of speed, in turn"""

    @cached_property
    def labels(self) -> Labels:
        """Own answers."""
        return answers(20, wants(speed_m_s=self.speed), 1)

    @cached_property
    def scale(self) -> SignalScale:
        """Of the own pairs."""
        return SignalScale.of(self.labels.pairs)

    def prefers(self, left: Trajectory, right: Trajectory, rng: np.random.Generator) -> float:
        """Never errs."""
        return float(self._return(right) > self._return(left))

    def perceived(self, driven: Trajectory, noise: float, rng: np.random.Generator) -> float:
        """In units of one step's speed."""
        return self._return(driven) + noise * float(rng.standard_normal())

    def others(self, people: int, labels: int) -> Sequence[Labels]:
        """One kind after the other."""
        return [
            answers(labels, wants(speed_m_s=self.kinds[each % len(self.kinds)]), 100 + each) for each in range(people)
        ]

    def fit(self, labels: Labels) -> RewardModel:
        """The structured kind."""
        return reward_training.fit(labels.pairs, labels.targets, "structured", 0, scale=self.scale).model

    def _return(self, driven: Trajectory) -> float:
        return self.speed * float(driven.signals[:, SPEED].sum())
