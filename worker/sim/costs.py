"""From what a person experiences to a preference reward: r^H = -(weights * omega) . C, per control step.

`omega` says how much one person cares about each of the six items (1 = the reference). Two forms of the items:

* ``paper``: C_d, C_v, C_f, C_hf, C_fd, C_fdv as measured, with the benchmark's weights 1, .25, .01, .05, 1, 1. With
  these, even a person who fears speed prefers to be fed faster, because time spent far away costs more.
* ``calibrated``: the speed item is speed^2 / 0.2 m/s, weighted so that the reference person is content with the
  policy's own speed; omegas then pull in different directions. While an itch is scratched, motion near it is the
  service and does not count. Food and water are counted in eighths of the portion, or
  dividing the same water into more pellets would make it a greater evil. The other three items are unchanged.
"""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Literal

import numpy as np
import numpy.typing as npt

from worker.domain.task import Task
from worker.domain.trajectory import COSTS, SIGNALS
from worker.domain.type_aliases import Float32Array, FloatArray

CostForm = Literal["paper", "calibrated"]

BASE_WEIGHTS = {"C_d": 1.0, "C_v": 0.25, "C_f": 0.01, "C_hf": 0.05, "C_fd": 1.0, "C_fdv": 1.0}
SPEED_SCALE_M_S = 0.2
"""At this speed the calibrated item equals the paper's."""

PIECES_AT_WEIGHT_ONE = 8
"""The calibrated form counts eighths of the portion."""

_SPEED = COSTS.index("C_v")
_PIECES = [COSTS.index("C_fd"), COSTS.index("C_fdv")]
_SPEED_SQUARED = SIGNALS.index("speed_squared_m2_s2")
_NEAR_SPEED_SQUARED = SIGNALS.index("near_speed_squared_m2_s2")


def base_weights(task: Task, form: CostForm = "calibrated") -> FloatArray:
    """(6,) weights of the six items for a person with omega = 1."""
    weights = np.array([BASE_WEIGHTS[name] for name in COSTS])
    if form == "calibrated":
        weights[_SPEED] = task.calibrated_speed_weight
    return weights


SIGNAL_OF: Mapping[str, str] = MappingProxyType(
    {
        "C_d": "distance_m",
        "C_v": "speed_squared_m2_s2",
        "C_f": "force_away_n",
        "C_hf": "high_force_n",
        "C_fd": "spilled_on_person",
        "C_fdv": "intake_speed_m_s",
    }
)
"""Which signal each calibrated item is a multiple of; the speed near the target is left out where it does not count."""


def signal_weights(
    task: Task, omega: npt.ArrayLike = 1.0, per_signal: Mapping[str, float] = MappingProxyType({})
) -> FloatArray:
    """(S,) such that summed signals @ weights is the summed calibrated preference_rewards() of the same person."""
    items = base_weights(task) * np.asarray(omega, np.float64)
    items[_SPEED] /= SPEED_SCALE_M_S
    items[_PIECES] *= PIECES_AT_WEIGHT_ONE / task.pieces
    weights = np.zeros(len(SIGNALS))
    for name, weight in zip(COSTS, items, strict=True):
        weights[SIGNALS.index(SIGNAL_OF[name])] -= weight
    if not task.speed_counts_near:
        weights[_NEAR_SPEED_SQUARED] -= weights[_SPEED_SQUARED]
    for name, cost in per_signal.items():
        weights[SIGNALS.index(name)] -= cost
    return weights


def cost_items(task: Task, costs: Float32Array, signals: Float32Array, form: CostForm = "calibrated") -> FloatArray:
    """The six unweighted items of a form: costs (..., 6) and signals (..., S) of a trajectory -> (..., 6)."""
    items = np.array(costs, np.float64)
    if form == "calibrated":
        items[..., _PIECES] *= PIECES_AT_WEIGHT_ONE / task.pieces
        measured = np.asarray(signals, np.float64)
        counted = measured[..., _SPEED_SQUARED]
        if not task.speed_counts_near:
            counted = counted - measured[..., _NEAR_SPEED_SQUARED]
        items[..., _SPEED] = counted / SPEED_SCALE_M_S
    return items


def preference_rewards(
    task: Task,
    costs: Float32Array,
    signals: Float32Array,
    omega: npt.ArrayLike = 1.0,
    form: CostForm = "calibrated",
    per_signal: Mapping[str, float] = MappingProxyType({}),
) -> FloatArray:
    """r^H of every step, (...,). ``omega`` is (6,) in the order of COSTS, or one number.

    ``per_signal``: what else this person dislikes, as a cost per unit of a signal and control step; below 0: likes.
    """
    weights = base_weights(task, form) * np.asarray(omega, np.float64)
    rewards: FloatArray = -(cost_items(task, costs, signals, form) @ weights)
    for name, cost in per_signal.items():
        rewards = rewards - cost * np.asarray(signals, np.float64)[..., SIGNALS.index(name)]
    return rewards


def stakes(
    task: Task,
    costs: Float32Array,
    signals: Float32Array,
    omega: npt.ArrayLike = 1.0,
    form: CostForm = "calibrated",
    per_signal: Mapping[str, float] = MappingProxyType({}),
) -> FloatArray:
    """How much of what this person minds or likes there is, (...,): r^H with everything counted positively.

    For somebody who only minds things it is -r^H. For somebody who also likes some, r^H may be near 0, and shares of it
    would say nothing.
    """
    weights = np.abs(base_weights(task, form) * np.asarray(omega, np.float64))
    amounts: FloatArray = cost_items(task, costs, signals, form) @ weights
    for name, cost in per_signal.items():
        amounts = amounts + abs(cost) * np.abs(np.asarray(signals, np.float64)[..., SIGNALS.index(name)])
    return amounts
