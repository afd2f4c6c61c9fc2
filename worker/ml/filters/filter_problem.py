"""What a filter is fitted for, what is known of it between two stages of a fit, and the filter as a callable.

Drafts are plain arrays and can be stored. Rollouts are made by a callable that is passed in, so nothing in here knows
the simulation:

    collect(act, scenarios, noise, seed) -> one Trajectory per scenario, in order

with act(observation (D,)) -> action (7,), and ``noise`` the standard deviation of Gaussian noise added to every action
(0 for evaluations; see worker.compute.learning.noisy()). Acts can be pickled, so that collect may spread the scenarios
over processes.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np
import torch

from worker.domain.modes import ModeFamily
from worker.domain.scenarios import GATE, RESIDUAL, first_of
from worker.domain.task import Task
from worker.domain.trajectory import Trajectory
from worker.domain.type_aliases import Act, Float32Array
from worker.ml.filters.action_encoder import ResidualAdapter
from worker.ml.filters.filter_module import FilterWeights, build, state_of
from worker.ml.filters.filter_onnx import OnnxFilter, to_onnx
from worker.ml.filters.response_surface import CAUTION
from worker.ml.filters.shield import widest
from worker.ml.policies.asked_policy import AskedPolicy
from worker.ml.policies.gaussian import GaussianPolicy
from worker.ml.policies.reference import ReferencePolicy
from worker.ml.rewards.reward_models import RewardModel

ReportProgress = Callable[[str, float], None]
"""What is being done in human words, and the share of the whole fit that is done."""


class Collect(Protocol):
    """What makes rollouts."""

    def __call__(self, act: Act, scenarios: Sequence[int], noise: float, seed: int, /) -> list[Trajectory]:
        """One trajectory per scenario, in order."""
        ...


CHECK_FROM, WATCH_FROM = 10_000, 20_000
"""of the gate's scenarios; the ones before are those of a gate, however many that has"""
USUAL_STEPS = 100
"""Control steps of an episode, in which the counts of episodes below are meant."""


@dataclass(frozen=True)
class FilterConfig:
    """Counts and tolerances; the defaults fit two cores and about a minute (docs/results/retraining.md)."""

    mode_attempts: int = 3
    """modes tried on held-out scenarios at full strength, each chosen knowing what came of those before"""
    modes_to_choose_from: int = 2
    """acceptable ones after which no further is tried"""
    success_caution: float = CAUTION
    """standard deviations by which the surface's log odds of success count less while a mode is sought"""
    gates: tuple[float, ...] = (0.6, 0.3)
    """strengths at which the last of them is tried when none at full strength was acceptable"""
    gate_scenarios: int = 80
    """of USUAL_STEPS control steps; see gate_block()"""
    check_scenarios: int = 400
    """of USUAL_STEPS control steps, in which a refined policy is tried once more; see check_block()"""
    watch_scenarios: int = 200
    """of USUAL_STEPS control steps, in which a policy is tried while it is refined; see watch_block()"""
    success_tolerance: float = 0.035
    """largest accepted loss of success on the gate's scenarios, as a share of episodes"""
    force_limit_n: float = 10.0
    """largest accepted force on the person: 95 of 100 episodes must stay below it (or below the reference's own)"""
    residual_rounds: int = 3
    """of residual learning; 0 leaves the residual out"""
    residual_rollouts: int = 50
    """of the current filter before each round, of USUAL_STEPS control steps; see residual_block()"""
    residual_noise: float = 0.1
    """standard deviation of what is added to their actions"""
    value_steps: int = 3000
    """of fitted Q evaluation in the first round"""
    adapter_steps: int = 500
    """of the encoder's ascent in the first round"""
    later_share: float = 0.5
    """so much of both in every later round, which goes on from the networks of the one before"""
    batch: int = 96
    preference_weight: float = 0.3
    """lambda: weight of the normalised value against squared distance in policy standard deviations"""
    kl_weight: float = 1e-3
    residual_shares: tuple[float, ...] = (1.0, 0.5)
    """tried in this order until one is acceptable and better than the mode alone"""
    evaluation_scenarios: int = 100

    def gate_block(self, task: Task) -> range:
        """Scenarios on which a setting is tried before it is accepted."""
        return first_of(GATE, _affordable(self.gate_scenarios, task))

    def check_block(self, task: Task) -> range:
        """Scenarios in which nothing has been tried on the way to what is accepted there."""
        return first_of(GATE, _affordable(self.check_scenarios, task), skip=CHECK_FROM)

    def watch_block(self, task: Task) -> range:
        """Scenarios in which a policy that is being refined is tried, again and again."""
        return first_of(GATE, _affordable(self.watch_scenarios, task), skip=WATCH_FROM)

    def residual_block(self, task: Task, number: int) -> range:
        """Scenarios in which the filter is rolled out before round ``number`` of residual learning."""
        return first_of(RESIDUAL, _affordable(self.residual_rollouts, task), 1000 * number)

    def learning_steps(self, number: int) -> tuple[int, int]:
        """Gradient steps of the value and of the encoder in round ``number``, from 0 on."""
        share = self.later_share if number else 1.0
        return max(1, round(share * self.value_steps)), max(1, round(share * self.adapter_steps))

    def bolder(self, factor: float) -> "FilterConfig":
        """The same with so many times the weight of the value."""
        return replace(self, preference_weight=factor * self.preference_weight)


@dataclass(frozen=True)
class FilterProblem:
    """What a filter is fitted for."""

    task: Task
    policy: ReferencePolicy
    reward: RewardModel
    seed: int
    config: FilterConfig = FilterConfig()


@dataclass(frozen=True)
class GateTrial:
    """One setting tried on the gate's scenarios."""

    gate: float
    residual_share: float
    preference: float
    """mean change of the learned return, in standard deviations of the reference's returns"""
    success_change: float
    """share of episodes"""
    p95_force_n: float
    """95 % of the episodes stay below this force on the person"""
    refined: bool = False
    """whether it was the person's refined policy, in place of mode and residual"""


@dataclass(frozen=True)
class FilterDraft:
    """A filter between two stages. Plain values and arrays."""

    weights: FilterWeights
    value: Mapping[str, Float32Array] = field(default_factory=dict)
    """state of the action value, so that a later round goes on from it"""
    trials: tuple[GateTrial, ...] = ()
    """in their order, except that the chosen mode's comes after the other modes'"""
    notes: tuple[str, ...] = ()
    seconds: Mapping[str, float] = field(default_factory=dict)
    tested: Mapping[str, Float32Array] = field(default_factory=dict)
    """what the filter stayed within when it was tried (shield.limits_of)"""
    promise: Mapping[str, Any] = field(default_factory=dict)
    """a Promise (worker.analysis.filters.promise) and the tests that earned it, as plain values; empty: none"""
    choice: Mapping[str, float] = field(default_factory=dict)
    """the chance of each of several policies to be the best; empty: it is a filter"""

    def timed(self, stage: str, started: float) -> "FilterDraft":
        """The same with the seconds since ``started`` added to a stage."""
        spent = self.seconds.get(stage, 0.0) + time.perf_counter() - started
        return replace(self, seconds={**self.seconds, stage: round(spent, 3)})

    def shielded(self) -> "FilterDraft":
        """The same with a shield around what was tested."""
        return replace(self, weights=self.weights.changed(shield=self.tested))


def _affordable(episodes: int, task: Task) -> int:
    """So many episodes of the usual length, or fewer longer ones: a fit takes about the same time in every task."""
    return max(1, round(episodes * min(1.0, USUAL_STEPS / task.episode_steps)))


@dataclass(frozen=True)
class FilterAct:
    """The exported filter around the frozen policy, as a rollout's callable: what is evaluated is what is shipped."""

    policy: ReferencePolicy
    exported: OnnxFilter
    gate: float = 1.0
    """an extra gate on top of the exported one, to try gates without exporting again"""

    def __call__(self, observation: Float32Array) -> Float32Array:
        """(D,) -> (7,)"""
        mean = self.policy.mean(observation)
        return mean + np.float32(self.gate) * (self.exported(observation, mean) - mean)

    def batch(self, observations: Float32Array) -> Float32Array:
        """(B, D) -> (B, 7)"""
        means = self.policy.mean(observations)
        return means + np.float32(self.gate) * (self.exported.batch(observations, means) - means)


def trace(family: ModeFamily, policy: ReferencePolicy) -> None:
    """Export a mode without and with a residual and shield: act_of() then takes a hundredth of a second here."""
    encoders: list[Mapping[str, Float32Array]] = [{}]
    if isinstance(policy, GaussianPolicy):
        untrained = ResidualAdapter(torch.from_numpy(policy.offset), torch.from_numpy(policy.scale))
        encoders.append(state_of(untrained))
    for encoder in encoders:
        for limits in ({}, widest(family.observation, policy.action_size)):
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
