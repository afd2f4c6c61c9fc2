"""What a rival may ask of the person whom it serves, and of others, beyond the reward model that all methods share."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from worker.domain.trajectory import Trajectory
from worker.domain.type_aliases import FloatArray
from worker.ml.rewards.reward_models import RewardModel
from worker.ml.rewards.segments import SegmentPairs
from worker.ml.rewards.signal_scale import SignalScale


@dataclass(frozen=True)
class Labels:
    """N answered pairs. Raises ValueError when there are not as many answers as pairs."""

    pairs: SegmentPairs
    targets: FloatArray
    """(N,) P(right preferred) in {0, 1/2, 1}"""

    def __post_init__(self) -> None:
        if self.targets.shape != (len(self.pairs),):
            raise ValueError(f"{len(self.pairs)} pairs need as many answers, got shape {self.targets.shape}.")

    def first(self, count: int) -> "Labels":
        """So many of them, in the order in which they were given."""
        return Labels(self.pairs.take(np.arange(count)), self.targets[:count])


class Person(Protocol):
    """Somebody who can be asked and shown more; only scripted users can (worker.experiments.benchmark_person)."""

    @property
    def labels(self) -> Labels:
        """Their answers to the pairs that everybody's reward model is learned from."""
        ...

    @property
    def scale(self) -> SignalScale:
        """Of the signals in the pool."""
        ...

    def prefers(self, left: Trajectory, right: Trajectory, rng: np.random.Generator) -> float:
        """Two whole episodes compared: P(right preferred) in {0, 1/2, 1}, with the person's usual mistakes."""
        ...

    def perceived(self, driven: Trajectory, noise: float, rng: np.random.Generator) -> float:
        """How good an episode seems: its true return in units of the spread of pairs of the pool, plus Gaussian noise
        of this deviation."""
        ...

    def others(self, people: int, labels: int) -> Sequence[Labels]:
        """Answers of so many other people, always the same ones, to pairs of the same pool."""
        ...

    def fit(self, labels: Labels) -> RewardModel:
        """The reward model that is learned from somebody's answers, as everybody's is."""
        ...
