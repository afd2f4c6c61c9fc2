"""Trying a filter on held-out scenarios, and what makes it acceptable: better for the person, task and forces kept."""

from collections.abc import Sequence
from statistics import NormalDist

import numpy as np
import numpy.typing as npt

from worker.domain.trajectory import Trajectory
from worker.domain.type_aliases import Act, FloatArray
from worker.ml.filters.fitting.filter_draft import FilterDraft, GateTrial
from worker.ml.filters.fitting.filter_problem import Collect, FilterProblem

DOUBTED = 2.0
"""times the tolerances: who loses no more in the gate's scenarios is tried in others, if anything is lost at all"""
PRIOR = 4.0
"""scenarios in which only one of two policies fails, two of them either, that are imagined before any was driven"""


def try_on(
    problem: FilterProblem,
    act: Act,
    gate: float,
    residual_share: float,
    reference: Sequence[Trajectory],
    collect: Collect,
) -> tuple[GateTrial, Sequence[Trajectory]]:
    """What came of it in the scenarios of ``reference``, and the rollouts."""
    scenarios = [each.scenario for each in reference]
    filtered = collect(act, scenarios, 0.0, problem.seed)
    return trial_of(problem, gate, residual_share, reference, filtered), filtered


def trial_of(
    problem: FilterProblem,
    gate: float,
    residual_share: float,
    reference: Sequence[Trajectory],
    filtered: Sequence[Trajectory],
) -> GateTrial:
    """What rollouts say, beside the reference policy's of the same scenarios."""
    before, after = (problem.reward.member_returns(driven) for driven in (reference, filtered))
    outcomes = successes(filtered) - successes(reference)
    gains = np.average(after - before, axis=1, weights=_weights(outcomes))
    unit = spread_of(before)
    success = float(outcomes.mean())
    pressed = float(pressed_in(problem, reference, filtered).mean())
    return GateTrial(
        gate,
        residual_share,
        float(gains.mean()) / unit,
        success,
        _p95_force_n(filtered),
        chance=chance_of_gain(gains),
        pressed=pressed,
    )


def spread_of(returns: FloatArray) -> float:
    """Standard deviation over scenarios of the members' mean of learned returns (E, N): what gains are counted in."""
    return max(float(returns.mean(axis=0).std()), 1e-9)


def _weights(outcomes: FloatArray) -> FloatArray:
    """(N,) changes of success, each -1, 0 or 1 -> what each scenario counts for in the change of the return, (N,).

    An undone task earns nothing, so that one failure in 80 scenarios, which is mostly chance, costs what a residual
    earns in twenty of the others. The n scenarios in which only one of two policies fails count n / (n + PRIOR), for
    before any was driven either was as likely to be that one, Beta(PRIOR / 2, PRIOR / 2). How much success may be lost
    is another question: see keeps_task().
    """
    changed = outcomes != 0.0
    n = changed.sum()
    return np.where(changed, n / (n + PRIOR), 1.0)


def chance_of_gain(gains: FloatArray) -> float:
    """That the mean gain is above 0, taking those of the reward model's members, (E,), for draws of a normal posterior.

    Of the scenarios at hand. How far they are like others is not in it: that is what trials in many of them are for.
    """
    deviation = float(gains.std())
    return NormalDist().cdf(float(gains.mean()) / deviation) if deviation else float(gains.mean() > 0.0)


def signal_changes(reference: Sequence[Trajectory], filtered: Sequence[Trajectory]) -> FloatArray:
    """(N, S) of the summed signals, scenario by scenario."""
    pairs = zip(reference, filtered, strict=True)
    return np.array(
        [after.signals.sum(axis=0, dtype=np.float64) - before.signals.sum(axis=0) for before, after in pairs]
    )


def successes(trajectories: Sequence[Trajectory]) -> FloatArray:
    """(N,) in {0, 1}"""
    return np.array([float(each.success) for each in trajectories])


def acceptable(problem: FilterProblem, trial: GateTrial, reference: Sequence[Trajectory]) -> bool:
    """Whether it raises the learned return and keeps the task and the forces within the tolerances."""
    return trial.preference > 0.0 and keeps_task(problem, trial, reference)


def keeps_task(
    problem: FilterProblem, trial: GateTrial, reference: Sequence[Trajectory], of_tolerance: float = 1.0
) -> bool:
    """Whether success and forces stay within the tolerances, those of shares of episodes so many times as wide."""
    config = problem.config
    succeeds = trial.success_change >= -of_tolerance * config.success_tolerance
    presses = trial.pressed > of_tolerance * config.pressed_tolerance
    return succeeds and not presses and _is_gentle(problem, trial.p95_force_n, reference)


def loses_nothing(trial: GateTrial) -> bool:
    """Whether as many succeed as under the reference policy, and nobody is pressed much harder."""
    return trial.success_change >= 0.0 and trial.pressed == 0.0


def keeps_task_in_all(
    problem: FilterProblem, reference: Sequence[Trajectory], filtered: Sequence[Trajectory], within: float = 0.0
) -> bool | None:
    """Whether no more is lost than the tolerance of all these scenarios together, and forces stay within theirs.

    None: not clear yet, as fewer than ``within`` scenarios would change that, or forces alone are against it.
    """
    failed = float((successes(reference) - successes(filtered)).sum())
    lost = max(failed, float(pressed_in(problem, reference, filtered).sum()))
    spare = problem.config.tolerance_in_all * len(reference) - lost
    gentle = _is_gentle(problem, _p95_force_n(filtered), reference)
    if abs(spare) < within or (within and spare > 0.0 and not gentle):
        return None
    return spare >= 0.0 and gentle


def _is_gentle(problem: FilterProblem, p95_force_n: float, reference: Sequence[Trajectory]) -> bool:
    """Whether almost all episodes stay below the largest accepted force, or below the reference policy's."""
    return p95_force_n <= max(problem.config.force_limit_n, _p95_force_n(reference))


def to_beat(problem: FilterProblem, draft: FilterDraft, reference: Sequence[Trajectory]) -> float:
    """The change of the learned return that the draft's mode has made on its own; 0 where it is off."""
    alone = (each for each in reversed(draft.trials) if not each.refined and each.residual_share == 0.0)
    trial = next(alone, None)
    return trial.preference if trial and acceptable(problem, trial, reference) else 0.0


def gained(problem: FilterProblem, draft: FilterDraft, reference: Sequence[Trajectory]) -> float:
    """The change of the learned return that the draft's mode and residual have made in the gate's scenarios."""
    share = draft.weights.residual_share
    if not (draft.weights.encoder and share):
        return to_beat(problem, draft, reference)
    return next(each.preference for each in draft.trials if not each.refined and each.residual_share == share)


def pressed_in(
    problem: FilterProblem, reference: Sequence[Trajectory], filtered: Sequence[Trajectory]
) -> npt.NDArray[np.bool_]:
    """(N,) whether somebody is pressed much harder."""
    growth: FloatArray = largest_forces(filtered) - largest_forces(reference)
    return growth > problem.config.pressed_n


def largest_force_n(trajectories: Sequence[Trajectory]) -> float:
    """On the person, in any of them."""
    return float(largest_forces(trajectories).max())


def _p95_force_n(trajectories: Sequence[Trajectory]) -> float:
    return float(np.quantile(largest_forces(trajectories), 0.95))


def largest_forces(trajectories: Sequence[Trajectory]) -> FloatArray:
    """(N,) in N, of every episode."""
    return np.array([each.contact_force_n.max() for each in trajectories])
