"""The action filter as a torch module: what runs after the frozen policy, and what is exported.

action = policy_mean + gate * (transform(observation, policy_mean) - policy_mean). With gate 0 the policy is untouched.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal, Self

import numpy as np
import torch
from safetensors.numpy import load, save
from torch import Tensor, nn

from worker.domain.modes import ModeFamily
from worker.domain.type_aliases import Float32Array
from worker.ml.filters.encoders.action_encoder import ResidualAdapter
from worker.ml.filters.encoders.pbarl_printed import PrintedEncoder
from worker.ml.filters.exported.shield import Shield
from worker.ml.policies.gaussian import GaussianPolicy
from worker.ml.policies.reference import ReferencePolicy
from worker.ml.policies.torch_module import FrozenPolicy
from worker.ml.rewards.reward_models import stored_config

Method = Literal["studio", "printed"]


_SHIELD, _REFINED = "shield/", "refined/"


@dataclass(frozen=True)
class FilterWeights:
    """Everything personal about a filter as plain arrays: travels between processes, is stored, builds the module."""

    method: Method = "studio"
    mode: Mapping[str, float] = field(default_factory=dict)
    """the person's mode by the names of its axes; an axis that is not named is 0"""
    gate: float = 1.0
    residual_share: float = 1.0
    """how much of the residual is used, as a share of what was learned; 0: the mode alone, above 1: further that way"""
    encoder: Mapping[str, Float32Array] = field(default_factory=dict)
    """state of ResidualAdapter or PrintedEncoder; empty: none was trained"""
    shield: Mapping[str, Float32Array] = field(default_factory=dict)
    """limits of the shield (shield.untried, then shield.limits_of); empty: there is none"""
    refined: Mapping[str, Float32Array] = field(default_factory=dict)
    """weights of the person's refined policy, which acts in place of mode and residual; empty: it was not refined"""
    refined_mode: Mapping[str, float] = field(default_factory=dict)
    """the mode in which the refined policy is executed; an axis that is not named is 0"""

    @property
    def executed_mode(self) -> Mapping[str, float]:
        """The mode that the person gets, or that from which their own refined policy was learned on."""
        return self.refined_mode or self.mode

    @property
    def moves_nothing(self) -> bool:
        """Whether the filter leaves the reference policy as it is."""
        without_residual = not self.encoder or self.residual_share == 0.0
        off = without_residual and not any(self.mode.values()) and not self.refined
        return self.gate == 0.0 or (self.method == "studio" and off)

    def changed(self, **values: Any) -> Self:
        """The same with some values replaced."""
        return replace(self, **values)

    def to_bytes(self) -> bytes:
        """One safetensors file."""
        config = {
            "gate": self.gate,
            "kind": "action encoder",
            "method": self.method,
            "mode": dict(self.mode),
            "refined_mode": dict(self.refined_mode),
            "residual_share": self.residual_share,
        }
        limits = {f"{_SHIELD}{name}": array for name, array in self.shield.items()}
        refined = {f"{_REFINED}{name}": array for name, array in self.refined.items()}
        tensors = {name: np.ascontiguousarray(array) for name, array in {**self.encoder, **limits, **refined}.items()}
        return save(tensors, metadata={"config": json.dumps(config, sort_keys=True)})

    @classmethod
    def from_bytes(cls, stored: bytes) -> Self:
        """Read what to_bytes() wrote. Before there was a mode around refined policies these had none."""
        config = stored_config(stored)
        tensors = load(stored)
        limits, refined = (
            {name.removeprefix(part): tensors.pop(name) for name in [*tensors] if name.startswith(part)}
            for part in (_SHIELD, _REFINED)
        )
        return cls(
            method=config["method"],
            mode=config["mode"],
            gate=config["gate"],
            residual_share=config["residual_share"],
            encoder=tensors,
            shield=limits,
            refined=refined,
            refined_mode=config.get("refined_mode", {}),
        )


class ModeTransform(nn.Module):
    """An execution mode around the frozen policy or a refined one, and the residual adapter around that."""

    mode: Tensor
    residual_share: Tensor

    def __init__(
        self,
        family: ModeFamily,
        policy: FrozenPolicy,
        mode: Mapping[str, float],
        adapter: ResidualAdapter | None,
        residual_share: float,
    ) -> None:
        super().__init__()
        self.family = family
        self.policy = policy
        self.adapter = adapter
        self.register_buffer("mode", torch.tensor(family.vector(mode), dtype=torch.float32))
        self.register_buffer("residual_share", torch.tensor(residual_share, dtype=torch.float32))

    def base(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """The mode's action and the policy's deviation where the mode looks, (B, 7) each."""
        action, log_std = self.policy(self.family.perceived(observation, self.mode, torch))
        executed = self.family.executed(observation, self.mode, action, torch)
        return executed.clamp(-1.0, 1.0), self.policy.action_std(action, log_std)

    def forward(self, observation: Tensor, policy_mean: Tensor) -> Tensor:
        """(B, D), (B, 7) -> (B, 7). The policy is asked where the mode looks; policy_mean is not needed."""
        action, deviation = self.base(observation)
        if self.adapter is None:
            return action
        moved: Tensor = self.adapter(observation, action, deviation)
        return action + self.residual_share * (moved - action)


class ActionModeTransform(nn.Module):
    """The person's execution mode of a policy that is not looked into: it acts on what the policy said."""

    mode: Tensor

    def __init__(self, family: ModeFamily, mode: Mapping[str, float]) -> None:
        super().__init__()
        self.family = family
        self.register_buffer("mode", torch.tensor(family.vector(mode), dtype=torch.float32))

    def forward(self, observation: Tensor, policy_mean: Tensor) -> Tensor:
        """(B, D), (B, A) -> (B, A)"""
        action: Tensor = self.family.executed(observation, self.mode, policy_mean, torch).clamp(-1.0, 1.0)
        return action


class PrintedTransform(nn.Module):
    """The paper's encoder after the policy: encode (s, policy_mean), decode."""

    def __init__(self, encoder: PrintedEncoder) -> None:
        super().__init__()
        self.encoder = encoder

    def forward(self, observation: Tensor, policy_mean: Tensor) -> Tensor:
        """(B, D), (B, 7) -> (B, 7)"""
        action: Tensor = self.encoder(observation, policy_mean)
        return action


class ActionFilter(nn.Module):
    """observation (B, D), policy_mean (B, 7) -> action (B, 7) in [-1, 1]. Deterministic."""

    gate: Tensor
    outputs: tuple[str, ...] = ("action",)

    def __init__(self, transform: nn.Module, gate: float) -> None:
        super().__init__()
        self.transform = transform
        self.register_buffer("gate", torch.tensor(gate, dtype=torch.float32))

    @property
    def structure(self) -> object:
        """What decides about the computation besides the weights and their shapes; can be hashed."""
        return getattr(self.transform, "family", type(self.transform))

    def forward(self, observation: Tensor, policy_mean: Tensor) -> Tensor:
        """See the class."""
        change = self.transform(observation, policy_mean) - policy_mean
        action: Tensor = (policy_mean + self.gate * change).clamp(-1.0, 1.0)
        return action


class ShieldedFilter(nn.Module):
    """observation (B, D), policy_mean (B, A) -> action (B, A), the shield's activity (B, 1)."""

    outputs: tuple[str, ...] = ("action", "shield")

    def __init__(self, inner: ActionFilter, shield: Shield) -> None:
        super().__init__()
        self.inner, self.shield = inner, shield

    @property
    def structure(self) -> object:
        """See ActionFilter."""
        place = self.shield.place
        return self.inner.structure, None if place is None else (place.start, place.stop)

    def forward(self, observation: Tensor, policy_mean: Tensor) -> tuple[Tensor, Tensor]:
        """See the class."""
        action, activity = self.shield(observation, policy_mean, self.inner(observation, policy_mean))
        return action.clamp(-1.0, 1.0), activity


AnyFilter = ActionFilter | ShieldedFilter


def build(family: ModeFamily, policy: ReferencePolicy, weights: FilterWeights) -> AnyFilter:
    """The module for these weights around this policy, in evaluation mode, on the CPU.

    Raises ValueError when the weights name an axis that the task's family of modes does not have.
    """
    transform: nn.Module
    if not isinstance(policy, GaussianPolicy):
        if weights.method != "studio" or weights.encoder or weights.refined:
            raise ValueError("A policy that cannot be looked into has filters of modes alone.")
        return _finished(ActionModeTransform(family, weights.mode), family, weights)
    frozen = FrozenPolicy(policy.weights)
    if weights.method == "printed":
        encoder = PrintedEncoder(frozen.offset, frozen.scale)
        load_state(encoder, weights.encoder)
        transform = PrintedTransform(encoder)
    elif weights.refined:
        refined = FrozenPolicy(weights.refined)
        transform = ModeTransform(family, refined, weights.refined_mode, None, residual_share=0.0)
    else:
        adapter = None
        if weights.encoder and weights.residual_share > 0.0:
            adapter = ResidualAdapter(frozen.offset, frozen.scale)
            load_state(adapter, weights.encoder)
        transform = ModeTransform(family, frozen, weights.mode, adapter, weights.residual_share)
    return _finished(transform, family, weights)


def _finished(transform: nn.Module, family: ModeFamily, weights: FilterWeights) -> AnyFilter:
    inner = ActionFilter(transform, weights.gate)
    module: AnyFilter = inner
    if weights.shield:
        module = ShieldedFilter(inner, Shield(family.observation, weights.shield))
    return module.eval().requires_grad_(False)


def state_of(module: nn.Module) -> dict[str, Float32Array]:
    """A module's state as arrays."""
    return {name: tensor.detach().numpy().astype(np.float32) for name, tensor in module.state_dict().items()}


def load_state(module: nn.Module, state: Mapping[str, Float32Array]) -> None:
    """Put arrays back into a module."""
    module.load_state_dict({name: torch.from_numpy(np.array(array)) for name, array in state.items()})
