"""A mode that somebody or something has chosen, weakened until it keeps the task and its forces."""

from collections.abc import Sequence

from worker.domain.trajectory import Trajectory
from worker.domain.type_aliases import FloatArray
from worker.ml.filters.exported.filter_act import FilterAct, act_of
from worker.ml.filters.exported.filter_module import FilterWeights
from worker.ml.filters.fitting.filter_problem import Collect, FilterProblem
from worker.ml.filters.fitting.gate import keeps_task, try_on


def in_mode(problem: FilterProblem, mode: FloatArray, gate: float = 1.0) -> FilterAct:
    """The frozen policy in this mode (A,), at this strength."""
    return act_of(problem.task.modes, problem.policy, FilterWeights(mode=problem.task.modes.named(mode), gate=gate))


def strongest(
    problem: FilterProblem, mode: FloatArray, reference: Sequence[Trajectory], collect: Collect
) -> tuple[FilterAct, tuple[str, ...]]:
    """The mode at the largest strength that keeps success and forces in the scenarios of ``reference``; at worst 0.

    The gate of the studio's own filter without its question whether the learned return rises: who chooses modes
    directly has no reward model.
    """
    named = ", ".join(f"{axis} {value:+.2f}" for axis, value in problem.task.modes.named(mode).items())
    for gate in (1.0, *problem.config.gates):
        act = in_mode(problem, mode, gate)
        trial, _ = try_on(problem, act, gate, 0.0, reference, collect)
        if keeps_task(problem, trial, reference):
            return act, (f"Mode: {named}; gate {gate:g}.",)
    return in_mode(problem, mode, 0.0), (f"Mode: {named}, which loses the task at every strength; gate 0.",)
