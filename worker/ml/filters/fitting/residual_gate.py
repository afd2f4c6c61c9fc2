"""How much of a residual is kept: the most that is better than the mode, keeps the task, and presses nobody harder."""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain

from worker.domain.trajectory import Trajectory
from worker.ml.filters.exported.filter_act import act_of
from worker.ml.filters.exported.shield import limits_of
from worker.ml.filters.fitting.filter_draft import FilterDraft, GateTrial
from worker.ml.filters.fitting.filter_problem import Collect, FilterProblem, ReportProgress
from worker.ml.filters.fitting.gate import (
    DOUBTED,
    keeps_task,
    keeps_task_in_all,
    largest_force_n,
    loses_nothing,
    to_beat,
    trial_of,
)

LESS = 2 / 3
"""of a share that loses too much in other scenarios is what is tried there next, or less"""
USUAL_TRIALS = 6
"""of shares; a guess, by which the gate says how far it is and nothing else"""
LOOK = 40
"""of the other scenarios, after which it is asked whether it is clear yet that a share keeps the task"""
CLEAR = 2.0
"""scenarios more or less lost than are accepted of as many: then it mostly stays so to the end (decision 191)"""


def gate_residual(
    problem: FilterProblem,
    draft: FilterDraft,
    reference: Sequence[Trajectory],
    more_reference: Callable[[], Sequence[Trajectory]],
    collect: Collect,
    progress: ReportProgress = lambda stage, share: None,
) -> FilterDraft:
    """Keep as much of the residual as keeps the task and is best by the learned return; possibly none.

    It is held back by its distance from the mode, so for some people more than the whole of it is better still. Of many
    that are tried in the same scenarios somebody's is lucky there: what loses anything is driven through others, too.
    ``more_reference``: of the frozen policy in these.
    """
    if not draft.weights.encoder:
        return draft
    started = time.perf_counter()
    gate = _ResidualGate(problem, draft, reference, more_reference, collect, progress)
    kept = gate.kept()
    weights = draft.weights.changed(residual_share=kept.share if kept else 0.0)
    notes, tested = draft.notes, draft.tested
    if kept:
        tested = limits_of(problem.task.observation, problem.task.action, kept.driven, reference)
    else:
        notes = (*notes, "The residual did not help on held-out scenarios and is off.")
    draft = replace(draft, weights=weights, trials=(*draft.trials, *gate.trials), notes=notes, tested=tested)
    return draft.timed("gate_residual", started)


@dataclass(frozen=True)
class _Tried:
    """What came of so much of a residual in the gate's scenarios."""

    share: float
    trial: GateTrial
    driven: Sequence[Trajectory]


class _ResidualGate:
    """The trials of one residual."""

    def __init__(
        self,
        problem: FilterProblem,
        draft: FilterDraft,
        reference: Sequence[Trajectory],
        more_reference: Callable[[], Sequence[Trajectory]],
        collect: Collect,
        progress: ReportProgress,
    ) -> None:
        self.problem, self.draft = problem, draft
        self.reference, self.more_reference = reference, more_reference
        self.collect, self.progress = collect, progress
        self.trials: list[GateTrial] = []

    def kept(self) -> _Tried | None:
        """The most of it that may be kept; None: nothing."""
        alone = to_beat(self.problem, self.draft, self.reference)
        climbed = self._climbed(alone)
        candidates = chain(_ever_less(climbed), self._parts(alone))
        return next((each for each in candidates if self._surely_keeps_task(each)), None)

    def _climbed(self, alone: float) -> list[_Tried]:
        """The whole and more of it, as long as each is better than the last and may keep the task."""
        config, found = self.problem.config, list[_Tried]()
        for share in (1.0, *config.residual_beyond):
            tried = self._try(share)
            gentle = share <= config.residual_gentle or largest_force_n(tried.driven) <= largest_force_n(self.reference)
            if not (gentle and self._is_promising(tried, found[-1].trial.preference if found else alone)):
                break
            found.append(tried)
        return found

    def _parts(self, alone: float) -> Iterator[_Tried]:
        for share in self.problem.config.residual_parts:
            tried = self._try(share)
            if self._is_promising(tried, alone):
                yield tried

    def _is_promising(self, tried: _Tried, to_beat: float) -> bool:
        return tried.trial.preference > to_beat and keeps_task(self.problem, tried.trial, self.reference, DOUBTED)

    def _surely_keeps_task(self, tried: _Tried) -> bool:
        """Whether it loses nothing in the gate's scenarios, or little enough in these and others together."""
        if loses_nothing(tried.trial):
            return True
        others, driven, keeps = self.more_reference(), list[Trajectory](), None
        while keeps is None:
            driven += self._driven(tried.share, others[len(driven) : len(driven) + LOOK])
            beside = others[: len(driven)]
            within = CLEAR if len(driven) < len(others) else 0.0
            keeps = keeps_task_in_all(self.problem, [*self.reference, *beside], [*tried.driven, *driven], within)
        self._noted(tried.share, beside, driven)
        return keeps

    def _try(self, share: float) -> _Tried:
        driven = self._driven(share, self.reference)
        return _Tried(share, self._noted(share, self.reference, driven), driven)

    def _driven(self, share: float, beside: Sequence[Trajectory]) -> Sequence[Trajectory]:
        done = min(len(self.trials) / USUAL_TRIALS, 0.9)
        self.progress(f"checking {share:.0%} of the residual on held-out scenarios", done)
        weights = self.draft.weights.changed(residual_share=share)
        act = act_of(self.problem.task.modes, self.problem.policy, weights)
        return self.collect(act, [each.scenario for each in beside], 0.0, self.problem.seed)

    def _noted(self, share: float, beside: Sequence[Trajectory], driven: Sequence[Trajectory]) -> GateTrial:
        self.trials.append(trial_of(self.problem, self.draft.weights.gate, share, beside, driven))
        return self.trials[-1]


def _ever_less(climbed: Sequence[_Tried]) -> Iterator[_Tried]:
    """The strongest first, each at most LESS of the one before: of what loses too much, a little less does, too."""
    last = float("inf")
    for each in reversed(climbed):
        if each.share <= LESS * last:
            yield each
            last = each.share
