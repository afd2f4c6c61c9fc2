"""The second stage of the studio's filter: PbARL's action encoder as a residual around the mode."""

import copy
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from worker.domain.trajectory import Trajectory
from worker.domain.type_aliases import Act, FloatArray
from worker.ml.filters.encoders.action_encoder import ResidualAdapter, kl_divergence
from worker.ml.filters.encoders.fitted_q import ActionValue, Transitions, evaluate_filter, spread_within_states
from worker.ml.filters.exported.filter_act import act_of
from worker.ml.filters.exported.filter_module import ModeTransform, load_state, state_of
from worker.ml.filters.fitting.filter_draft import FilterDraft
from worker.ml.filters.fitting.filter_problem import Collect, FilterConfig, FilterProblem, ReportProgress
from worker.ml.policies.torch_module import FrozenPolicy

Learn = Callable[[FilterProblem, FilterDraft, Sequence[Sequence[Trajectory]]], FilterDraft]
"""One round of residual learning from all rollouts so far."""


def train_residual(
    problem: FilterProblem,
    draft: FilterDraft,
    collect: Collect,
    progress: ReportProgress = lambda stage, share: None,
    learn: Learn | None = None,
) -> FilterDraft:
    """Rounds of: roll out the current filter with noise, learn its value, move its actions up that value.

    When a round has clearly made the learned return worse, its step is taken back, and from then on steps are half as
    bold. A refined policy is left as it is.
    ``learn``: learn_round(), or something that calls it in another process.
    """
    if draft.weights.refined:
        return draft
    rounds: list[list[Trajectory]] = []
    kept = draft
    earned: FloatArray | None = None
    for number in range(problem.config.residual_rounds):
        share = number / problem.config.residual_rounds
        progress(f"rolling out the filter, round {number + 1}", share)
        started = time.perf_counter()
        rounds.append(collect(*residual_rollouts(problem, draft, number)))
        draft = draft.timed("residual_rollouts", started)
        returns = problem.reward.returns(rounds[-1])
        if earned is None or not _clearly_below(returns, earned):
            kept, earned = draft, returns
        else:
            draft = replace(draft, weights=kept.weights)
            problem = replace(problem, config=problem.config.bolder(0.5))
        progress(f"training the action encoder, round {number + 1}", share + 0.5 / problem.config.residual_rounds)
        draft = (learn or learn_round)(problem, draft, rounds)
    return draft


def residual_rollouts(problem: FilterProblem, draft: FilterDraft, number: int) -> tuple[Act, Sequence[int], float, int]:
    """What ``collect`` is asked for before round ``number``."""
    config = problem.config
    act = act_of(problem.task.modes, problem.policy, draft.weights)
    return act, config.residual_block(problem.task, number), config.residual_noise, problem.seed + number


def _clearly_below(returns: FloatArray, earlier: FloatArray) -> bool:
    """Whether one mean is below another by more than the standard error of their difference; (N,), (M,)"""
    error = math.hypot(returns.std() / len(returns) ** 0.5, earlier.std() / len(earlier) ** 0.5)
    return float(earlier.mean() - returns.mean()) > error


def learn_round(problem: FilterProblem, draft: FilterDraft, rounds: Sequence[Sequence[Trajectory]]) -> FilterDraft:
    """One round: fitted Q evaluation of the current filter on all rollouts so far, then the adapter's ascent.

    Loss of the adapter, with q in its natural unit: |(abar - a) / sigma|^2 - lambda q(s, abar) + 1e-3 KL.
    """
    started = time.perf_counter()
    generator = torch.Generator().manual_seed(problem.seed * 1009 + len(rounds))
    data = Transitions.joined([_transitions(problem, each) for each in _flat(rounds)])
    newest = sum(len(each) for each in rounds[-1]) if len(rounds) > 1 else len(data)
    networks = _networks(problem, draft)
    bases = _bases(networks, data.observations)

    def current(observations: Tensor) -> Tensor:
        """What the filter does now."""
        here = _bases(networks, observations)
        return here.blended(networks.adapter(observations, here.actions, here.deviations))

    value_steps, adapter_steps = problem.config.learning_steps(len(rounds) - 1)
    evaluate_filter(networks.value, networks.target, data, newest, current, value_steps, generator)
    _ascend(problem.config, networks, data.observations, bases, adapter_steps, generator)
    weights = draft.weights.changed(encoder=state_of(networks.adapter), residual_share=1.0)
    return replace(draft, weights=weights, value=state_of(networks.value)).timed("residual_learning", started)


def _flat(rounds: Sequence[Sequence[Trajectory]]) -> list[Trajectory]:
    return [trajectory for each in rounds for trajectory in each]


def _transitions(problem: FilterProblem, trajectory: Trajectory) -> Transitions:
    rewards = problem.reward.member_rewards(trajectory).mean(axis=0)
    return Transitions.of(trajectory.observations, trajectory.actions, rewards)


@dataclass(frozen=True)
class _Networks:
    transform: ModeTransform
    """the mode without residual"""
    gate: float
    adapter: ResidualAdapter
    value: ActionValue
    target: ActionValue


@dataclass(frozen=True)
class _Bases:
    """What is there before the residual, in B states, (B, 7) each."""

    means: Tensor
    """the frozen policy"""
    actions: Tensor
    """the mode"""
    deviations: Tensor
    """the frozen policy's standard deviation"""
    gate: float

    def take(self, rows: Tensor) -> "_Bases":
        return _Bases(self.means[rows], self.actions[rows], self.deviations[rows], self.gate)

    def blended(self, moved: Tensor) -> Tensor:
        """The executed action when the mode's action has been moved to ``moved``."""
        return self.means + self.gate * (moved - self.means)


def _networks(problem: FilterProblem, draft: FilterDraft) -> _Networks:
    """As the draft left them, or new ones."""
    transform = ModeTransform(problem.task.modes, FrozenPolicy(problem.policy.weights), draft.weights.mode, None, 0.0)
    offset, scale = torch.from_numpy(problem.policy.offset), torch.from_numpy(problem.policy.scale)
    with torch.random.fork_rng():
        torch.manual_seed(problem.seed)
        adapter, value = ResidualAdapter(offset, scale), ActionValue(offset, scale)
    if draft.weights.encoder:
        load_state(adapter, draft.weights.encoder)
    if draft.value:
        load_state(value, draft.value)
    return _Networks(transform, draft.weights.gate, adapter, value, copy.deepcopy(value))


@torch.no_grad()
def _bases(networks: _Networks, observations: Tensor) -> _Bases:
    means, _ = networks.transform.policy(observations)
    actions, deviations = networks.transform.base(observations)
    return _Bases(means, actions, deviations, networks.gate)


def _ascend(
    config: FilterConfig,
    networks: _Networks,
    observations: Tensor,
    bases: _Bases,
    steps: int,
    generator: torch.Generator,
) -> None:
    """Move the adapter's actions up the value, held back in units of the policy's own uncertainty."""
    value = networks.value
    value.requires_grad_(False)
    sample = torch.randint(len(observations), (400,), generator=generator)
    near = bases.take(sample)
    unit = spread_within_states(value, observations[sample], near.actions, near.deviations, generator)
    optimiser = torch.optim.Adam(networks.adapter.parameters(), 1e-3, fused=True)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps, 5e-5)
    for _ in range(steps):
        rows = torch.randint(len(observations), (config.batch,), generator=generator)
        loss = _adapter_loss(config, networks, unit, observations[rows], bases.take(rows), generator)
        optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimiser.step()
        schedule.step()
    value.requires_grad_(True)


def _adapter_loss(
    config: FilterConfig,
    networks: _Networks,
    unit: float,
    observations: Tensor,
    bases: _Bases,
    generator: torch.Generator,
) -> Tensor:
    mean, log_variance = networks.adapter.encode(observations, bases.actions)
    latents = mean + (0.5 * log_variance).exp() * torch.randn(mean.shape, generator=generator)
    moved = networks.adapter.decode(observations, latents, bases.actions, bases.deviations)
    distance: Tensor = (((moved - bases.actions) / bases.deviations) ** 2).mean()
    gain: Tensor = networks.value(observations, bases.blended(moved)).mean() / unit
    return distance - config.preference_weight * gain + config.kl_weight * kl_divergence(mean, log_variance)
