"""Whether a refined policy takes the filter's place, and how much of it."""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import NamedTuple

from worker.domain.trajectory import Trajectory
from worker.ml.filters.exported.filter_act import act_of
from worker.ml.filters.exported.shield import limits_of
from worker.ml.filters.fitting.filter_draft import FilterDraft, GateTrial
from worker.ml.filters.fitting.filter_problem import Collect, FilterProblem, ReportProgress
from worker.ml.filters.fitting.gate import keeps_task, to_beat, trial_of, try_on

_REFINED = (
    "The filter was refined by reinforcement learning on the learned preference. It began as the execution mode that "
    "is shown, or as what was refined beforehand for people who mind one thing, and may have gone elsewhere since."
)
ARCHIVED_NOTE = (
    "The filter is a policy that was refined beforehand for people who mind one thing, maybe executed in another way "
    "that was chosen for this person."
)
_GIVEN_UP = "The refinement had made nothing better on the way and was given up."
_DOUBTED = "The answers do not say clearly enough that the refined policy is better, and it is off."
STRENGTHS = (1.0, 0.8, 0.6)
"""Blended with the reference policy."""
LARGEST_LOSS = 0.01
"""of success in the scenarios of the check. In truth two points may be lost: who loses that much passes in one of eight
cases, who loses half a point in more than nine of ten (decision 161)"""
LEAST_LIFT = 1.1
"""times what the mode gains the refined policy has to gain: a residual, which follows otherwise, often gains as much"""

SURE = 0.9
"""Chance, as the reward model's members see it, from which on it is believed to be better than the reference policy. A
refinement goes far, so it must be far from where answers say little: who wanted the robot on time lost 11 % by one that
had 8 in 10, who minds only what is beyond a limit gained 21 % by one that had 96 in 100 (decision 166)"""


class ArchivedDraft(NamedTuple):
    """A draft with a policy that was refined beforehand, and what it does in the gate's scenarios."""

    draft: FilterDraft
    driven: Sequence[Trajectory]


def begin_as(mode: FilterDraft, archived: Sequence[ArchivedDraft]) -> ArchivedDraft:
    """The best of those refined beforehand; where none is better, the mode, which has driven nothing."""
    return archived[0] if archived else ArchivedDraft(mode, ())


@dataclass(frozen=True)
class _Passing:
    """What the gate lets through, which has to pass the check yet."""

    preference: float
    draft: FilterDraft
    gate: float
    driven: Sequence[Trajectory]


def _gain(passing: _Passing) -> float:
    return passing.preference


def try_refined(
    problem: FilterProblem, draft: FilterDraft, gate: float, reference: Sequence[Trajectory], collect: Collect
) -> tuple[GateTrial, Sequence[Trajectory]]:
    """A refined draft at this strength; see try_on()."""
    act = act_of(problem.task.modes, problem.policy, draft.weights.changed(gate=gate))
    trial, driven = try_on(problem, act, gate, 0.0, reference, collect)
    return replace(trial, refined=True), driven


def gate_refined(
    problem: FilterProblem,
    mode: FilterDraft,
    archived: Sequence[ArchivedDraft],
    drafts: Sequence[FilterDraft],
    reference: Sequence[Trajectory],
    more_reference: Callable[[], Sequence[Trajectory]],
    collect: Collect,
    progress: ReportProgress = lambda stage, share: None,
    beaten: float | None = None,
) -> FilterDraft:
    """As much of a refined policy as keeps the task and is better enough than the mode, and surely so; else the mode.

    ``archived``: of best_archived(), to choose from; ``drafts``: of refine(), none where nothing was learned or that
    was given up. The whole last policy and the best archived one are tried first; if the better of them will not do,
    less of them, what had been best on the way, the archived policy in no mode and the next best archived ones are,
    too, and what gains most comes first. ``more_reference``: the frozen policy in the scenarios of the check, which
    what passes the gate is tried in, too; ``beaten``: what has to be gained; None: LEAST_LIFT times the mode's gain.
    """
    started, draft, is_doubted = time.perf_counter(), (*drafts, mode)[0], False
    before = len(draft.trials)
    already_driven, best = {id(each.draft): each.driven for each in archived}, begin_as(mode, archived).draft
    least = max(0.0, LEAST_LIFT * to_beat(problem, draft, reference) if beaten is None else beaten)
    tried_first = (*drafts[:1], *(each.draft for each in archived[:1]))
    at_first = [(each, STRENGTHS[0]) for each in tried_first]
    in_no_mode = replace(best, weights=best.weights.changed(refined_mode={}))
    later = [(in_no_mode, STRENGTHS[0])] if best.weights.refined_mode else []
    later += [(each.draft, STRENGTHS[0]) for each in archived[1:]]
    later += [(each, gate) for gate, each in product(STRENGTHS[1:], tried_first)]
    later += [(each, gate) for each, gate in product(drafts[1:], STRENGTHS)]

    def done() -> float:
        return min((len(draft.trials) - before) / (len(at_first) + len(later) + 1), 0.9)

    def passing(tries: Sequence[tuple[FilterDraft, float]]) -> list[_Passing]:
        nonlocal draft, is_doubted
        found = []
        for candidate, gate in tries:
            progress(f"checking {gate:.0%} of the refined policy on held-out scenarios", done())
            if id(candidate) in already_driven and gate == STRENGTHS[0]:
                driven = already_driven[id(candidate)]
                trial = replace(trial_of(problem, gate, 0.0, reference, driven), refined=True)
            else:
                trial, driven = try_refined(problem, candidate, gate, reference, collect)
            draft = replace(draft, trials=(*draft.trials, trial))
            if trial.preference > least and keeps_task(problem, trial, reference):
                if trial.chance is None or trial.chance >= SURE:
                    found.append(_Passing(trial.preference, candidate, gate, driven))
                else:
                    is_doubted = True
        return found

    def best_first() -> Iterator[_Passing]:
        found = passing(at_first)
        if not drafts or any(each.draft is drafts[0] for each in found):
            found.sort(key=_gain)
            yield from found[-1:]
            del found[-1:]
        yield from sorted([*found, *passing(later)], key=_gain, reverse=True)

    for each in best_first():
        progress("checking a refined policy on many more scenarios", done())
        checked, _ = try_refined(problem, each.draft, each.gate, more_reference(), collect)
        draft = replace(draft, trials=(*draft.trials, checked))
        if keeps_task(problem, checked, more_reference()) and checked.success_change >= -LARGEST_LOSS:
            weights = each.draft.weights.changed(gate=each.gate)
            tested = limits_of(problem.task.observation, problem.task.action, each.driven, reference)
            note = _REFINED if any(each.draft is learned for learned in drafts) else ARCHIVED_NOTE
            draft = replace(draft, weights=weights, tested=tested, notes=(*draft.notes, note))
            return draft.timed("gate_refined", started)
    whys = {is_doubted: _DOUBTED, not at_first: _GIVEN_UP}
    why = whys.get(True, "The refined policy was no better on held-out scenarios and is off.")
    draft = replace(draft, weights=draft.weights.changed(refined={}, refined_mode={}), notes=(*draft.notes, why))
    return draft.timed("gate_refined", started)
