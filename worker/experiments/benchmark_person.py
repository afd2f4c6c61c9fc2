"""A scripted user who can be asked for more than labels: duels of episodes, how an episode seems, others' labels.

A whole episode says more than a clip, so duels and sliders get more out of an answer than all other methods do.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from worker.domain.responses import TARGETS
from worker.domain.trajectory import Trajectory
from worker.domain.type_aliases import FloatArray
from worker.ml.methods.people import Labels
from worker.ml.rewards.reward_models import RewardModel
from worker.ml.rewards.segments import SegmentPairs
from worker.ml.rewards.signal_scale import SignalScale
from worker.ml.teachers import Manner, ScriptedTeacher, Taste, random_taste

TrueRewards = Callable[[Taste, Trajectory], FloatArray]
"""r^H of every step, (T,)"""
OTHERS = 29
"""Seed of the other people, whom no table and no promise has."""


@dataclass(frozen=True)
class BenchmarkPerson:
    """See worker.ml.methods.people.Person."""

    taste: Taste
    labels: Labels
    scale: SignalScale
    manner: Manner
    pool: Sequence[Trajectory]
    rows: npt.NDArray[np.int64]
    """(M, 2) all pairs of the pool"""
    clip_steps: int
    true_rewards: TrueRewards
    learn: Callable[[Labels], RewardModel]

    def prefers(self, left: Trajectory, right: Trajectory, rng: np.random.Generator) -> float:
        """See Person."""
        first, second = (self.true_rewards(self.taste, each) for each in (left, right))
        target = TARGETS[self._of_episodes.answer(first, second, rng)]
        return 0.5 if target is None else target

    def perceived(self, driven: Trajectory, noise: float, rng: np.random.Generator) -> float:
        """See Person."""
        true = float(self.true_rewards(self.taste, driven).sum())
        return true / self._of_episodes.spread + noise * float(rng.standard_normal())

    def others(self, people: int, labels: int) -> Sequence[Labels]:
        """See Person; asked at random."""
        found = []
        for number in range(people):
            rng = np.random.default_rng([number, OTHERS])
            taste = random_taste(f"other-{number}", rng)
            rewards = np.array([self.true_rewards(taste, each)[: self.clip_steps] for each in self.pool])
            teacher = ScriptedTeacher.calibrated(self.manner, rewards[self.rows])
            asked = self.rows[rng.choice(len(self.rows), labels, replace=False)]
            answers = [TARGETS[teacher.answer(rewards[left], rewards[right], rng)] for left, right in asked]
            pairs = [(self.pool[left], self.pool[right]) for left, right in asked]
            found.append(Labels(SegmentPairs.cut(pairs, 0, self.clip_steps), np.array(answers)))
        return found

    def fit(self, labels: Labels) -> RewardModel:
        """See Person."""
        return self.learn(labels)

    @cached_property
    def _of_episodes(self) -> ScriptedTeacher:
        rewards = np.array([self.true_rewards(self.taste, each) for each in self.pool])
        return ScriptedTeacher.calibrated(self.manner, rewards[self.rows])
