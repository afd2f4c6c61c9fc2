"""PbRL-HRI (Liu et al. 2022) as the paper uses it: from scratch, on a sketchy task reward plus the learned one.

The sketchy reward is the paper's: minus the distance of the tool from its target. How the two are weighed is not said;
here both have standard deviation 1 per step over the reference policy's rollouts, and add up. The original asks for its
labels while it learns; here they are the same ones as for every other method, given beforehand.
"""

from dataclasses import dataclass

import numpy as np
import torch

from worker.domain.spaces import Space
from worker.ml.policies.gaussian import GaussianPolicy
from worker.ml.policies.sac import Learner, SacConfig
from worker.ml.reinforcement.preference_rl import EpisodeReward, MakeEnv, PreferenceRl


@dataclass(frozen=True)
class FromScratch:
    """As many steps as the reference policy's own training had."""

    steps: int = 260_000
    random_steps: int = 4_000
    hidden: int = 128
    environments: int = 4


def train(
    make_env: MakeEnv, like: GaussianPolicy, reward: EpisodeReward, space: Space, config: FromScratch, seed: int
) -> GaussianPolicy:
    """A new policy. Of the frozen one (``like``) only the standardisation of its inputs is used."""
    settings = SacConfig(
        space,
        seed=seed,
        total_steps=config.steps,
        random_steps=min(config.random_steps, config.steps),
        hidden=config.hidden,
        environments=config.environments,
        critic_first_updates=0,
    )
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        training = PreferenceRl(make_env, reward, settings)
        shape = (len(training.envs), training.actions)
        training.warm_up(lambda _: training.rng.uniform(-1, 1, shape).astype(np.float32))
        learner = Learner(settings, torch.from_numpy(like.offset), torch.from_numpy(like.scale), training.actions)
        training.learn(learner)
        training.close()
    return learner.average.policy()
