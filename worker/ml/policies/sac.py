"""Soft actor-critic (Haarnoja et al. 2018, arXiv 1812.05905): actor, critics, replay, and one gradient step.

Twin critics with layer normalisation, entropy temperature tuned to a target, one update per two environment steps. The
reference policies are trained by pretraining, baselines by preference_rl.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import gymnasium
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from worker.domain.spaces import Space
from worker.domain.type_aliases import Float32Array
from worker.ml.policies.demonstrations import Demonstrations, imitation_loss
from worker.ml.policies.gaussian import LOG_STD_HIGH, LOG_STD_LOW, GaussianPolicy

Env = gymnasium.Env[Any, Any]


@dataclass(frozen=True)
class SacConfig:
    """Everything that decides the outcome of a training, apart from the environment."""

    observation: Space = field(repr=False)
    seed: int = 0
    total_steps: int = 260_000
    random_steps: int = 4_000
    """before learning starts; with demonstrations the imitating actor makes them"""
    environments: int = 4
    hidden: int = 128
    batch: int = 128
    learning_rate: float = 5e-4
    final_learning_rate: float = 1e-4
    discount: float = 0.97
    target_rate: float = 0.01
    average_rate: float = 0.002
    target_entropy: float = -7.0
    initial_temperature: float = 0.1
    updates_per_step: float = 0.5
    evaluate_every_steps: int = 20_000
    evaluation_episodes: int = 50
    test_episodes: int = 500
    early_success: tuple[float, ...] = (0.4, 0.7)
    """The first policies to succeed about this often are kept under early/: clumsier behaviours for pools of clips."""
    input_scales: Mapping[str, float] = field(default_factory=dict)
    """INPUT_SCALE for single fields, by name, where small differences matter"""
    save_every_s: float = 180.0
    action_limit: float = 0.7
    """share of the arm's largest step that the exported policy uses; the rest is left for people who want it quicker"""
    training_limit: float = 1.0
    """the same share while training"""
    demonstrations: int = 0
    """episodes of a scripted controller to begin with, if one is given; the actor begins by imitating them"""
    demonstration_share: float = 0.25
    """of every batch"""
    imitation_steps: int = 4_000
    early_imitation_steps: int = 155
    """After so few the imitation is still clumsy, and may be kept as an early policy."""
    imitation_weight: float = 0.5
    """of the imitation loss beside the actor's own, fading to 0 over imitation_updates"""
    imitation_updates: int = 40_000
    critic_first_updates: int = 3_000
    """of the critics alone, after the imitation"""


class Actor(nn.Module):
    """States (B, D) -> mean and log standard deviation of a Gaussian before the tanh, (B, A) each."""

    offset: Tensor
    scale: Tensor

    def __init__(self, offset: Tensor, scale: Tensor, actions: int, hidden: int) -> None:
        super().__init__()
        self.register_buffer("offset", offset)
        self.register_buffer("scale", scale)
        self.layers = nn.ModuleList(
            [nn.Linear(len(offset), hidden), nn.Linear(hidden, hidden), nn.Linear(hidden, 2 * actions)]
        )

    def forward(self, states: Tensor) -> tuple[Tensor, Tensor]:
        """See the class."""
        hidden = (states - self.offset) * self.scale
        for layer in self.layers[:-1]:
            hidden = F.relu(layer(hidden))
        mean, spread = self.layers[-1](hidden).chunk(2, -1)
        return mean, LOG_STD_LOW + 0.5 * (LOG_STD_HIGH - LOG_STD_LOW) * (spread.tanh() + 1)

    def sample(self, states: Tensor) -> tuple[Tensor, Tensor]:
        """Actions (B, A) and their log probability (B,)."""
        mean, log_std = self(states)
        noise = torch.randn_like(mean)
        raw = mean + noise * log_std.exp()
        # log(1 - tanh(raw)^2), written so that it does not underflow.
        squash = 2 * (math.log(2) - raw - F.softplus(-2 * raw))
        log_probability = -0.5 * noise**2 - log_std - 0.5 * math.log(2 * math.pi) - squash
        return raw.tanh(), log_probability.sum(-1)

    def policy(self, action_limit: float = 1.0) -> GaussianPolicy:
        """The same policy for NumPy."""
        weights: dict[str, Float32Array] = {"offset": self.offset.numpy(), "scale": self.scale.numpy()}
        weights["action_limit"] = np.array([action_limit], np.float32)
        for index in range(len(self.layers)):
            weights[f"weight_{index}"] = self.get_parameter(f"layers.{index}.weight").detach().numpy().T.copy()
            weights[f"bias_{index}"] = self.get_parameter(f"layers.{index}.bias").detach().numpy().copy()
        return GaussianPolicy(weights)


class TwinCritics(nn.Module):
    """Two critics evaluated as one batch: states (B, D), actions (B, A) -> (2, B)."""

    offset: Tensor
    scale: Tensor

    def __init__(self, offset: Tensor, scale: Tensor, actions: int, hidden: int) -> None:
        super().__init__()
        self.register_buffer("offset", offset)
        self.register_buffer("scale", scale)
        sizes = [len(offset) + actions, hidden, hidden, 1]
        pairs = list(pairwise(sizes))
        self.weights = nn.ParameterList(
            [nn.Parameter((torch.rand(2, inputs, outputs) * 2 - 1) / math.sqrt(inputs)) for inputs, outputs in pairs]
        )
        self.biases = nn.ParameterList([nn.Parameter(torch.zeros(2, 1, outputs)) for _, outputs in pairs])

    def forward(self, states: Tensor, actions: Tensor) -> Tensor:
        """See the class."""
        scaled = (states - self.offset) * self.scale
        hidden = torch.cat([scaled, actions], -1).expand(2, -1, -1)
        for index, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            hidden = torch.baddbmm(bias, hidden, weight)
            if index < len(self.weights) - 1:
                hidden = F.relu(F.layer_norm(hidden, hidden.shape[-1:]))
        return hidden.squeeze(-1)


class Replay:
    """All transitions so far in one table: state, action, reward, whether the episode went on, next state."""

    def __init__(self, capacity: int, states: int, actions: int) -> None:
        self.splits = [states, actions, 1, 1, states]
        self.rows = torch.zeros(capacity, sum(self.splits))
        self.count = 0

    def add(
        self,
        states: Float32Array,
        actions: Float32Array,
        rewards: Float32Array,
        goes_on: Float32Array,
        next_states: Float32Array,
    ) -> None:
        """Append (N, ...) transitions. The table is made large enough for the whole training."""
        table = np.concatenate([states, actions, rewards[:, None], goes_on[:, None], next_states], 1)
        self.rows[self.count : self.count + len(table)] = torch.from_numpy(table.astype(np.float32))
        self.count += len(table)

    def sample(self, batch: int) -> tuple[Tensor, ...]:
        """Random transitions, split into their five parts."""
        return self.split(self.rows[torch.randint(self.count, (batch,))])

    def split(self, rows: Tensor) -> tuple[Tensor, ...]:
        """Whole transitions (B, ...) as their five parts."""
        return torch.split(rows, self.splits, 1)


class Learner:
    """Actor, critics, temperature and their optimisers; one call of update() is one gradient step."""

    def __init__(self, config: SacConfig, offset: Tensor, scale: Tensor, actions: int) -> None:
        self.config = config
        self.actor = Actor(offset, scale, actions, config.hidden)
        self.average = Actor(offset, scale, actions, config.hidden).requires_grad_(False)
        self.critics = TwinCritics(offset, scale, actions, config.hidden)
        self.targets = TwinCritics(offset, scale, actions, config.hidden).requires_grad_(False)
        self.average.load_state_dict(self.actor.state_dict())
        self.targets.load_state_dict(self.critics.state_dict())
        self.log_temperature = torch.tensor(math.log(config.initial_temperature), requires_grad=True)
        rate = config.learning_rate
        self.optimisers = {
            "actor": torch.optim.Adam(self.actor.parameters(), rate, fused=True),
            "critics": torch.optim.Adam(self.critics.parameters(), rate, fused=True),
            "temperature": torch.optim.Adam([self.log_temperature], rate),
        }
        self.updates = 0

    def set_learning_rate(self, share_done: float) -> None:
        """Constant for the first half, then linearly down to the final rate."""
        config = self.config
        fade = max(0.0, 2 * share_done - 1)
        rate = config.learning_rate + fade * (config.final_learning_rate - config.learning_rate)
        for optimiser in self.optimisers.values():
            optimiser.param_groups[0]["lr"] = rate

    def update(self, replay: Replay, shown: Demonstrations | None = None, actor: bool = True) -> None:
        """One step for the critics, every second time one for actor and temperature, then the slow copies."""
        states, actions, rewards, goes_on, next_states, wanted = self._batch(replay, shown)
        self._update_critics(states, actions, rewards[:, 0], goes_on[:, 0], next_states)
        if actor:
            self.updates += 1
            if self.updates % 2 == 0:
                self._update_actor(states, wanted)
                _move_towards(self.average, self.actor, self.config.average_rate)
        _move_towards(self.targets, self.critics, self.config.target_rate)

    def _batch(self, replay: Replay, shown: Demonstrations | None) -> tuple[Tensor, ...]:
        """Transitions, the demonstrated ones last, and what the demonstrator wanted in those (empty without any)."""
        if shown is None:
            return (*replay.sample(self.config.batch), torch.empty(0))
        count = round(self.config.demonstration_share * self.config.batch)
        demonstrated, wanted = shown.sample(count)
        own = replay.sample(self.config.batch - count)
        both = zip(own, replay.split(demonstrated), strict=True)
        return (*(torch.cat(parts) for parts in both), wanted)

    def _update_critics(
        self, states: Tensor, actions: Tensor, rewards: Tensor, goes_on: Tensor, next_states: Tensor
    ) -> None:
        with torch.no_grad():
            next_actions, log_probability = self.actor.sample(next_states)
            entropy_bonus = -self.log_temperature.exp() * log_probability
            next_values = self.targets(next_states, next_actions).amin(0) + entropy_bonus
            wanted = rewards + self.config.discount * goes_on * next_values
        loss = 2 * F.mse_loss(self.critics(states, actions), wanted.expand(2, -1))
        self._descend("critics", loss)

    def _update_actor(self, states: Tensor, wanted: Tensor) -> None:
        self.critics.requires_grad_(False)
        actions, log_probability = self.actor.sample(states)
        temperature = self.log_temperature.detach().exp()
        loss = (temperature * log_probability - self.critics(states, actions).amin(0)).mean() + self.tie(states)
        weight = self.config.imitation_weight * (1 - self.updates / self.config.imitation_updates)
        if len(wanted) and weight > 0:
            loss = loss + weight * imitation_loss(self.actor(states[-len(wanted) :])[0], wanted)
        self._descend("actor", loss)
        self.critics.requires_grad_(True)
        surplus = log_probability.detach().mean() + self.config.target_entropy
        self._descend("temperature", -self.log_temperature * surplus)

    def tie(self, states: Tensor) -> Tensor | float:
        """What else the actor's loss has, for subclasses that hold the actor back: (B, D) -> ()."""
        return 0.0

    def _descend(self, name: str, loss: Tensor) -> None:
        optimiser = self.optimisers[name]
        optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimiser.step()

    def state(self) -> dict[str, Tensor]:
        """Every number of the learner, by name."""
        tensors = {"log_temperature": self.log_temperature.detach().clone()}
        for name in ("actor", "average", "critics", "targets"):
            module: nn.Module = getattr(self, name)
            tensors |= {f"{name}.{key}": value.clone() for key, value in module.state_dict().items()}
        for name, optimiser in self.optimisers.items():
            for index, moments in optimiser.state_dict()["state"].items():
                tensors |= {f"optimiser.{name}.{index}.{key}": value for key, value in moments.items()}
        return tensors

    def load_state(self, tensors: dict[str, Tensor], updates: int) -> None:
        """Continue from state()."""
        self.updates = updates
        with torch.no_grad():
            self.log_temperature.copy_(tensors["log_temperature"])
        for name in ("actor", "average", "critics", "targets"):
            getattr(self, name).load_state_dict(_under(tensors, f"{name}."))
        for name, optimiser in self.optimisers.items():
            moments: dict[int, dict[str, Tensor]] = {}
            for key, value in _under(tensors, f"optimiser.{name}.").items():
                index, moment = key.split(".")
                moments.setdefault(int(index), {})[moment] = value
            optimiser.load_state_dict({**optimiser.state_dict(), "state": moments})


def _move_towards(slow: nn.Module, fast: nn.Module, rate: float) -> None:
    with torch.no_grad():
        torch._foreach_lerp_(list(slow.parameters()), list(fast.parameters()), rate)


def _under(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {key.removeprefix(prefix): value for key, value in tensors.items() if key.startswith(prefix)}
