"""Policies refined beforehand, for people who mind one signal especially: what somebody's filter may be, or begin as.

One search finds what another misses, and a mode goes only where modes lead: a filter may be the best policy that was
found for anybody, by the person's own learned reward, and a refinement goes on from there (decisions 192 and 199).
Choosing among policies by what each has earned in the same scenarios is generalised policy improvement over whole
policies (Barreto et al. 2017, arXiv 1606.05312). Each may be executed in a mode of the person's own, which a response
surface around that policy foresees (decision 197).
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from worker.domain.trajectory import Trajectory
from worker.domain.type_aliases import FloatArray
from worker.ml.filters.exported.filter_module import FilterWeights
from worker.ml.filters.exported.shield import untried
from worker.ml.filters.fitting.filter_draft import FilterDraft, GateTrial
from worker.ml.filters.fitting.filter_problem import Collect, FilterProblem, ReportProgress
from worker.ml.filters.fitting.gate import (
    gained,
    keeps_task,
    largest_forces,
    signal_changes,
    spread_of,
    successes,
    to_beat,
    trial_of,
)
from worker.ml.filters.fitting.mode_archive import ModeForces, tail_growth_n
from worker.ml.filters.fitting.mode_search import caution_of
from worker.ml.filters.fitting.response_surface import ResponseSurface, best_mode
from worker.ml.policies.gaussian import GaussianPolicy
from worker.ml.reinforcement.refinement_gate import ArchivedDraft, gate_refined, try_refined

TRIED_IN_MODES = 10
"""each is a drive through the gate's scenarios, and most lose the task in one or two of them"""
NEXT_BEST = 3
"""policies that are left to be tried where the best one does not pass: each is a drive through the check's scenarios"""


@dataclass(frozen=True)
class ArchivedPolicy:
    """A policy that was refined for somebody else, and what it does in the gate's scenarios."""

    policy: GaussianPolicy
    driven: Sequence[Trajectory]
    around: ResponseSurface | None = None
    """of modes in which it is executed, beside itself; None: they were not explored"""


def best_archived(
    problem: FilterProblem,
    draft: FilterDraft,
    archived: Sequence[ArchivedPolicy],
    known: Sequence[Trajectory],
    reference: Sequence[Trajectory],
    collect: Collect,
    beaten: float | None = None,
) -> list[ArchivedDraft]:
    """The draft with the archived policies that the reward model likes best, the best first; none: its mode is better.

    Policies are tried in modes, too, always the one of which most is foreseen in the mode that is best for this person.
    Every trial says more of the modes around its policy, where another may be sought; where more is lost than by the
    policy alone, another is sought more carefully, as the best of several tries is the luckiest, too. Each policy is
    returned once, in its best mode. ``known``: rollouts of many behaviours; ``reference``: of the frozen policy in the
    gate's scenarios; ``beaten``: what has to be gained; None: what the draft's mode gains.
    """
    least = to_beat(problem, draft, reference) if beaten is None else beaten
    found, most = list[_Found](), least
    trials = [trial_of(problem, 1.0, 0.0, reference, each.driven) for each in archived]
    for each, trial in zip(archived, trials, strict=True):
        if trial.preference > least and keeps_task(problem, trial, reference):
            alone = replace(draft, weights=draft.weights.changed(refined=each.policy.weights))
            found.append(_Found(trial.preference, each, ArchivedDraft(alone, each.driven)))
            most = max(most, trial.preference)
    explored = _in_modes(problem, archived, trials, known, reference)
    for _ in range(TRIED_IN_MODES if explored else 0):
        some = max(explored, key=_foreseen)
        if some.foreseen <= most:
            break
        mode = problem.task.modes.named(some.mode)
        weights = draft.weights.changed(refined=some.archived.policy.weights, refined_mode=mode)
        candidate = replace(draft, weights=weights)
        trial, tried = try_refined(problem, candidate, 1.0, reference, collect)
        is_kept = _loses_no_more(trial, some.trial) and keeps_task(problem, trial, reference)
        if trial.preference > least and is_kept:
            found.append(_Found(trial.preference, some.archived, ArchivedDraft(candidate, tried)))
            most = max(most, trial.preference)
        some.observe(reference, tried, is_kept=is_kept)
    return _best_of_each(found)[: 1 + NEXT_BEST]


@dataclass(frozen=True)
class _Found:
    """What is better than the mode and keeps the task."""

    preference: float
    archived: ArchivedPolicy
    draft: ArchivedDraft


def _best_of_each(found: Sequence[_Found]) -> list[ArchivedDraft]:
    best = dict[int, ArchivedDraft]()
    for each in sorted(found, key=lambda each: each.preference, reverse=True):
        best.setdefault(id(each.archived), each.draft)
    return list(best.values())


def choose_archived(
    problem: FilterProblem,
    own: FilterDraft,
    archived: Sequence[ArchivedPolicy],
    known: Sequence[Trajectory],
    reference: Sequence[Trajectory],
    more_reference: Callable[[], Sequence[Trajectory]],
    collect: Collect,
    progress: ReportProgress = lambda stage, share: None,
) -> FilterDraft:
    """The archived policy that is best for a person, in a mode of their own, if it is better than ``own``; else that.

    It has to gain more than ``own``, mode and residual, has gained in the same scenarios, and to pass what a refinement
    has to; see best_archived() and gate_refined().
    """
    if not archived or own.weights.refined:
        return own
    started, beaten = time.perf_counter(), gained(problem, own, reference)
    off = FilterWeights(shield=untried(problem.task.observation, problem.policy.action_size, reference))
    draft = FilterDraft(off)
    best = best_archived(problem, draft, archived, known, reference, collect, beaten)
    if not best:
        return own.timed("archived", started)
    chosen = gate_refined(problem, draft, best, (), reference, more_reference, collect, progress, beaten)
    trials = (*own.trials, *chosen.trials)
    better = replace(chosen, seconds={**own.seconds, **chosen.seconds}) if chosen.weights.refined else own
    return replace(better, trials=trials).timed("archived", started)


def _wishes(problem: FilterProblem, known: Sequence[Trajectory], reference: Sequence[Trajectory]) -> FloatArray:
    """(E, S) what the reward model's members want, in the unit of a trial's preference."""
    wanted: FloatArray = problem.reward.signal_weights(known)
    return wanted / spread_of(problem.reward.member_returns(reference))


def _best_mode(
    problem: FilterProblem, surface: ResponseSurface, forces: ModeForces | None, wishes: FloatArray, lost: int = 0
) -> FloatArray:
    """(A,) the mode that a surface says is best; ``lost``: how many were tried that lost anything."""
    return best_mode(
        surface,
        wishes,
        problem.seed,
        caution=caution_of(problem),
        success_caution=problem.config.success_caution * (1 + lost),
        forces=forces,
        most_growth_n=problem.config.pressed_n,
    )


def _in_modes(
    problem: FilterProblem,
    archived: Sequence[ArchivedPolicy],
    trials: Sequence[GateTrial],
    known: Sequence[Trajectory],
    reference: Sequence[Trajectory],
) -> list["_InModes"]:
    """Those whose modes were explored."""
    if all(each.around is None for each in archived):
        return []
    wishes = _wishes(problem, known, reference)
    return [
        _InModes(problem, each, each.around, trial, wishes)
        for each, trial in zip(archived, trials, strict=True)
        if each.around is not None
    ]


class _InModes:
    """An archived policy, and which mode is best for it by all that is known of those around it."""

    def __init__(
        self,
        problem: FilterProblem,
        archived: ArchivedPolicy,
        around: ResponseSurface,
        trial: GateTrial,
        wishes: FloatArray,
    ) -> None:
        """``trial``: of the policy as it is; ``wishes``: (E, S) in the unit of its preference."""
        self.problem, self.archived, self.trial, self.wishes = problem, archived, trial, wishes
        self.surface, self.forces, self.lost = around, around.forces, 0
        self._seek()

    def observe(self, reference: Sequence[Trajectory], driven: Sequence[Trajectory], *, is_kept: bool) -> None:
        """Learn from what came of the mode in the gate's scenarios, and seek another."""
        changes = signal_changes(self.archived.driven, driven)
        self.surface = self.surface.with_observed(self.mode, changes, successes(driven))
        growth_n = tail_growth_n(largest_forces(driven) - largest_forces(reference))
        self.forces = self.forces.with_observed(self.mode, float(growth_n))
        self.lost += not is_kept
        self._seek()

    def _seek(self) -> None:
        self.mode = _best_mode(self.problem, self.surface, self.forces, self.wishes, self.lost)
        is_new = self.mode.any() and not any(np.array_equal(self.mode, tried) for tried in self.forces.modes)
        gained = float(self.surface.predict(self.mode)[0] @ self.wishes.mean(axis=0))
        self.foreseen = self.trial.preference + gained if is_new else -np.inf


def _loses_no_more(trial: GateTrial, alone: GateTrial) -> bool:
    """Than the archived policy in no mode, and than the reference policy: what these lose, no mode has to win back."""
    return trial.success_change >= min(0.0, alone.success_change) and trial.pressed <= alone.pressed


def _foreseen(some: _InModes) -> float:
    return some.foreseen
