"""DSRL (Wagenmaker et al., arXiv 2506.15799): SAC over the noise that a frozen policy turns into actions.

The policy here is a Gaussian before a tanh, a = limit tanh(mu(s) + sigma(s) w), and w in [-b, b]^7 is what is learned
(their DSRL-SAC; b is their action_magnitude, 1.5). It can only do what the frozen policy might have done, so it can
hardly slow the robot down. behaviour_flow has a decoder in whose noise all behaviours of the pool lie.
"""

from dataclasses import dataclass

import numpy as np

from worker.domain.spaces import Space
from worker.domain.type_aliases import Float32Array
from worker.ml.methods.steered_rl import Decoder, SteeredAct, Steering, steer
from worker.ml.policies.gaussian import GaussianPolicy
from worker.ml.reinforcement.preference_rl import EpisodeReward, MakeEnv

_INSIDE = 1.0 - 1e-6


@dataclass(frozen=True)
class OwnNoise:
    """The action that the frozen policy would draw if its standard normal noise were ``largest`` times the input."""

    policy: GaussianPolicy
    largest: float

    def __call__(self, observations: Float32Array, inputs: Float32Array) -> Float32Array:
        """See Decoder."""
        mean, deviation = self.policy.mean_and_std(observations)
        limit = np.float32(self.policy.action_limit)
        before = np.arctanh(np.clip(mean / limit, -_INSIDE, _INSIDE))
        return np.asarray(limit * np.tanh(before + np.float32(self.largest) * deviation * inputs), np.float32)


def fit(
    make_env: MakeEnv,
    decoder: Decoder,
    like: GaussianPolicy,
    reward: EpisodeReward,
    space: Space,
    config: Steering,
    seed: int,
) -> SteeredAct:
    """The warm-up draws the noise as the frozen policy does, cut at the largest."""

    def drawn(shape: tuple[int, int], rng: np.random.Generator) -> Float32Array:
        noise = rng.standard_normal(shape) / config.largest_noise
        return np.clip(noise, -1.0, 1.0).astype(np.float32)

    def as_said(said: Float32Array, steps: int, rng: np.random.Generator) -> Float32Array:
        return said

    return steer(make_env, decoder, drawn, as_said, reward, like, space, config, seed)
