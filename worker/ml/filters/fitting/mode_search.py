"""The first stage of the studio's filter: a person's execution mode, from the response surface and a few trials."""

import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from worker.domain.trajectory import Trajectory
from worker.domain.type_aliases import FloatArray
from worker.ml.filters.exported.filter_act import FilterAct, act_of
from worker.ml.filters.exported.filter_module import FilterWeights
from worker.ml.filters.exported.shield import limits_of, untried
from worker.ml.filters.fitting.filter_draft import FilterDraft, GateTrial
from worker.ml.filters.fitting.filter_problem import Collect, FilterProblem, ReportProgress
from worker.ml.filters.fitting.further_surface import FurtherSurface
from worker.ml.filters.fitting.gate import acceptable, signal_changes, successes, try_on
from worker.ml.filters.fitting.pool import Pool
from worker.ml.filters.fitting.response_surface import CAUTION, ResponseSurface, best_mode
from worker.ml.rewards.beyond_sums.terms import RicherReward
from worker.ml.rewards.reward_models import StructuredReward


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
    and the search goes on from there, more careful about success with every trial that was not acceptable. When no
    attempt is acceptable the last mode is weakened; at worst it is off. Where the surface has an archive, the best of
    that is tried, too, and the best by what it corrects of the surface (decisions 187 and 188).
    ``pool``: rollouts of many modes, used only when the reward is not linear in the signals. Of a reward with further
    terms they say what modes do to these, and more modes are tried, all of them to choose from (decision 185).
    """
    started = time.perf_counter()
    wishes = problem.reward.signal_weights(pool.rollouts)
    further = _further(problem, wishes, pool)
    archive, surface = surface.archive, replace(surface, archive=None)
    attempts, enough = problem.config.mode_attempts, problem.config.modes_to_choose_from
    if further:
        attempts = enough = problem.config.mode_attempts_beyond_sums
    off = FilterWeights(shield=untried(problem.task.observation, problem.policy.action_size, reference))
    tried: list[tuple[GateTrial, FloatArray]] = []
    accepted: list[tuple[GateTrial, FloatArray, Sequence[Trajectory]]] = []

    def sought_in(surface: ResponseSurface) -> FloatArray:
        rejected = len(tried) - len(accepted)
        return best_mode(
            surface,
            wishes,
            problem.seed,
            caution=_caution(problem),
            success_caution=problem.config.success_caution * (1 + rejected),
            further=further.coefficients if further else None,
        )

    def is_new(mode: FloatArray) -> bool:
        return bool(mode.any()) and not any(np.array_equal(mode, earlier) for _, earlier in tried)

    def driven_in(mode: FloatArray) -> Sequence[Trajectory]:
        trial, driven = try_on(problem, _act_in(problem, off, mode), 1.0, 0.0, reference, collect)
        tried.append((trial, mode))
        if acceptable(problem, trial, reference):
            accepted.append((trial, mode, driven))
        return driven

    for attempt in range(attempts):
        if len(accepted) == enough:
            break
        progress("searching the person's way of doing the task", 0.3 * attempt / attempts)
        mode = sought_in(surface)
        if not is_new(mode):
            break
        progress(f"checking mode {attempt + 1} on held-out scenarios", 0.03 + 0.3 * attempt / attempts)
        driven = driven_in(mode)
        surface = surface.with_observed(mode, signal_changes(reference, driven), successes(driven))
        further = further.with_observed(mode, reference, driven) if further else None
    if not tried:
        return _without_mode(off, "The labels do not yet say clearly what to change; the mode is off.", [], started)
    sought = tried[-1][1]
    if archive:
        progress("checking what an archive of modes says on held-out scenarios", 0.31)
        for archived in (archive.best(wishes), sought_in(replace(surface, archive=archive))):
            if archived is not None and is_new(archived):
                driven_in(archived)
    for gate in problem.config.gates if not accepted else ():
        progress(f"checking the mode at {gate:.0%} on held-out scenarios", 0.32)
        act = _act_in(problem, off.changed(gate=gate), sought)
        weakened, driven = try_on(problem, act, gate, 0.0, reference, collect)
        tried.append((weakened, sought))
        if acceptable(problem, weakened, reference):
            accepted = [(*tried[-1], driven)]
            break
    trials = [trial for trial, _ in tried]
    if not accepted:
        note = "No mode was better while keeping the task and the forces; the mode is off."
        return _without_mode(off, note, trials, started)
    chosen, mode, driven = max(accepted, key=lambda each: each[0].preference)
    weights = off.changed(mode=problem.task.modes.named(mode), gate=chosen.gate)
    ordered = (*(trial for trial in trials if trial is not chosen), chosen)
    tested = limits_of(problem.task.observation, problem.task.action, driven, reference)
    return FilterDraft(weights, trials=ordered, tested=tested).timed("mode", started)


def _further(problem: FilterProblem, wishes: FloatArray, pool: Pool) -> FurtherSurface | None:
    """What modes do beyond sums of signals; None: the person's reward has nothing of the kind."""
    if not isinstance(problem.reward, RicherReward):
        return None
    return FurtherSurface.of_pool(problem.reward, wishes.mean(axis=0), pool, problem.task.modes)


def _caution(problem: FilterProblem) -> float:
    """About what members disagree on: only where the reward model's prior has nobody whom the person may be like."""
    knows_people = isinstance(problem.reward, StructuredReward) and not problem.task.is_a_labs
    return 0.0 if knows_people else CAUTION


def _act_in(problem: FilterProblem, weights: FilterWeights, mode: FloatArray) -> FilterAct:
    named = problem.task.modes.named(mode)
    return act_of(problem.task.modes, problem.policy, weights.changed(mode=named))


def _without_mode(off: FilterWeights, note: str, trials: Sequence[GateTrial], started: float) -> FilterDraft:
    return FilterDraft(off, trials=tuple(trials), notes=(note,)).timed("mode", started)
