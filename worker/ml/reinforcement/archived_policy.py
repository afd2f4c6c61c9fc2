"""Policies refined beforehand, for people who mind one signal especially: what somebody's refinement may begin as.

One search finds what another misses. A refinement that begins as its person's mode stays where that leads; begun as the
best policy that was found for anybody, by the person's own learned reward, it goes on from there (decision 192).
Choosing among policies by what each has earned in the same scenarios is generalised policy improvement over whole
policies (Barreto et al. 2017, arXiv 1606.05312). Each may be executed in a mode of the person's own, which a response
surface around that policy foresees (decision 197).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from worker.domain.trajectory import Trajectory
from worker.ml.filters.exported.filter_module import FilterWeights
from worker.ml.filters.fitting.filter_draft import FilterDraft
from worker.ml.filters.fitting.filter_problem import Collect, FilterProblem
from worker.ml.filters.fitting.gate import keeps_task, spread_of, to_beat, trial_of
from worker.ml.filters.fitting.mode_search import caution_of
from worker.ml.filters.fitting.response_surface import ResponseSurface, best_mode
from worker.ml.policies.gaussian import GaussianPolicy
from worker.ml.reinforcement.refinement_gate import try_refined

TRIED_IN_MODES = 3
"""policies, those with which most is foreseen: each is a drive through the gate's scenarios"""


@dataclass(frozen=True)
class ArchivedPolicy:
    """A policy that was refined for somebody else, and what it does in the gate's scenarios."""

    policy: GaussianPolicy
    driven: Sequence[Trajectory]
    around: ResponseSurface | None = None
    """of modes in which it is executed, beside itself; None: they were not explored"""


@dataclass(frozen=True)
class _Foreseen:
    """An archived policy in the mode that is best for somebody."""

    preference: float
    weights: FilterWeights


def best_beginning(
    problem: FilterProblem,
    draft: FilterDraft,
    archived: Sequence[ArchivedPolicy],
    known: Sequence[Trajectory],
    reference: Sequence[Trajectory],
    collect: Collect,
) -> tuple[FilterDraft, Sequence[Trajectory]]:
    """The draft with the archived policy that the reward model likes best, or as it is where its mode is better yet.

    Those with which most is foreseen are tried in the modes that are best for this person, too. Also returns what the
    policy does in the gate's scenarios, nothing where it is the mode. ``known``: rollouts of many behaviours;
    ``reference``: of the frozen policy in the gate's scenarios.
    """
    best, most = draft, to_beat(problem, draft, reference)
    driven: Sequence[Trajectory] = []
    trials = [trial_of(problem, 1.0, 0.0, reference, each.driven) for each in archived]
    for each, trial in zip(archived, trials, strict=True):
        if trial.preference > most and keeps_task(problem, trial, reference):
            best = replace(draft, weights=draft.weights.changed(refined=each.policy.weights))
            driven, most = each.driven, trial.preference
    foreseen = [
        _in_best_mode(problem, draft, each.policy, each.around, trial.preference, known, reference)
        for each, trial in zip(archived, trials, strict=True)
        if each.around is not None
    ]
    for some in sorted(foreseen, key=_preference, reverse=True)[:TRIED_IN_MODES]:
        if some.preference > most:
            candidate = replace(draft, weights=some.weights)
            trial, tried = try_refined(problem, candidate, 1.0, reference, collect)
            if trial.preference > most and keeps_task(problem, trial, reference):
                best, driven, most = candidate, tried, trial.preference
    return best, driven


def _preference(foreseen: _Foreseen) -> float:
    return foreseen.preference


def _in_best_mode(
    problem: FilterProblem,
    draft: FilterDraft,
    policy: GaussianPolicy,
    around: ResponseSurface,
    alone: float,
    known: Sequence[Trajectory],
    reference: Sequence[Trajectory],
) -> _Foreseen:
    """``alone``: preference of the trial of the policy as it is."""
    wishes, unit = problem.reward.signal_weights(known), spread_of(problem.reward.member_returns(reference))
    caution, success_caution = caution_of(problem), problem.config.success_caution
    mode = best_mode(around, wishes, problem.seed, caution=caution, success_caution=success_caution)
    changes, _ = around.predict(mode)
    weights = draft.weights.changed(refined=policy.weights, refined_mode=problem.task.modes.named(mode))
    return _Foreseen(alone + float(changes @ wishes.mean(axis=0)) / unit, weights)
