"""A filter against the reference policy on the same unseen scenarios: differences with 95 % intervals.

Every difference is paired by scenario, so that easy and hard scenarios cancel. Intervals of means of costs and
preference are Student's. Success is 0 or 1 and changes in few scenarios or none, where they (and the bootstrap) claim
too much: it gets Newcombe's score interval for paired proportions.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import stats

from worker.analysis.wilson import wilson_interval
from worker.domain.task import Task
from worker.domain.trajectory import Trajectory
from worker.domain.type_aliases import FloatArray


def evaluate(
    reference: Sequence[Trajectory],
    filtered: Sequence[Trajectory],
    reference_returns: npt.ArrayLike,
    filtered_returns: npt.ArrayLike,
    task: Task,
) -> dict[str, Any]:
    """Everything the dashboard and the model card show, as plain values.

    ``*_returns`` (N,): learned returns of the same trajectories; their change is given in standard deviations of the
    reference's returns. ``task``: whose signals and costs the columns are.
    Costs are means over episodes of the summed unweighted costs.
    Raises ValueError when the two lists are not the same scenarios in the same order.
    """
    if [each.scenario for each in reference] != [each.scenario for each in filtered] or not reference:
        raise ValueError("Both must have been run on the same scenarios, in the same order.")
    before, after = np.asarray(reference_returns, np.float64), np.asarray(filtered_returns, np.float64)
    unit = max(float(before.std()), 1e-9)
    return {
        "scenarios": len(reference),
        "success": success_change(_successes(reference), _successes(filtered)),
        "preference": _with_interval((after - before) / unit),
        "costs": {
            name: mean_change(_summed(reference, column), _summed(filtered, column))
            for column, name in enumerate(task.costs)
        },
        "safety": {"reference": envelope(reference, task.signals), "filter": envelope(filtered, task.signals)},
    }


def mean_change(before: FloatArray, after: FloatArray) -> dict[str, float]:
    """Means of both and of their paired difference, with its interval. (N,), (N,)"""
    return {"reference": float(before.mean()), "filter": float(after.mean()), **_with_interval(after - before)}


def success_change(before: FloatArray, after: FloatArray) -> dict[str, float]:
    """Success rates and their paired difference with its interval. (N,) of 0 and 1, or of means over repetitions.

    Method 10 of Newcombe (1998), Statistics in Medicine 17, 2635-2650: Wilson's intervals of the two rates, squared
    and added, with their correlation.
    """
    count, rates = len(before), (float(before.mean()), float(after.mean()))
    (low_before, high_before), (low_after, high_after) = (
        wilson_interval(float(values.sum()), count) for values in (before, after)
    )
    delta, phi = float((after - before).mean()), _correlation(before, after)  # of whole episodes: exact at a tolerance
    down, up = rates[1] - low_after, high_after - rates[1]
    before_down, before_up = rates[0] - low_before, high_before - rates[0]
    low = delta - float(np.sqrt(max(down**2 - 2 * phi * down * before_up + before_up**2, 0.0)))
    high = delta + float(np.sqrt(max(up**2 - 2 * phi * up * before_down + before_down**2, 0.0)))
    return {"reference": rates[0], "filter": rates[1], "delta": delta, "low": low, "high": high}


def _correlation(before: FloatArray, after: FloatArray) -> float:
    """Newcombe's phi: corrected for continuity when positive, 0 when one of the rates is 0 or 1."""
    both, neither = float((before * after).sum()), float(((1 - before) * (1 - after)).sum())
    lost, won = float((before * (1 - after)).sum()), float(((1 - before) * after).sum())
    margins = (both + lost) * (won + neither) * (both + won) * (lost + neither)
    if margins == 0.0:
        return 0.0
    excess = both * neither - lost * won
    corrected = max(excess - len(before) / 2, 0.0) if excess > 0 else excess
    return float(corrected / np.sqrt(margins))


def envelope(trajectories: Sequence[Trajectory], signals: Sequence[str]) -> dict[str, float]:
    """The largest speed and force seen in these rollouts, and the 95th percentile of each episode's largest.

    Only what is measured: laboratories' environments have no person of ours, and a speed if they say what moves.
    """
    found: dict[str, float] = {}
    if "speed_m_s" in signals:
        column = signals.index("speed_m_s")
        speeds = np.array([each.signals[:, column].max() for each in trajectories])
        found |= {"max_speed_m_s": float(speeds.max()), "p95_max_speed_m_s": float(np.quantile(speeds, 0.95))}
    if all(each.body for each in trajectories):
        forces = np.array([each.contact_force_n.max() for each in trajectories])
        found |= {"max_force_n": float(forces.max()), "p95_max_force_n": float(np.quantile(forces, 0.95))}
    return found


def _with_interval(differences: FloatArray) -> dict[str, float]:
    """Student's t interval of their mean; without an end for a single one."""
    mean, count = float(differences.mean()), len(differences)
    if count < 2:
        return {"delta": mean, "low": -float("inf"), "high": float("inf")}
    margin = float(stats.t.ppf(0.975, count - 1)) * float(differences.std(ddof=1)) / count**0.5
    return {"delta": mean, "low": mean - margin, "high": mean + margin}


def _successes(trajectories: Sequence[Trajectory]) -> FloatArray:
    return np.array([each.success for each in trajectories], np.float64)


def _summed(trajectories: Sequence[Trajectory], column: int) -> FloatArray:
    return np.array([each.costs[:, column].sum(dtype=np.float64) for each in trajectories])
