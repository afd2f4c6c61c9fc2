"""A filter around the frozen policy as a callable for rollouts."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch

from worker.domain.modes import ModeFamily
from worker.domain.trajectory import Trajectory
from worker.domain.type_aliases import Float32Array
from worker.ml.filters.encoders.action_encoder import ResidualAdapter
from worker.ml.filters.exported.filter_module import FilterWeights, build, state_of
from worker.ml.filters.exported.filter_onnx import SHIELD, OnnxFilter, to_onnx
from worker.ml.filters.exported.shield import widest
from worker.ml.filters.exported.touch_limit import NAMES
from worker.ml.policies.asked_policy import AskedPolicy
from worker.ml.policies.gaussian import GaussianPolicy
from worker.ml.policies.reference import ReferencePolicy


@dataclass(frozen=True)
class FilterAct:
    """The exported filter around the frozen policy, as a rollout's callable: what is evaluated is what is shipped."""

    policy: ReferencePolicy
    exported: OnnxFilter

    def __call__(self, observation: Float32Array) -> Float32Array:
        """(D,) -> (7,)"""
        return self.exported(observation, self.policy.mean(observation))

    def batch(self, observations: Float32Array) -> Float32Array:
        """(B, D) -> (B, 7)"""
        return self.exported.batch(observations, self.policy.mean(observations))

    def shield_activity(self, driven: Trajectory) -> Float32Array:
        """(T, 1) of its shield, 0 where there is none."""
        seen = driven.observations[:-1]
        if not self.exported.is_shielded:
            return np.zeros((len(seen), 1), np.float32)
        return self.exported.run(seen, driven.reference_actions, [SHIELD])[0]


def trace(family: ModeFamily, policy: ReferencePolicy) -> None:
    """Export a mode without and with a residual and shield: act_of() then takes a hundredth of a second here."""
    encoders: list[Mapping[str, Float32Array]] = [{}]
    if isinstance(policy, GaussianPolicy):
        untrained = ResidualAdapter(torch.from_numpy(policy.offset), torch.from_numpy(policy.scale))
        encoders.append(state_of(untrained))
    every = widest(family.observation, policy.action_size)
    untouched = {name: limit for name, limit in every.items() if name not in NAMES}
    for encoder in encoders:
        for limits in ({}, untouched, every):
            act_of(family, policy, FilterWeights(encoder=encoder, shield=limits))


def act_of(family: ModeFamily, policy: ReferencePolicy, weights: FilterWeights) -> FilterAct:
    """Export a filter for rollouts."""
    rng = np.random.default_rng(0)
    spread = 0.3 * rng.standard_normal((64, len(policy.offset)))
    observations = (policy.offset + spread).astype(np.float32)
    if isinstance(policy, AskedPolicy):  # a server is asked about nothing that was invented
        means = rng.uniform(-1.0, 1.0, (len(observations), policy.action_size)).astype(np.float32)
    else:
        means = policy.mean(observations)
    return FilterAct(policy, OnnxFilter(to_onnx(build(family, policy, weights), observations, means)))
