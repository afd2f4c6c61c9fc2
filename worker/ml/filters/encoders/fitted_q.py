"""Fitted Q evaluation: what an action is worth in the long run under the current filter and the learned reward.

The learned reward of one step ranks actions almost at random (moving now costs speed and earns distance only later);
its discounted sum under the policy that will be run does not.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Self

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn
from torch.nn import functional

from worker.ml.filters.encoders.action_encoder import OBSERVATION_CLIP

DISCOUNT = 0.97
POLYAK = 0.01
BATCH = 192

DeterministicActor = Callable[[Tensor], Tensor]
"""observations (B, D) -> the deterministic actions of the filter being evaluated (B, 7)"""


@dataclass(frozen=True)
class Transitions:
    """N steps (s, a, r, s') in one tensor each."""

    observations: Tensor
    actions: Tensor
    rewards: Tensor
    next_observations: Tensor

    @classmethod
    def of(
        cls, observations: npt.NDArray[np.float32], actions: npt.NDArray[np.float32], rewards: npt.ArrayLike
    ) -> Self:
        """One episode: observations (T + 1, D), actions (T, 7), rewards (T,)."""
        seen = torch.from_numpy(np.ascontiguousarray(observations, np.float32))
        done = torch.from_numpy(np.ascontiguousarray(actions, np.float32))
        return cls(seen[:-1], done, torch.from_numpy(np.asarray(rewards, np.float32)), seen[1:])

    @classmethod
    def joined(cls, parts: "list[Transitions]") -> "Transitions":
        """One after the other."""
        names = ("observations", "actions", "rewards", "next_observations")
        return cls(*(torch.cat([getattr(part, name) for part in parts]) for name in names))

    def __len__(self) -> int:
        return len(self.rewards)


class ActionValue(nn.Module):
    """Q(s, a), in units of one normalised step reward: a discounted mean, not a sum."""

    offset: Tensor
    scale: Tensor

    def __init__(self, offset: Tensor, scale: Tensor, action_size: int = 7, hidden: int = 96) -> None:
        super().__init__()
        self.register_buffer("offset", offset.clone())
        self.register_buffer("scale", scale.clone())
        self.body = nn.Sequential(
            nn.Linear(len(offset) + action_size, hidden),
            nn.SiLU(),
            nn.Linear(hidden, hidden),
            nn.SiLU(),
            nn.Linear(hidden, 1),
        )

    def forward(self, observations: Tensor, actions: Tensor) -> Tensor:
        """(..., D), (..., 7) -> (...)"""
        return self.of_inputs(self.inputs(observations, actions))

    def inputs(self, observations: Tensor, actions: Tensor) -> Tensor:
        """(..., D), (..., 7) -> (..., D + 7): what the network reads, the same for all copies of it"""
        seen = ((observations - self.offset) * self.scale).clamp(-OBSERVATION_CLIP, OBSERVATION_CLIP)
        return torch.cat([seen, actions], -1)

    def of_inputs(self, inputs: Tensor) -> Tensor:
        """(..., D + 7) -> (...)"""
        value: Tensor = self.body(inputs)[..., 0]
        return value


def evaluate_filter(
    value: ActionValue,
    target: ActionValue,
    data: Transitions,
    newest: int,
    actor: DeterministicActor,
    steps: int,
    generator: torch.Generator,
) -> float:
    """Train ``value`` towards Q of ``actor``; the last ``newest`` transitions fill half of every batch.

    Episodes end by time limit only, so every step is bootstrapped. ``target`` follows by Polyak averaging.
    Returns the mean squared error of the last hundred steps.
    """
    optimiser = torch.optim.Adam(value.parameters(), 1e-3, fused=True)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps, 1e-4)
    with torch.no_grad():
        next_actions = torch.cat([actor(part) for part in torch.split(data.next_observations, 8192)])
        here = value.inputs(data.observations, data.actions)
        following = value.inputs(data.next_observations, next_actions)
    slow, fast = list[Tensor](target.parameters()), list[Tensor](value.parameters())
    losses = torch.zeros(steps)
    for step, rows in enumerate(_batches(steps, len(data), newest, generator)):
        with torch.no_grad():
            wanted = (1.0 - DISCOUNT) * data.rewards[rows] + DISCOUNT * target.of_inputs(following[rows])
        loss = functional.mse_loss(value.of_inputs(here[rows]), wanted)
        optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimiser.step()
        schedule.step()
        with torch.no_grad():
            torch._foreach_lerp_(slow, fast, POLYAK)
        losses[step] = loss.detach()
    return float(losses[-100:].mean())


@torch.no_grad()
def spread_within_states(
    value: ActionValue, observations: Tensor, centres: Tensor, deviations: Tensor, generator: torch.Generator
) -> float:
    """Mean over states of the standard deviation of Q over ten actions drawn around ``centres``: Q's natural unit."""
    noise = torch.randn(10, *centres.shape, generator=generator)
    candidates = (centres + deviations * noise).clamp(-1.0, 1.0)
    values = value(observations.expand(10, *observations.shape), candidates)
    return max(float(values.std(dim=0).mean()), 1e-6)


def _batches(steps: int, total: int, newest: int, generator: torch.Generator) -> Tensor:
    """(steps, BATCH) rows of the data."""
    if newest >= total:
        return torch.randint(total, (steps, BATCH), generator=generator)
    anywhere = torch.randint(total, (steps, BATCH // 2), generator=generator)
    recent = torch.randint(total - newest, total, (steps, BATCH - BATCH // 2), generator=generator)
    return torch.cat([anywhere, recent], -1)
