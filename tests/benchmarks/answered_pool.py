"""People who answer pairs of a pool, chosen as a study chooses them: seconds of a processor for 200 answers."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tests.benchmarks.nonlinear_people import Person
from worker.domain.responses import TARGETS
from worker.domain.scenarios import POOL, first_of
from worker.domain.trajectory import SIGNALS
from worker.domain.type_aliases import FloatArray
from worker.experiments.rollout_cache import RolloutCache
from worker.ml import acquisition
from worker.ml.rewards.beyond_sums import misfit
from worker.ml.rewards.bradley_terry import probability_right
from worker.ml.rewards.reward_training import posterior
from worker.ml.rewards.segments import SegmentPairs
from worker.ml.rewards.signal_scale import SignalScale
from worker.tasks import registry

POOL_SCENARIOS = 48
"""As in a study."""
COUNTS = (*range(10, 100, 10), *range(100, 201, 20))
"""Answers after which a model chooses the next pairs, and is looked at."""
MEMBERS = 8


@dataclass(frozen=True)
class Answered:
    """What somebody said."""

    rows: acquisition.Indices
    """(N,) of the pool's pairs, in the order in which they were asked"""
    answers: FloatArray
    """(N,) in {0, 1/2, 1}"""


class AnsweredPool:
    """The pool of one task, every pair of which is measured once."""

    def __init__(self, task: str, directory: Path) -> None:
        self.task = registry.task(task)
        self.episodes = RolloutCache(task, directory).pool(first_of(POOL, POOL_SCENARIOS))
        self.clips = self.episodes.rollouts
        self.clip_steps = registry.installed_task(task).description.usual_clip_steps
        self.clip_pairs = acquisition.matched_pairs([each.scenario for each in self.clips])
        """(M, 2)"""
        self.segments = SegmentPairs.cut(
            [(self.clips[left], self.clips[right]) for left, right in self.clip_pairs], 0, self.clip_steps
        )
        means = [each.signals.mean(axis=0, dtype=np.float64) for each in self.clips]
        self.scale = SignalScale.of(self.segments, means)
        self.sums = self.segments.signal_differences() / self.scale.spread
        """(M, S)"""
        self.linear = misfit.linear_features(self.segments.signal_differences(), self.scale, SIGNALS)
        """(M, S + 1)"""
        self.further = misfit.further_differences(self.segments, SIGNALS, misfit.scene_of(self.task.observation))

    def answered(self, person: Person, answers: int, seed: int) -> Answered:
        """So many answers, one of COUNTS, to pairs that the studies' default chooses."""
        rng = np.random.default_rng([seed, 7])
        says = person.answering(self.task, self.clips, self.clip_pairs, self.clip_steps, answers)
        rows, said = np.zeros(0, np.int64), np.zeros(0)
        for count in (each for each in COUNTS if each <= answers):
            free = np.setdiff1d(np.arange(len(self.sums)), rows)
            choice = self._choice(free, rows, said, seed, count - len(rows), rng)
            asked = free[choice.indices]
            given = [TARGETS[each] for each in says(self.clip_pairs[asked], len(rows), rng)]
            rows, said = np.concatenate([rows, asked]), np.concatenate([said, given])
        return Answered(rows, said)

    def ratios(self, answered: Answered, count: int) -> dict[str, float]:
        """What misfit.look() weighs after the first ``count`` answers."""
        rows, sums = answered.rows[:count], self.linear[answered.rows[:count]]
        further = {name: misfit.by_spread(each[rows]) for name, each in self.further.items()}
        return misfit.log_ratios(sums, {**further, misfit.CHANGING: misfit.changing(sums)}, answered.answers[:count])

    def _choice(
        self,
        free: acquisition.Indices,
        rows: acquisition.Indices,
        said: FloatArray,
        seed: int,
        count: int,
        rng: np.random.Generator,
    ) -> acquisition.Choice:
        if not len(rows):
            return acquisition.choose(count, len(free), rng)
        known = posterior(self.sums[rows], said)
        members = np.random.default_rng(seed).multivariate_normal(known.mean, known.covariance, MEMBERS)
        scores = acquisition.entropy(probability_right(members @ self.sums[free].T))
        return acquisition.choose(count, len(free), rng, rule="entropy", scores=scores)
