"""SAC over the input of a frozen decoder: what residual RL and DSRL share.

The learner's action u in [-1, 1]^A is turned into the robot's by a decoder that is never trained. Everything else, the
learned reward, the episodes and the learner, is that of preference_rl and sac. As the published methods do, it is also
paid for the task: minus a cost for every step in which the task is not done.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Protocol

import gymnasium
import numpy as np
import torch

from worker.domain.spaces import Space
from worker.domain.trajectory import SIGNALS
from worker.domain.type_aliases import Float32Array
from worker.ml.policies.gaussian import GaussianPolicy
from worker.ml.policies.sac import Learner, SacConfig
from worker.ml.reinforcement.preference_rl import Env, EpisodeReward, MakeEnv, PreferenceRl
from worker.ml.rewards.reward_models import UNDONE

_UNDONE = SIGNALS.index(UNDONE)
_SMALL = 0.01
"""The actor's last layer begins this small, so that its mean begins near 0."""


class Decoder(Protocol):
    """A frozen map from what the learner says to what the robot does; can be sent to another process."""

    def __call__(self, observations: Float32Array, inputs: Float32Array) -> Float32Array:
        """(..., D), (..., A) in [-1, 1] -> actions (..., A)"""
        ...


@dataclass(frozen=True)
class Steering:
    """How much is learned; the sizes are those that a laboratory found to suffice here, not the papers'."""

    steps: int = 60_000
    warm_up_steps: int = 4_000
    """of these, made without the learner"""
    critic_first_updates: int = 2_000
    hidden: int = 64
    learning_rate: float = 3e-4
    discount: float = 0.99
    environments: int = 4
    undone_cost: float = 1.0
    """per step in which the task is not done, in standard deviations of the learned reward"""
    residual_bound: float = 0.5
    """alpha of Policy Decorator: largest correction, in action units"""
    progressive_steps: int = 20_000
    """H of Policy Decorator: the share of steps with a correction grows to 1 over so many"""
    largest_noise: float = 1.5
    """of DSRL (its authors' action_magnitude), in standard deviations"""
    flow_steps: int = 6_000
    """of flow matching"""
    flow_hidden: int = 128


@dataclass(frozen=True)
class SteeredAct:
    """observation (D,) -> action (A,): the decoder of the trained actor's mean."""

    decoder: Decoder
    actor: GaussianPolicy

    def __call__(self, observation: Float32Array) -> Float32Array:
        """See the class."""
        return self.decoder(observation, self.actor.mean(observation))


Explore = Callable[[Float32Array, int, np.random.Generator], Float32Array]
"""what the actor says (N, A), and environment steps since the warm-up -> what is tried"""


def steer(
    make_env: MakeEnv,
    decoder: Decoder,
    warm_up: Callable[[tuple[int, int], np.random.Generator], Float32Array],
    explore: Explore,
    reward: EpisodeReward,
    like: GaussianPolicy,
    space: Space,
    config: Steering,
    seed: int,
) -> SteeredAct:
    """Train for ``config.steps`` environment steps. Of ``like`` the standardisation of observations is used.

    ``warm_up``: shape (N, A) -> inputs in [-1, 1] before the learner takes over.
    """
    settings = _settings(space, config, seed)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        training = _Steered(lambda: _Decoded(make_env(), decoder), _paid(reward, decoder, config), settings, explore)
        shape = (len(training.envs), training.actions)
        training.warm_up(lambda _: warm_up(shape, training.rng).astype(np.float32))
        offset, scale = torch.from_numpy(like.offset), torch.from_numpy(like.scale)
        learner = Learner(replace(settings, target_entropy=-float(training.actions)), offset, scale, training.actions)
        _begin_near_zero(learner)
        training.learn(learner)
        training.close()
    return SteeredAct(decoder, learner.average.policy())


class _Steered(PreferenceRl):
    """What is tried may differ from what the actor says."""

    def __init__(self, make_env: MakeEnv, reward: EpisodeReward, config: SacConfig, explore: Explore) -> None:
        super().__init__(make_env, reward, config)
        self._explore = explore

    def explored(self, actions: Float32Array) -> Float32Array:
        """See PreferenceRl."""
        return self._explore(actions, self.steps - self.config.random_steps, self.rng)


class _Decoded(gymnasium.Wrapper[Any, Any, Any, Any]):
    """An environment that is told the decoder's input."""

    def __init__(self, env: Env, decoder: Decoder) -> None:
        super().__init__(env)
        self._decoder = decoder
        self._seen: Float32Array = np.zeros(0, np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """See gymnasium.Env."""
        self._seen, info = self.env.reset(seed=seed, options=options)
        return self._seen, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """See gymnasium.Env."""
        self._seen, reward, ended, cut, info = self.env.step(self._decoder(self._seen, action))
        return self._seen, reward, ended, cut, info


def _paid(reward: EpisodeReward, decoder: Decoder, config: Steering) -> EpisodeReward:
    """The learned reward of what was executed, less the cost of steps with the task undone."""

    def paid(signals: Float32Array, observations: Float32Array, inputs: Float32Array) -> Float32Array:
        liked = reward(signals, observations, decoder(observations, inputs))
        return np.asarray(liked - config.undone_cost * (signals[:, _UNDONE] > 0.0), np.float32)

    return paid


def _begin_near_zero(learner: Learner) -> None:
    for actor in (learner.actor, learner.average):
        with torch.no_grad():
            for each in actor.layers[-1].parameters():
                each.mul_(_SMALL)


def _settings(space: Space, config: Steering, seed: int) -> SacConfig:
    return SacConfig(
        space,
        seed=seed,
        total_steps=config.steps,
        random_steps=min(config.warm_up_steps, config.steps),
        environments=config.environments,
        hidden=config.hidden,
        learning_rate=config.learning_rate,
        discount=config.discount,
        critic_first_updates=config.critic_first_updates,
    )
