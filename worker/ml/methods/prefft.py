"""PrefFT: the frozen policy itself is trained on by SAC on the learned reward, with or without a tie to where it began.

The paper's baseline is the version without: 1e5 environment steps. Tied, its actor minimises

    alpha log pi(a | s) - Q(s, a) + weight * sd_Q * KL(pi(. | s) || pi_reference(. | s))

with sd_Q the mean spread of Q over the reference policy's own actions in one state: the same trade between value and
squared distance in standard deviations as in the studio's residual, and the strongest baseline we know.
"""

import copy
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from worker.domain.spaces import Space
from worker.ml.methods.preference_rl import EpisodeReward, MakeEnv, PreferenceRl, Watch
from worker.ml.policies.checkpoint import Checkpoint
from worker.ml.policies.gaussian import LAYERS, LOG_STD_HIGH, LOG_STD_LOW, GaussianPolicy
from worker.ml.policies.sac import Actor, Learner, SacConfig
from worker.ml.policies.torch_module import FrozenPolicy

UNIT_EVERY_UPDATES = 400
"""How often the unit of Q is measured anew."""


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


class TiedLearner(Learner):
    """A learner whose actor is held back towards where it was when hold() was called."""

    def __init__(self, config: SacConfig, offset: Tensor, scale: Tensor, actions: int, weight: float) -> None:
        super().__init__(config, offset, scale, actions)
        self.weight = weight
        self.anchor = self.actor
        self._unit = 1.0

    def hold(self) -> None:
        """From here on, stay close to the present actor."""
        self.anchor = copy.deepcopy(self.actor).requires_grad_(False)

    def state(self) -> dict[str, Tensor]:
        """See Learner; with where it is held."""
        anchor = {f"anchor.{name}": value.clone() for name, value in self.anchor.state_dict().items()}
        return {**super().state(), **anchor, "unit": torch.tensor(self._unit)}

    def load_state(self, tensors: dict[str, Tensor], updates: int) -> None:
        """See Learner."""
        super().load_state(tensors, updates)
        self.hold()
        names = [name for name in tensors if name.startswith("anchor.")]
        self.anchor.load_state_dict({name.removeprefix("anchor."): tensors[name] for name in names})
        self._unit = float(tensors["unit"])

    def tie(self, states: Tensor) -> Tensor | float:
        """See Learner."""
        if self.weight == 0.0:
            return 0.0
        if self.updates % UNIT_EVERY_UPDATES == 2:
            self._unit = self._spread_of_values(states)
        return self.weight * self._unit * gaussian_divergence(*self.actor(states), *self.anchor(states)).mean()

    @torch.no_grad()
    def _spread_of_values(self, states: Tensor) -> float:
        repeated = states.expand(10, *states.shape).reshape(-1, states.shape[-1])
        values = self.critics(repeated, self.anchor.sample(repeated)[0]).amin(0)
        return max(float(values.reshape(10, -1).std(dim=0).mean()), 1e-6)


def gaussian_divergence(mean: Tensor, log_std: Tensor, other_mean: Tensor, other_log_std: Tensor) -> Tensor:
    """KL(N(mean, std^2) || N(other)) summed over joints, (B, 7) each -> (B,). A tanh after both does not change it."""
    ratio = 2 * (log_std - other_log_std)
    distance = ((mean - other_mean) / other_log_std.exp()) ** 2
    divergence: Tensor = 0.5 * (ratio.exp() + distance - 1.0 - ratio).sum(-1)
    return divergence


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
