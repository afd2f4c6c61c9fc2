"""The studio's filter, stage by stage: a person's execution mode, gated, and a residual adapter around it, gated again.

Every stage takes a draft and returns a better one; drafts are plain arrays and can be stored between stages. Rollouts
are made by a callable that is passed in, so this module knows nothing of the simulation:

    collect(act, scenarios, noise, seed) -> one Trajectory per scenario, in order

with act(observation (D,)) -> action (7,), and ``noise`` the standard deviation of Gaussian noise added to every action
(0 for evaluations; see noisy()). Acts can be pickled, so that collect may spread the scenarios over processes.
"""

import copy
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from worker.ml.action_filter import FilterWeights, ModeTransform, build, load_state, state_of
from worker.ml.adapter import ResidualAdapter, kl_divergence
from worker.ml.onnx_export import OnnxFilter, to_onnx
from worker.ml.policies import GaussianPolicy
from worker.ml.policy_module import FrozenPolicy
from worker.ml.response_surface import ResponseSurface, best_mode
from worker.ml.reward_models import RewardModel
from worker.ml.value import ActionValue, Transitions, evaluate_filter, spread_within_states
from worker.modes import ModeFamily
from worker.tasks import Task
from worker.trajectory import Trajectory

Array = npt.NDArray[np.float32]
Floats = npt.NDArray[np.float64]
Progress = Callable[[str, float], None]
"""What is being done in human words, and the share of the whole fit that is done."""


Act = Callable[[Array], Array]
"""What a rollout asks for every action: (D,) -> (7,)"""


class Collect(Protocol):
    """What makes rollouts."""

    def __call__(self, act: Act, scenarios: Sequence[int], noise: float, seed: int, /) -> list[Trajectory]:
        """One trajectory per scenario, in order."""
        ...


@dataclass(frozen=True)
class FilterConfig:
    """Counts and tolerances; the defaults fit two cores and about a minute (docs/results/feeding_loop.md)."""

    mode_attempts: int = 3
    """modes tried on held-out scenarios at full strength, each chosen knowing what came of those before"""
    gates: tuple[float, ...] = (0.6, 0.3)
    """strengths at which the last of them is tried when none at full strength was acceptable"""
    gate_scenarios: int = 80
    success_tolerance: float = 0.035
    """largest accepted loss of success on the gate's scenarios, as a share of episodes"""
    force_limit_n: float = 10.0
    """largest accepted force on the person: 95 of 100 episodes must stay below it (or below the reference's own)"""
    round_rollouts: tuple[int, ...] = (100, 60)
    """rollouts of the current filter before each round of residual learning; () leaves the residual out"""
    round_noise: tuple[float, ...] = (0.25, 0.18)
    value_steps: int = 1500
    adapter_steps: int = 400
    batch: int = 96
    preference_weight: float = 0.3
    """lambda: weight of the normalised value against squared distance in policy standard deviations"""
    kl_weight: float = 1e-3
    residual_shares: tuple[float, ...] = (1.0, 0.5)
    evaluation_scenarios: int = 200


@dataclass(frozen=True)
class FilterProblem:
    """What a filter is fitted for."""

    task: Task
    policy: GaussianPolicy
    reward: RewardModel
    seed: int
    config: FilterConfig = FilterConfig()


@dataclass(frozen=True)
class Trial:
    """One setting tried on the gate's scenarios."""

    gate: float
    residual_share: float
    preference: float
    """mean change of the learned return, in standard deviations of the reference's returns"""
    success_change: float
    """share of episodes"""
    p95_force_n: float
    """95 % of the episodes stay below this force on the person"""


@dataclass(frozen=True)
class FilterDraft:
    """A filter between two stages. Plain values and arrays."""

    weights: FilterWeights
    value: Mapping[str, Array] = field(default_factory=dict)
    """state of the action value, so that a later round goes on from it"""
    trials: tuple[Trial, ...] = ()
    """in their order, except that the chosen mode's comes after the other modes'"""
    notes: tuple[str, ...] = ()
    seconds: Mapping[str, float] = field(default_factory=dict)

    def timed(self, stage: str, started: float) -> "FilterDraft":
        """The same with the seconds since ``started`` added to a stage."""
        spent = self.seconds.get(stage, 0.0) + time.perf_counter() - started
        return replace(self, seconds={**self.seconds, stage: round(spent, 3)})


Learn = Callable[[FilterProblem, FilterDraft, Sequence[Sequence[Trajectory]]], FilterDraft]
"""One round of residual learning from all rollouts so far."""

SCENARIO_BLOCKS = {"gate": 2_000_000, "residual": 3_000_000, "evaluation": 4_000_000, "recording": 5_000_000}
"""First scenario of each purpose. Others: exploration 100_000, test of the policy 1_000_000, what is rated or shown
before and after 6_000_000 (app.services.evaluating), clips from 10_000_000."""


def scenarios_for(purpose: str, count: int, skip: int = 0) -> range:
    """Scenarios that no other purpose uses."""
    first = SCENARIO_BLOCKS[purpose] + skip
    return range(first, first + count)


@dataclass(frozen=True)
class FilterAct:
    """The exported filter around the frozen policy, as a rollout's callable: what is evaluated is what is shipped."""

    policy: GaussianPolicy
    exported: OnnxFilter
    gate: float = 1.0
    """an extra gate on top of the exported one, to try gates without exporting again"""

    def __call__(self, observation: Array) -> Array:
        """(D,) -> (7,)"""
        mean = self.policy.mean(observation)
        return mean + np.float32(self.gate) * (self.exported(observation, mean) - mean)


def noisy(act: Act, noise: float, seed: int, scenario: int) -> Act:
    """The same with Gaussian noise, drawn independently for every scenario: for implementations of ``collect``."""
    if noise == 0.0:
        return act
    rng = np.random.default_rng([seed, scenario])

    def act_with_noise(observation: Array) -> Array:
        action = act(observation)
        return action + noise * rng.standard_normal(action.shape, np.float32)

    return act_with_noise


def act_of(family: ModeFamily, policy: GaussianPolicy, weights: FilterWeights) -> FilterAct:
    """Export a filter for rollouts."""
    rng = np.random.default_rng(0)
    spread = 0.3 * rng.standard_normal((64, len(policy.offset)))
    observations = (policy.offset + spread).astype(np.float32)
    return FilterAct(
        policy, OnnxFilter(to_onnx(build(family, policy, weights), observations, policy.mean(observations)))
    )


# -- the stages --------------------------------------------------------------------------------------------------------


def fit_studio(
    problem: FilterProblem,
    surface: ResponseSurface,
    pool: Sequence[Trajectory],
    reference: Sequence[Trajectory],
    collect: Collect,
    progress: Progress = lambda stage, share: None,
) -> FilterDraft:
    """All stages in a row. ``reference``: rollouts of the reference policy on scenarios_for("gate", gate_scenarios)."""
    draft = find_mode(problem, surface, pool, reference, collect, progress)
    draft = train_residual(problem, draft, collect, progress)
    return gate_residual(problem, draft, reference, collect, progress)


def find_mode(
    problem: FilterProblem,
    surface: ResponseSurface,
    pool: Sequence[Trajectory],
    reference: Sequence[Trajectory],
    collect: Collect,
    progress: Progress = lambda stage, share: None,
) -> FilterDraft:
    """The mode with the best learned return of those tried that keep the task and its forces.

    The best predicted mode lies where the surface knows least, and is the one whose success and return are most likely
    overestimated. It is therefore tried on the held-out scenarios of ``reference``, the surface learns from the trial,
    and the search goes on from there. When no attempt is acceptable the last mode is weakened; at worst it is off.
    ``pool``: rollouts of many modes, used only when the reward is not linear in the signals.
    """
    started = time.perf_counter()
    wishes = problem.reward.signal_weights(pool)
    tried: list[tuple[Trial, Floats]] = []
    for attempt in range(problem.config.mode_attempts):
        progress("searching the person's way of doing the task", 0.1 * attempt)
        mode = best_mode(surface, wishes, problem.seed)
        if not mode.any() or any(np.array_equal(mode, earlier) for _, earlier in tried):
            break
        progress(f"checking mode {attempt + 1} on held-out scenarios", 0.03 + 0.1 * attempt)
        trial, driven = _try(problem, _act_in(problem, mode), 1.0, 0.0, reference, collect)
        tried.append((trial, mode))
        surface = surface.with_observed(mode, _signal_changes(reference, driven), _successes(driven))
    if not tried:
        return _without_mode("The labels do not yet say clearly what to change; the mode is off.", [], started)
    accepted = [each for each in tried if _acceptable(problem, each[0], reference)]
    for gate in problem.config.gates if not accepted else ():
        progress(f"checking the mode at {gate:.0%} on held-out scenarios", 0.32)
        act = replace(_act_in(problem, tried[-1][1]), gate=gate)
        weakened = _try(problem, act, gate, 0.0, reference, collect)[0], tried[-1][1]
        tried.append(weakened)
        if _acceptable(problem, weakened[0], reference):
            accepted = [weakened]
            break
    trials = [trial for trial, _ in tried]
    if not accepted:
        note = "No mode was better while keeping the task and the forces; the mode is off."
        return _without_mode(note, trials, started)
    chosen, mode = max(accepted, key=lambda each: each[0].preference)
    weights = FilterWeights(mode=problem.task.modes.named(mode), gate=chosen.gate)
    ordered = (*(trial for trial in trials if trial is not chosen), chosen)
    return FilterDraft(weights, trials=ordered).timed("mode", started)


def train_residual(
    problem: FilterProblem,
    draft: FilterDraft,
    collect: Collect,
    progress: Progress = lambda stage, share: None,
    learn: Learn | None = None,
) -> FilterDraft:
    """Rounds of: roll out the current filter with noise, learn its value, move its actions up that value.

    ``learn``: learn_round(), or something that calls it in another process.
    """
    rounds: list[list[Trajectory]] = []
    for number in range(len(problem.config.round_rollouts)):
        share = 0.35 + 0.35 * number / len(problem.config.round_rollouts)
        progress(f"rolling out the filter, round {number + 1}", share)
        started = time.perf_counter()
        rounds.append(collect(*residual_rollouts(problem, draft, number)))
        draft = draft.timed("residual_rollouts", started)
        progress(f"training the action encoder, round {number + 1}", share + 0.1)
        draft = (learn or learn_round)(problem, draft, rounds)
    return draft


def residual_rollouts(problem: FilterProblem, draft: FilterDraft, number: int) -> tuple[Act, Sequence[int], float, int]:
    """What ``collect`` is asked for before round ``number``."""
    config = problem.config
    act = act_of(problem.task.modes, problem.policy, draft.weights)
    scenarios = scenarios_for("residual", config.round_rollouts[number], 1000 * number)
    return act, scenarios, config.round_noise[number], problem.seed + number


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

    steps = problem.config.value_steps
    evaluate_filter(networks.value, networks.target, data, newest, current, steps, generator)
    _ascend(problem.config, networks, data.observations, bases, generator)
    weights = draft.weights.changed(encoder=state_of(networks.adapter), residual_share=1.0)
    return replace(draft, weights=weights, value=state_of(networks.value)).timed("residual_learning", started)


def gate_residual(
    problem: FilterProblem,
    draft: FilterDraft,
    reference: Sequence[Trajectory],
    collect: Collect,
    progress: Progress = lambda stage, share: None,
) -> FilterDraft:
    """Keep the share of the residual with the best learned return among those that keep the task; possibly none."""
    if not draft.weights.encoder:
        return draft
    started = time.perf_counter()
    trials: list[Trial] = []
    for share in problem.config.residual_shares:
        progress(f"checking {share:.0%} of the residual on held-out scenarios", 0.75 + 0.1 * len(trials))
        weights = draft.weights.changed(residual_share=share)
        act = act_of(problem.task.modes, problem.policy, weights)
        trials.append(_try(problem, act, weights.gate, share, reference, collect)[0])
    without = draft.trials[-1:]  # the mode alone, where one was accepted
    acceptable = [trial for trial in (*trials, *without) if _acceptable(problem, trial, reference)]
    share = max(acceptable, key=lambda trial: trial.preference).residual_share if acceptable else 0.0
    weights = draft.weights.changed(residual_share=share)
    notes = draft.notes
    if share == 0.0:
        notes = (*notes, "The residual did not help on held-out scenarios and is off.")
    return replace(draft, weights=weights, trials=(*draft.trials, *trials), notes=notes).timed("gate_residual", started)


# -- inside ------------------------------------------------------------------------------------------------------------


def _act_in(problem: FilterProblem, mode: Floats) -> FilterAct:
    return act_of(problem.task.modes, problem.policy, FilterWeights(mode=problem.task.modes.named(mode)))


def _without_mode(note: str, trials: Sequence[Trial], started: float) -> FilterDraft:
    return FilterDraft(FilterWeights(), trials=tuple(trials), notes=(note,)).timed("mode", started)


def _try(
    problem: FilterProblem,
    act: Act,
    gate: float,
    residual_share: float,
    reference: Sequence[Trajectory],
    collect: Collect,
) -> tuple[Trial, Sequence[Trajectory]]:
    """What came of it in the scenarios of ``reference``, and the rollouts."""
    scenarios = [each.scenario for each in reference]
    filtered = collect(act, scenarios, 0.0, problem.seed)
    before, after = problem.reward.returns(reference), problem.reward.returns(filtered)
    unit = max(float(before.std()), 1e-9)
    success = float((_successes(filtered) - _successes(reference)).mean())
    trial = Trial(gate, residual_share, float((after - before).mean()) / unit, success, _p95_force_n(filtered))
    return trial, filtered


def _signal_changes(reference: Sequence[Trajectory], filtered: Sequence[Trajectory]) -> Floats:
    """(N, S) of the summed signals, scenario by scenario."""
    pairs = zip(reference, filtered, strict=True)
    return np.array(
        [after.signals.sum(axis=0, dtype=np.float64) - before.signals.sum(axis=0) for before, after in pairs]
    )


def _successes(trajectories: Sequence[Trajectory]) -> Floats:
    return np.array([float(each.success) for each in trajectories])


def _acceptable(problem: FilterProblem, trial: Trial, reference: Sequence[Trajectory]) -> bool:
    config = problem.config
    gentle = trial.p95_force_n <= max(config.force_limit_n, _p95_force_n(reference))
    return trial.preference > 0.0 and trial.success_change >= -config.success_tolerance and gentle


def _p95_force_n(trajectories: Sequence[Trajectory]) -> float:
    return float(np.quantile([each.contact_force_n.max() for each in trajectories], 0.95))


def _flat(rounds: Sequence[Sequence[Trajectory]]) -> list[Trajectory]:
    return [trajectory for each in rounds for trajectory in each]


def _transitions(problem: FilterProblem, trajectory: Trajectory) -> Transitions:
    return Transitions.of(trajectory.observations, trajectory.actions, problem.reward.rewards_of(trajectory))


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
    config: FilterConfig, networks: _Networks, observations: Tensor, bases: _Bases, generator: torch.Generator
) -> None:
    """Move the adapter's actions up the value, held back in units of the policy's own uncertainty."""
    value = networks.value
    value.requires_grad_(False)
    sample = torch.randint(len(observations), (400,), generator=generator)
    near = bases.take(sample)
    unit = spread_within_states(value, observations[sample], near.actions, near.deviations, generator)
    optimiser = torch.optim.Adam(networks.adapter.parameters(), 1e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, config.adapter_steps, 5e-5)
    for _ in range(config.adapter_steps):
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
