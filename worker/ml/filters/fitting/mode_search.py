"""The first stage of the studio's filter: a person's execution mode, from the response surface and a few trials."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from worker.domain.trajectory import Trajectory
from worker.domain.type_aliases import FloatArray
from worker.ml.filters.exported.filter_act import act_of
from worker.ml.filters.exported.filter_module import FilterWeights
from worker.ml.filters.exported.shield import limits_of, untried
from worker.ml.filters.fitting.filter_draft import FilterDraft, GateTrial
from worker.ml.filters.fitting.filter_problem import Collect, FilterProblem, ReportProgress
from worker.ml.filters.fitting.further_surface import FurtherSurface
from worker.ml.filters.fitting.gate import acceptable, largest_forces, signal_changes, spread_of, successes, try_on
from worker.ml.filters.fitting.mode_archive import tail_growth_n
from worker.ml.filters.fitting.pool import Pool
from worker.ml.filters.fitting.response_surface import CAUTION, ResponseSurface, best_mode
from worker.ml.rewards.beyond_sums.terms import RicherReward
from worker.ml.rewards.reward_models import StructuredReward

CORRECTED_ATTEMPTS = 2
"""with the surface that an archive corrects, the second more careful about success"""

_UNCLEAR = "The labels do not yet say clearly what to change; the mode is off."
_UNKEPT = "No mode was better while keeping the task and the forces; the mode is off."
_NO_BETTER = "Of no mode more was foreseen; it is off."


def find_mode(
    problem: FilterProblem,
    surface: ResponseSurface,
    pool: Pool,
    reference: Sequence[Trajectory],
    collect: Collect,
    progress: ReportProgress = lambda stage, share: None,
) -> FilterDraft:
    """The mode with the best learned return of those tried that keep the task and its forces.

    The best predicted mode lies where the surface knows least, and is the one whose success and return are most likely
    overestimated. It is therefore tried on the held-out scenarios of ``reference``, the surface learns from the trial,
    and the search goes on from there, more careful about success with every trial that was not acceptable. What is
    foreseen to press harder than the study allows, by an archive and by the trials before, is not tried (decision 190).
    When no attempt is acceptable the last mode is weakened; at worst it is off. Where the surface has an archive, the
    best of that is tried, too, and the best by what it corrects of the surface (decisions 187 and 188).
    ``pool``: rollouts of many modes, used only when the reward is not linear in the signals. Of a reward with further
    terms they say what modes do to these, and more modes are tried, all of them to choose from (decision 185).
    """
    started = time.perf_counter()
    search = _ModeSearch(problem, surface, pool, reference, collect, progress)
    search.by_surface()
    if not search.tried:
        return search.without_mode(_UNCLEAR).timed("mode", started)
    sought = search.tried[-1].mode
    search.by_archive()
    return search.best_or_weakened(sought).timed("mode", started)


def find_mode_quickly(
    problem: FilterProblem,
    surface: ResponseSurface,
    pool: Pool,
    reference: Sequence[Trajectory],
    collect: Collect,
    least: float,
    progress: ReportProgress = lambda stage, share: None,
) -> FilterDraft:
    """The first mode that is acceptable; none is tried where no more than ``least`` is foreseen of the best.

    ``least``: of the change of the learned return, as in GateTrial. See find_mode() for the rest.
    """
    started = time.perf_counter()
    search = _ModeSearch(problem, surface, pool, reference, collect, progress)
    if search.foreseen <= least:
        return search.without_mode(_NO_BETTER).timed("mode", started)
    search.corrected()
    if not search.tried:
        return search.without_mode(_UNCLEAR).timed("mode", started)
    return search.best_or_weakened(search.tried[-1].mode).timed("mode", started)


@dataclass(frozen=True, eq=False)
class _Tried:
    """What came of a mode in the gate's scenarios."""

    mode: FloatArray
    """(A,)"""
    trial: GateTrial
    driven: Sequence[Trajectory]


class _ModeSearch:
    """The trials of one person's modes."""

    def __init__(
        self,
        problem: FilterProblem,
        surface: ResponseSurface,
        pool: Pool,
        reference: Sequence[Trajectory],
        collect: Collect,
        progress: ReportProgress,
    ) -> None:
        self.problem, self.reference, self.collect, self.progress = problem, reference, collect, progress
        self.archive, self.surface = surface.archive, replace(surface, archive=None)
        self.forces = surface.forces
        self.wishes = problem.reward.signal_weights(pool.rollouts)
        self.further = _further(problem, self.wishes, pool)
        self.off = FilterWeights(shield=untried(problem.task.observation, problem.policy.action_size, reference))
        config = problem.config
        by_surface = config.mode_attempts_beyond_sums if self.further else config.mode_attempts
        self.attempts = by_surface + 1 + CORRECTED_ATTEMPTS
        """at most, before the last is weakened"""
        self.tried: list[_Tried] = []
        self.accepted: list[_Tried] = []

    def by_surface(self) -> None:
        """Try what the surface says is best, which learns from every trial."""
        config = self.problem.config
        attempts = config.mode_attempts_beyond_sums if self.further else config.mode_attempts
        enough = attempts if self.further else config.modes_to_choose_from
        for _ in range(attempts):
            if len(self.accepted) == enough:
                return
            self._say("searching the person's way of doing the task")
            mode = self._best_by(self.surface, rejected=len(self.tried) - len(self.accepted))
            if not self._is_new(mode):
                return
            driven = self._try(mode).driven
            changes = signal_changes(self.reference, driven)
            self.surface = self.surface.with_observed(mode, changes, successes(driven))
            self.further = self.further and self.further.with_observed(mode, self.reference, driven)

    def by_archive(self) -> None:
        """Try the best of the archive, and what is best by the surface that it corrects."""
        if not self.archive:
            return
        best = self.archive.best(self.wishes, self.problem.config.pressed_n)
        if best is not None and self._is_new(best):
            self._try(best)
        self.corrected()

    @property
    def foreseen(self) -> float:
        """What the best mode changes of the learned return, as in GateTrial; infinite where signals do not say it."""
        if self.further:
            return np.inf
        surface = replace(self.surface, archive=self.archive)
        changes, _ = surface.predict(self._best_by(surface, 0))
        return float(changes @ self.wishes.mean(axis=0)) / spread_of(self.problem.reward.member_returns(self.reference))

    def corrected(self) -> None:
        """Try what is best by the surface that the archive corrects, where there is one."""
        surface = replace(self.surface, archive=self.archive)
        for rejected in range(CORRECTED_ATTEMPTS):
            mode = self._best_by(surface, rejected)
            if self._is_new(mode) and self._try(mode) in self.accepted:
                return

    def best_or_weakened(self, sought: FloatArray) -> FilterDraft:
        """The best acceptable mode; where none was, as much of ``sought`` as is; at worst none."""
        if not self.accepted:
            self._weakened(sought)
        return self._with_best_mode() if self.accepted else self.without_mode(_UNKEPT)

    def _weakened(self, mode: FloatArray) -> None:
        """Try less and less of a mode that was not acceptable."""
        for gate in self.problem.config.gates:
            if self._try(mode, gate) in self.accepted:
                return

    def _with_best_mode(self) -> FilterDraft:
        """The mode that is best by the learned return among those that were acceptable."""
        best = max(self.accepted, key=lambda each: each.trial.preference)
        trials = (*(each.trial for each in self.tried if each is not best), best.trial)
        task = self.problem.task
        weights = self.off.changed(mode=task.modes.named(best.mode), gate=best.trial.gate)
        return FilterDraft(
            weights, trials=trials, tested=limits_of(task.observation, task.action, best.driven, self.reference)
        )

    def without_mode(self, note: str) -> FilterDraft:
        """The reference policy, and why."""
        return FilterDraft(self.off, trials=tuple(each.trial for each in self.tried), notes=(note,))

    def _best_by(self, surface: ResponseSurface, rejected: int) -> FloatArray:
        return best_mode(
            surface,
            self.wishes,
            self.problem.seed,
            caution=caution_of(self.problem),
            success_caution=self.problem.config.success_caution * (1 + rejected),
            forces=self.forces,
            most_growth_n=self.problem.config.pressed_n,
            further=self.further.coefficients if self.further else None,
        )

    def _say(self, stage: str) -> None:
        self.progress(stage, min(len(self.tried) / self.attempts, 0.9))

    def _is_new(self, mode: FloatArray) -> bool:
        return bool(mode.any()) and not any(np.array_equal(mode, each.mode) for each in self.tried)

    def _try(self, mode: FloatArray, gate: float = 1.0) -> _Tried:
        some = "the mode" if gate < 1.0 else f"mode {len(self.tried) + 1}"
        self._say(f"checking {some} at {gate:.0%} on held-out scenarios")
        modes = self.problem.task.modes
        weights = self.off.changed(mode=modes.named(mode), gate=gate)
        act = act_of(modes, self.problem.policy, weights)
        tried = _Tried(mode, *try_on(self.problem, act, gate, 0.0, self.reference, self.collect))
        self.tried.append(tried)
        if gate == 1.0:
            growth_n = tail_growth_n(largest_forces(tried.driven) - largest_forces(self.reference))
            self.forces = self.forces.with_observed(mode, float(growth_n))
        if acceptable(self.problem, tried.trial, self.reference):
            self.accepted.append(tried)
        return tried


def _further(problem: FilterProblem, wishes: FloatArray, pool: Pool) -> FurtherSurface | None:
    """What modes do beyond sums of signals; None: the person's reward has nothing of the kind."""
    if not isinstance(problem.reward, RicherReward):
        return None
    return FurtherSurface.of_pool(problem.reward, wishes.mean(axis=0), pool, problem.task.modes)


def caution_of(problem: FilterProblem) -> float:
    """About what members disagree on: only where the reward model's prior has nobody whom the person may be like."""
    knows_people = isinstance(problem.reward, StructuredReward) and not problem.task.is_a_labs
    return 0.0 if knows_people else CAUTION
