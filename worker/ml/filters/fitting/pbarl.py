"""The studio's filter, stage by stage: a person's execution mode, gated, and a residual adapter around it, gated again.

A refined policy (worker.ml.reinforcement.refinement) takes the residual's place where it is better than the mode.
Every stage takes a draft and returns a better one.
"""

from collections.abc import Callable, Sequence

from worker.domain.trajectory import Trajectory
from worker.ml.filters.fitting.filter_draft import FilterDraft
from worker.ml.filters.fitting.filter_problem import Collect, FilterProblem
from worker.ml.filters.fitting.mode_search import find_mode
from worker.ml.filters.fitting.pool import Pool
from worker.ml.filters.fitting.residual import train_residual
from worker.ml.filters.fitting.residual_gate import gate_residual
from worker.ml.filters.fitting.response_surface import ResponseSurface


def fit_studio(
    problem: FilterProblem,
    surface: ResponseSurface,
    pool: Pool,
    reference: Sequence[Trajectory],
    more_reference: Callable[[], Sequence[Trajectory]],
    collect: Collect,
    refined: Callable[[FilterDraft], FilterDraft] = lambda mode: mode,
) -> FilterDraft:
    """All stages in a row, without shield.

    ``reference``, ``more_reference``: of the reference policy on the problem's gate and home scenarios; ``refined``:
    gives the draft a refined policy, if that is better than the mode; no residual is needed then.
    """
    draft = refined(find_mode(problem, surface, pool, reference, collect))
    draft = train_residual(problem, draft, collect)
    return gate_residual(problem, draft, reference, more_reference, collect)
