"""Policies refined beforehand, for people who mind one signal especially: what somebody's filter may be, or begin as.

One search finds what another misses, and a mode goes only where modes lead: a filter may be the best policy that was
found for anybody, by the person's own learned reward, and a refinement goes on from there (decisions 192 and 199).
Choosing among policies by what each has earned in the same scenarios is generalised policy improvement over whole
policies (Barreto et al. 2017, arXiv 1606.05312). Each may be executed in a mode of the person's own, which a response
surface around that policy foresees (decision 197).
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from worker.domain.trajectory import Trajectory
from worker.ml.filters.exported.filter_act import act_of
from worker.ml.filters.exported.filter_module import FilterWeights
from worker.ml.filters.exported.shield import untried
from worker.ml.filters.fitting.filter_draft import FilterDraft, GateTrial
from worker.ml.filters.fitting.filter_problem import Collect, FilterProblem, ReportProgress
from worker.ml.filters.fitting.gate import gained, keeps_task, spread_of, to_beat, trial_of
from worker.ml.filters.fitting.response_surface import ResponseSurface
from worker.ml.policies.gaussian import GaussianPolicy
from worker.ml.reinforcement.archived_in_modes import DoubtedFirst, InModes, Lost
from worker.ml.reinforcement.refinement_gate import ArchivedDraft, gate_refined

DRIVEN_IN_MODES = 5
"""each is a drive through all of the gate's scenarios"""
SOUGHT_IN_MODES = 40
"""most of which are refused after a few of these"""
SHARE_OF_MODES = 0.7
"""of the time of choose_archived(); a guess, by which it says how far it is and nothing else"""
NEXT_BEST = 3
"""policies that are left to be tried where the best one does not pass: each is a drive through the check's scenarios"""


@dataclass(frozen=True)
class ArchivedPolicy:
    """A policy that was refined for somebody else, as it is or in a mode, and what it does in the gate's scenarios."""

    policy: GaussianPolicy
    driven: Sequence[Trajectory]
    around: ResponseSurface | None = None
    """of modes in which it is executed, beside itself; None: they were not explored, or it is in a mode already"""
    mode: Mapping[str, float] = field(default_factory=dict)
    """by the names of its axes; none: as it is"""


def best_archived(
    problem: FilterProblem,
    draft: FilterDraft,
    archived: Sequence[ArchivedPolicy],
    known: Sequence[Trajectory],
    reference: Sequence[Trajectory],
    collect: Collect,
    beaten: float | None = None,
    progress: ReportProgress = lambda stage, share: None,
) -> list[ArchivedDraft]:
    """The draft with the archived policies that the reward model likes best, the best first; none: its mode is better.

    Policies are tried in other modes, too, always the one of which most is foreseen in the mode that is best for this
    person. Every trial, and every archived mode, says more of the modes around its policy, where another may be sought;
    where more is lost than by the policy alone, another is sought more carefully, as the best of several tries is the
    luckiest, too. What has been lost before is driven first, and those that lose it, too, are driven no further. Each
    policy is returned once in its best mode that was sought, or as it is, and once in each archived one. ``known``:
    rollouts of many behaviours; ``reference``: of the frozen policy in the gate's scenarios; ``beaten``: what has to be
    gained; None: what the draft's mode gains.
    """
    least = to_beat(problem, draft, reference) if beaten is None else beaten
    found, most = list[_Found](), least
    trials = [trial_of(problem, 1.0, 0.0, reference, each.driven) for each in archived]
    for each, trial in zip(archived, trials, strict=True):
        if trial.preference > least and keeps_task(problem, trial, reference):
            weights = draft.weights.changed(refined=each.policy.weights, refined_mode=each.mode)
            found.append(_Found(trial.preference, each, ArchivedDraft(replace(draft, weights=weights), each.driven)))
            most = max(most, trial.preference)
    explored = _in_modes(problem, archived, trials, known, reference)
    drives, whole = DoubtedFirst(problem, reference, collect), 0
    for sought in range(SOUGHT_IN_MODES if explored else 0):
        share = max(whole / DRIVEN_IN_MODES, sought / SOUGHT_IN_MODES)
        progress("trying policies that were refined beforehand in modes", SHARE_OF_MODES * share)
        policy, some = max(explored, key=_foreseen)
        if some.foreseen <= most or whole == DRIVEN_IN_MODES:
            break
        mode = problem.task.modes.named(some.mode)
        weights = draft.weights.changed(refined=policy.policy.weights, refined_mode=mode)
        alone = Lost.of(problem, reference, policy.driven)
        driven = drives.drive(act_of(problem.task.modes, problem.policy, weights.changed(gate=1.0)), alone)
        if driven is None:
            some.give_up()
            continue
        whole += 1
        trial = trial_of(problem, 1.0, 0.0, reference, driven)
        is_kept = not Lost.of(problem, reference, driven).exceeds(alone) and keeps_task(problem, trial, reference)
        if trial.preference > least and is_kept:
            found.append(_Found(trial.preference, policy, ArchivedDraft(replace(draft, weights=weights), driven)))
            most = max(most, trial.preference)
        some.observe(driven, is_kept=is_kept)
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
    best = best_archived(problem, draft, archived, known, reference, collect, beaten, progress)
    if not best:
        return own.timed("archived", started)

    def checking(stage: str, share: float) -> None:
        progress(stage, SHARE_OF_MODES + (1.0 - SHARE_OF_MODES) * share)

    chosen = gate_refined(problem, draft, best, (), reference, more_reference, collect, checking, beaten)
    trials = (*own.trials, *chosen.trials)
    better = replace(chosen, seconds={**own.seconds, **chosen.seconds}) if chosen.weights.refined else own
    return replace(better, trials=trials).timed("archived", started)


def _in_modes(
    problem: FilterProblem,
    archived: Sequence[ArchivedPolicy],
    trials: Sequence[GateTrial],
    known: Sequence[Trajectory],
    reference: Sequence[Trajectory],
) -> list[tuple[ArchivedPolicy, InModes]]:
    """Those whose modes were explored."""
    if all(each.around is None for each in archived):
        return []
    wishes = problem.reward.signal_weights(known) / spread_of(problem.reward.member_returns(reference))
    explored = list[tuple[ArchivedPolicy, InModes]]()
    for each, trial in zip(archived, trials, strict=True):
        if each.around is not None:
            tried = [
                (np.array(problem.task.modes.vector(other.mode)), other.driven)
                for other in archived
                if other.mode and other.policy is each.policy
            ]
            explored.append((each, InModes(problem, each.driven, each.around, trial, wishes, reference, tried)))
    return explored


def _foreseen(some: tuple[ArchivedPolicy, InModes]) -> float:
    return some[1].foreseen
