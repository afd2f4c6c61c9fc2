"""A filter in a minute, for somebody who still answers: an archived policy, or a mode where more is foreseen.

What an archived policy does, as it is and in archived modes, is the same for everybody and known, success included, so
that nothing has to be driven to choose among them for one person. Their last filter is sought longer: with a residual,
and with archived policies in modes of the person's own.
"""

import time
from collections.abc import Sequence
from dataclasses import replace

from worker.domain.trajectory import Trajectory
from worker.ml.filters.exported.filter_module import FilterWeights
from worker.ml.filters.exported.shield import limits_of, untried
from worker.ml.filters.fitting.filter_draft import FilterDraft, GateTrial
from worker.ml.filters.fitting.filter_problem import Collect, FilterProblem, ReportProgress
from worker.ml.filters.fitting.gate import acceptable, to_beat, trial_of
from worker.ml.filters.fitting.mode_search import find_mode_quickly
from worker.ml.filters.fitting.pool import Pool
from worker.ml.filters.fitting.response_surface import ResponseSurface
from worker.ml.reinforcement.archived_policy import ArchivedPolicy
from worker.ml.reinforcement.refinement_gate import ARCHIVED_NOTE, SURE

_ON_THE_WAY = "This filter was found quickly, on the way; the one that follows all answers is sought longer."


def quick_filter(
    problem: FilterProblem,
    surface: ResponseSurface,
    pool: Pool,
    archived: Sequence[ArchivedPolicy],
    reference: Sequence[Trajectory],
    collect: Collect,
    progress: ReportProgress = lambda stage, share: None,
) -> FilterDraft:
    """The archived policy that is best for a person or the first acceptable mode, whichever gains more.

    ``reference``: rollouts of the frozen policy in the gate's scenarios, where archived policies were driven, too.
    Modes are driven only where the response surface foresees more of one than the best archived policy gains.
    """
    started = time.perf_counter()
    best = _best_archived(problem, archived, reference)
    least = best[1].preference if best else 0.0
    own = find_mode_quickly(problem, surface, pool, reference, collect, least, progress)
    if best and to_beat(problem, own, reference) < least:
        policy, trial = best
        shield = untried(problem.task.observation, problem.policy.action_size, reference)
        weights = FilterWeights(refined=policy.policy.weights, refined_mode=policy.mode, shield=shield)
        tested = limits_of(problem.task.observation, problem.task.action, policy.driven, reference)
        own = FilterDraft(weights, trials=(*own.trials, trial), notes=(ARCHIVED_NOTE,), tested=tested)
    return replace(own, notes=(*own.notes, _ON_THE_WAY)).timed("quick", started)


def _best_archived(
    problem: FilterProblem, archived: Sequence[ArchivedPolicy], reference: Sequence[Trajectory]
) -> tuple[ArchivedPolicy, GateTrial] | None:
    """Of those that keep the task and are surely better than the reference policy; None: there is none."""
    kept = list[tuple[ArchivedPolicy, GateTrial]]()
    for each in archived:
        trial = replace(trial_of(problem, 1.0, 0.0, reference, each.driven), refined=True)
        if acceptable(problem, trial, reference) and (trial.chance or 0.0) >= SURE:
            kept.append((each, trial))
    return max(kept, key=lambda each: each[1].preference, default=None)
