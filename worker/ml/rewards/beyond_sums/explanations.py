"""What people may mind beside sums of signals, step by step like a signal: worst moments, lateness, phases, poses.

Every group turns signals (..., T, S) of clips or episodes from their start, and the scene (..., C) that they start in,
into increments (..., T, F): their sum over steps is the feature of the whole.
"""

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from worker.domain.type_aliases import FloatArray
from worker.ml.rewards.segments import SegmentPairs

ARRIVED_M = 0.10
FAR_M = 0.30
KNOTS = tuple(range(0, 60, 5))
"""Control steps from which on it counts that the robot has not arrived: any wish about when it arrives, early or late,
is nearly a sum of these. Every half second: with one a second, wishes said to the tenth were learned too roughly to be
followed (docs/results/nonlinear_filters.md)."""
_MOMENTS = (
    *("speed_m_s", "acceleration_squared_m2_s4", "turn_speed_squared_rad2_s2", "tilt_rad"),
    *("near_speed_squared_m2_s2", "force_at_target_n", "force_away_n"),
)
_PHASED = (
    *("speed_squared_m2_s2", "acceleration_squared_m2_s4", "turn_speed_squared_rad2_s2", "tilt_rad"),
    "action_change_squared",
)
_POSED = (
    *("distance_m", "speed_squared_m2_s2", "near_speed_squared_m2_s2", "lateral_offset_m", "height_above_target_m"),
    "undelivered",
)

_SMALLEST_SPREAD = 1e-6

Columns = Mapping[str, FloatArray]
"""(..., T) by the signal's name"""


def worst_moments(signals: Columns, scene: FloatArray) -> FloatArray:
    """By how much each step exceeds all before it."""
    worst = [np.maximum.accumulate(signals[name], axis=-1) for name in _MOMENTS]
    return np.stack([np.diff(each, axis=-1, prepend=0.0) for each in worst], axis=-1)


def arrival(signals: Columns, scene: FloatArray) -> FloatArray:
    """1 for every step from a knot on at which the robot has not arrived yet."""
    distance = signals["distance_m"]
    waiting = ~np.logical_or.accumulate(distance < ARRIVED_M, axis=-1)
    steps = np.arange(distance.shape[-1])
    return np.stack([waiting & (steps >= knot) for knot in KNOTS], axis=-1).astype(np.float64)


def phases(signals: Columns, scene: FloatArray) -> FloatArray:
    """Signals while the robot is far, and while it is close."""
    distance = signals["distance_m"]
    inside = (distance > FAR_M, distance < ARRIVED_M)
    return np.stack([signals[name] * where for where in inside for name in _PHASED], axis=-1)


def poses(signals: Columns, scene: FloatArray) -> FloatArray:
    """Signals times what the scene is like, in deviations from usual scenes."""
    held = scene[..., None, :]
    return np.concatenate([signals[name][..., None] * held for name in _POSED], axis=-1)


_GROUPS: Mapping[str, tuple[Callable[[Columns, FloatArray], FloatArray], Sequence[str]]] = {
    "worst_moments": (worst_moments, _MOMENTS),
    "arrival": (arrival, ("distance_m",)),
    "phases": (phases, ("distance_m", *_PHASED)),
    "poses": (poses, _POSED),
}
"""What each is made of."""
NAMES = (*_GROUPS,)
"""The names of the groups."""


def of_group(name: str, signals: Columns, scene: FloatArray) -> FloatArray:
    """(..., T, F) of the group of this name."""
    return _GROUPS[name][0](signals, scene)


def read_by(name: str) -> Sequence[str]:
    """The signals that the group of this name is made of."""
    return _GROUPS[name][1]


def amounts_of(name: str) -> tuple[str, ...]:
    """The signals of which the group's features are amounts, in their order; none: they are no amounts of a signal."""
    return {"worst_moments": _MOMENTS, "phases": (*_PHASED, *_PHASED)}.get(name, ())


def usual_scene(pairs: SegmentPairs, scene: Sequence[int]) -> tuple[FloatArray, FloatArray]:
    """Mean and standard deviation of how these clips begin, (C,) each; ``scene``: columns of the observation."""
    begins = pairs.observations[:, :, 0, list(scene)].astype(np.float64)
    return begins.mean(axis=(0, 1)), np.maximum(begins.std(axis=(0, 1)), _SMALLEST_SPREAD)


def measured(signals: Columns, scene: FloatArray) -> dict[str, FloatArray]:
    """Every group whose signals there are, (..., T, F) each; poses only where something says how scenes begin."""
    return {
        name: group(signals, scene)
        for name, (group, needed) in _GROUPS.items()
        if signals.keys() >= set(needed) and (name != "poses" or scene.shape[-1])
    }
