"""PrefFT: the frozen policy itself is trained on by SAC on the learned reward, with or without a tie to where it began.

The paper's baseline is the version without: 1e5 environment steps. Tied (reinforcement/tied_learner.py) it makes the
same trade between value and squared distance in standard deviations as the studio's residual, and is the strongest
baseline we know.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from worker.domain.spaces import Space
from worker.ml.policies.checkpoint import Checkpoint
from worker.ml.policies.gaussian import LAYERS, LOG_STD_HIGH, LOG_STD_LOW, GaussianPolicy
from worker.ml.policies.sac import Actor, SacConfig
from worker.ml.policies.torch_module import FrozenPolicy
from worker.ml.reinforcement.preference_rl import EpisodeReward, MakeEnv, PreferenceRl, Watch
from worker.ml.reinforcement.tied_learner import TiedLearner


@dataclass(frozen=True)
class FineTuning:
    """The paper gives the algorithm and the number of steps; a comment where the rest is our choice."""

    steps: int = 100_000
    warm_up_steps: int = 4_000
    """of these, made by the frozen policy while nothing learns: SAC's critics begin with random weights, and an actor
    that followed them would forget the task before they know anything"""
    critic_first_updates: int = 2_000
    """of the critics alone, on the warm-up's episodes"""
    learning_rate: float = 3e-4
    cloning_steps: int = 1_500
    environments: int = 4
    tie_weight: float = 0.0
    """of the KL divergence from the frozen policy, in units of the spread of Q; 0 is the paper's PrefFT"""


TIED = 1.0
"""The tie_weight of prefft_anchored: as strong as in the studio's residual (1 / (7 / 2 * 0.3))."""


def fine_tune(
    make_env: MakeEnv,
    policy: GaussianPolicy,
    reward: EpisodeReward,
    space: Space,
    config: FineTuning,
    seed: int,
    checkpoint: Checkpoint | None = None,
    watch: Watch | None = None,
) -> GaussianPolicy:
    """The policy after ``config.steps`` environment steps: the running average of the actor, as everywhere in sac.

    With a checkpoint, a training that was killed goes on where it was, with the same result.
    """
    settings = _settings(policy, space, config, seed)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        training = PreferenceRl(make_env, reward, settings)
        kept = checkpoint.read() if checkpoint else None
        if kept is None:
            states = training.warm_up(lambda seen: policy.sample(seen, training.rng))
            learner = _learner(policy, settings, config, torch.from_numpy(states))
        else:
            learner = _new_learner(policy, replace(settings, target_entropy=kept[1]["target_entropy"]), config)
            training.restore(learner, *kept)
        training.learn(learner, checkpoint, watch)
        training.close()
    return learner.average.policy()


def in_full_range(policy: GaussianPolicy, states: Tensor, steps: int) -> Actor:
    """The same policy as an actor whose actions reach 1, fitted in these states; exact when policy.action_limit is 1.

    Shipped policies run at a share of the arm's speed, so that filters can be quicker; fine-tuning may use it all, too.
    The fit is of Gaussians before the tanh: mean atanh(limit tanh(mu)), and a deviation that spreads actions as much.
    """
    actor = _copied(policy)
    if policy.action_limit == 1.0:
        return actor
    with torch.no_grad():
        wanted, log_std = FrozenPolicy(policy.weights)(states)
        mean = wanted.clamp(-0.999, 0.999).atanh()
        narrower = (policy.action_limit * (1 - (wanted / policy.action_limit) ** 2) / (1 - wanted**2)).clamp_min(1e-4)
        spread = (log_std + narrower.log()).clamp(LOG_STD_LOW, LOG_STD_HIGH)
    _fit(actor, states, lambda rows: (mean[rows], spread[rows]), steps)
    return actor


def _fit(actor: Actor, states: Tensor, wanted: Callable[[Tensor], tuple[Tensor, Tensor]], steps: int) -> None:
    optimiser = torch.optim.Adam(actor.parameters(), 1e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, max(steps, 1), 1e-5)
    for _ in range(steps):
        rows = torch.randint(len(states), (256,))
        mean, log_std = actor(states[rows])
        target_mean, target_log_std = wanted(rows)
        off = (mean.tanh() - target_mean.tanh()) / target_log_std.exp().clamp_max(0.3)
        loss = (off**2).mean() + 0.1 * ((log_std - target_log_std) ** 2).mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()


def _copied(policy: GaussianPolicy) -> Actor:
    """The inverse of Actor.policy(), without the limit."""
    hidden = len(policy.weights["bias_0"])
    actor = Actor(torch.from_numpy(policy.offset), torch.from_numpy(policy.scale), policy.action_size, hidden)
    state: dict[str, Any] = {"offset": actor.offset, "scale": actor.scale}
    for index in range(LAYERS):
        state[f"layers.{index}.weight"] = torch.from_numpy(policy.weights[f"weight_{index}"].T.copy())
        state[f"layers.{index}.bias"] = torch.from_numpy(policy.weights[f"bias_{index}"])
    actor.load_state_dict(state)
    return actor


def _learner(policy: GaussianPolicy, settings: SacConfig, config: FineTuning, states: Tensor) -> TiedLearner:
    """Begins as the frozen policy."""
    actor = in_full_range(policy, states, config.cloning_steps)
    with torch.no_grad():
        entropy = -float(actor.sample(states)[1].mean())
    kept = replace(settings, target_entropy=entropy)  # as undecided as it was: neither pulled apart nor made rigid
    learner = _new_learner(policy, kept, config)
    learner.actor.load_state_dict(actor.state_dict())
    learner.average.load_state_dict(actor.state_dict())
    learner.hold()
    return learner


def _new_learner(policy: GaussianPolicy, settings: SacConfig, config: FineTuning) -> TiedLearner:
    """With random weights."""
    offset, scale = torch.from_numpy(policy.offset), torch.from_numpy(policy.scale)
    return TiedLearner(settings, offset, scale, policy.action_size, config.tie_weight)


def _settings(policy: GaussianPolicy, space: Space, config: FineTuning, seed: int) -> SacConfig:
    return SacConfig(
        space,
        seed=seed,
        total_steps=config.steps,
        random_steps=min(config.warm_up_steps, config.steps),
        environments=config.environments,
        hidden=len(policy.weights["bias_0"]),
        learning_rate=config.learning_rate,
        critic_first_updates=config.critic_first_updates,
    )
