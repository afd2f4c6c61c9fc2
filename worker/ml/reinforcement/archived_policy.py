"""Policies refined beforehand, for people who mind one signal especially: what somebody's refinement may begin as.

One search finds what another misses. A refinement that begins as its person's mode stays where that leads; begun as the
best policy that was found for anybody, by the person's own learned reward, it goes on from there (decision 192).
Choosing among policies by what each has earned in the same scenarios is generalised policy improvement over whole
policies (Barreto et al. 2017, arXiv 1606.05312).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from worker.domain.trajectory import Trajectory
from worker.ml.filters.fitting.filter_draft import FilterDraft
from worker.ml.filters.fitting.filter_problem import FilterProblem
from worker.ml.filters.fitting.gate import keeps_task, to_beat, trial_of
from worker.ml.policies.gaussian import GaussianPolicy


@dataclass(frozen=True)
class ArchivedPolicy:
    """A policy that was refined for somebody else, and what it does in the gate's scenarios."""

    policy: GaussianPolicy
    driven: Sequence[Trajectory]


def best_beginning(
    problem: FilterProblem,
    draft: FilterDraft,
    archived: Sequence[ArchivedPolicy],
    reference: Sequence[Trajectory],
) -> tuple[FilterDraft, Sequence[Trajectory]]:
    """The draft with the archived policy that the reward model likes best, or as it is where its mode is better yet.

    Also what that policy does in the gate's scenarios, nothing where it is the mode. ``reference``: of the frozen
    policy there.
    """
    best, most = draft, to_beat(problem, draft, reference)
    driven: Sequence[Trajectory] = []
    for each in archived:
        trial = trial_of(problem, 1.0, 0.0, reference, each.driven)
        if trial.preference > most and keeps_task(problem, trial, reference):
            best = replace(draft, weights=draft.weights.changed(refined=each.policy.weights))
            driven, most = each.driven, trial.preference
    return best, driven
