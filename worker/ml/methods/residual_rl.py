"""Residual RL on the frozen policy, as Policy Decorator has it (Yuan et al., arXiv 2412.13630).

action = clip(policy(s) + alpha tanh(u(s))), where SAC learns u. Two things are theirs: the correction is bounded by
alpha, and exploration is progressive: after t of H steps a step is corrected with probability t / H, otherwise it is
the frozen policy's own. It is the honest opponent of mode + residual: the same shape of answer, found by long training.
"""

from dataclasses import dataclass

import numpy as np

from worker.domain.spaces import Space
from worker.domain.type_aliases import Float32Array
from worker.ml.methods.steered_rl import SteeredAct, Steering, steer
from worker.ml.policies.gaussian import GaussianPolicy
from worker.ml.reinforcement.preference_rl import EpisodeReward, MakeEnv


@dataclass(frozen=True)
class Corrected:
    """The frozen policy's deterministic action plus at most ``bound`` in every joint."""

    policy: GaussianPolicy
    bound: float

    def __call__(self, observations: Float32Array, inputs: Float32Array) -> Float32Array:
        """See Decoder."""
        action = self.policy.mean(observations) + np.float32(self.bound) * inputs
        return np.asarray(np.clip(action, -1.0, 1.0), np.float32)


def fit(
    make_env: MakeEnv, policy: GaussianPolicy, reward: EpisodeReward, space: Space, config: Steering, seed: int
) -> SteeredAct:
    """The warm-up is the frozen policy's own, so that the critics first learn what it is worth."""

    def progressive(said: Float32Array, steps: int, rng: np.random.Generator) -> Float32Array:
        corrected = rng.random((len(said), 1)) < steps / config.progressive_steps
        return np.asarray(said * corrected, np.float32)

    def uncorrected(shape: tuple[int, int], rng: np.random.Generator) -> Float32Array:
        return np.zeros(shape, np.float32)

    decoder = Corrected(policy, config.residual_bound)
    return steer(make_env, decoder, uncorrected, progressive, reward, policy, space, config, seed)
