"""PrefFT that has to keep the task: SAC on the learned reward minus a price for every step with the task undone.

The price is a Lagrange multiplier (Stooke et al. 2020, arXiv 2007.03964, the integral term alone): every some thousand
steps the present policy is driven without exploration noise, and the price rises with what it succeeds less often than
the frozen policy less a tolerance, and falls with what it succeeds more often. Measured under exploration noise it runs
to its cap. All earlier steps are priced anew.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch

from worker.domain.spaces import Space
from worker.domain.trajectory import SIGNALS, Trajectory
from worker.domain.type_aliases import Float32Array
from worker.ml.filters.fitting.filter_problem import Collect
from worker.ml.filters.fitting.gate import successes
from worker.ml.methods import prefft
from worker.ml.methods.prefft import FineTuning
from worker.ml.policies.gaussian import GaussianPolicy
from worker.ml.policies.sac import Learner, Replay
from worker.ml.reinforcement.preference_rl import EpisodeReward, MakeEnv, PolicyAct, PreferenceRl
from worker.ml.rewards.reward_models import UNDONE

_UNDONE = SIGNALS.index(UNDONE)


@dataclass(frozen=True)
class Constraint:
    """What is held, and how hard."""

    tolerance: float = 0.02
    """largest loss of success that is accepted, as a share of episodes"""
    scenarios: int = 40
    """in which success is measured"""
    every_steps: int = 20_000
    first_price: float = 1.0
    """per step with the task undone, in standard deviations of the learned reward"""
    rate: float = 20.0
    """of the price, per share of episodes and measurement"""
    largest_price: float = 10.0


class Price:
    """The learned reward less the price; call it for every episode that goes into the replay, in that order."""

    def __init__(
        self,
        reward: EpisodeReward,
        constraint: Constraint,
        reference: Sequence[Trajectory],
        collect: Collect,
        seed: int,
    ) -> None:
        self.reward, self.constraint, self.collect, self.seed = reward, constraint, collect, seed
        self.scenarios = [each.scenario for each in reference]
        self.target = float(successes(reference).mean()) - constraint.tolerance
        self.price = constraint.first_price
        self.prices = [self.price]
        """one more per measurement"""
        self._undone: list[npt.NDArray[np.bool_]] = []
        self._next = constraint.every_steps

    def __call__(self, signals: Float32Array, observations: Float32Array, actions: Float32Array) -> Float32Array:
        """See EpisodeReward."""
        undone = signals[:, _UNDONE] > 0.0
        self._undone.append(undone)
        return np.asarray(self.reward(signals, observations, actions) - self.price * undone, np.float32)

    def watch(self, training: PreferenceRl, learner: Learner) -> None:
        """Measure the present policy when it is time, and change the price."""
        if training.steps < self._next:
            return
        self._next += self.constraint.every_steps
        driven = self.collect(PolicyAct(learner.average.policy()), self.scenarios, 0.0, self.seed)
        self.measured(float(successes(driven).mean()), training.replay)

    def measured(self, success: float, replay: Replay) -> None:
        """One step of the multiplier; every reward in the replay is what it would have been at the new price."""
        before = self.price
        rise = self.constraint.rate * (self.target - success)
        self.price = float(np.clip(before + rise, 0.0, self.constraint.largest_price))
        self.prices.append(self.price)
        undone = torch.from_numpy(np.concatenate(self._undone).astype(np.float32))
        column = replay.splits[0] + replay.splits[1]
        replay.rows[: replay.count, column] -= (self.price - before) * undone


def fine_tune(
    make_env: MakeEnv,
    policy: GaussianPolicy,
    price: Price,
    space: Space,
    config: FineTuning,
    seed: int,
) -> GaussianPolicy:
    """PrefFT at that price."""
    return prefft.fine_tune(make_env, policy, price, space, config, seed, watch=price.watch)
