"""Best of n at test time: draw n actions from the frozen policy in every step and take the most valuable one.

"Valuable" is fitted Q evaluation of the frozen policy on the learned reward: the reward of one step alone ranks actions
almost at random (docs/method.md). The policy's own deterministic action is always among the candidates.
"""

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from worker.domain.trajectory import Trajectory
from worker.domain.type_aliases import Float32Array
from worker.ml.filters.encoders.fitted_q import ActionValue, Transitions, evaluate_filter
from worker.ml.filters.exported.filter_module import state_of
from worker.ml.policies.gaussian import GaussianPolicy
from worker.ml.policies.torch_module import FrozenPolicy
from worker.ml.rewards.reward_models import RewardModel

CLIP = 6.0


@dataclass(frozen=True)
class BestOfN:
    """observation (D,) -> action (7,). The same observation always gets the same action."""

    policy: GaussianPolicy
    value: Mapping[str, Float32Array]
    """state of an ActionValue"""
    count: int
    seed: int

    def __call__(self, observation: Float32Array) -> Float32Array:
        """See the class."""
        rng = np.random.default_rng([self.seed, zlib.crc32(observation.tobytes())])
        drawn = self.policy.sample(np.repeat(observation[None], self.count, axis=0), rng)
        candidates = np.concatenate([self.policy.mean(observation)[None], drawn])
        best: Float32Array = candidates[int(np.argmax(self.values(observation, candidates)))]
        return best

    def values(self, observation: Float32Array, candidates: Float32Array) -> Float32Array:
        """Q of each candidate, (D,), (N, 7) -> (N,); ActionValue's forward pass in NumPy."""
        seen = np.clip((observation - self.value["offset"]) * self.value["scale"], -CLIP, CLIP)
        hidden = np.concatenate([np.broadcast_to(seen, (len(candidates), len(seen))), candidates], axis=1)
        for layer in (0, 2, 4):
            hidden = hidden @ self.value[f"body.{layer}.weight"].T + self.value[f"body.{layer}.bias"]
            if layer < 4:
                hidden = hidden / (1.0 + np.exp(-np.clip(hidden, -60.0, 60.0)))
        values: Float32Array = hidden[:, 0]
        return values


def fit_best_of_n(
    policy: GaussianPolicy, reward: RewardModel, rollouts: Sequence[Trajectory], count: int, steps: int, seed: int
) -> BestOfN:
    """``rollouts``: of the frozen policy with noise on its actions; ``steps`` of value learning."""
    generator = torch.Generator().manual_seed(seed)
    data = Transitions.joined(
        [Transitions.of(each.observations, each.actions, reward.rewards_of(each)) for each in rollouts]
    )
    frozen = FrozenPolicy(policy.weights)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        value, target = (ActionValue(frozen.offset, frozen.scale) for _ in range(2))
    target.load_state_dict(value.state_dict())

    def deterministic(observations: Tensor) -> Tensor:
        """What the frozen policy does."""
        action: Tensor = frozen(observations)[0]
        return action

    evaluate_filter(value, target, data, len(data), deterministic, steps, generator)
    return BestOfN(policy, state_of(value), count, seed)
