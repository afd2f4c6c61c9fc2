"""Where the close-up in a film's corner is taken from: along the normal of the face, or of the skin that itches."""

from itertools import pairwise

import numpy as np

from worker.domain.type_aliases import FloatArray
from worker.sim.geometry import rotation_of
from worker.sim.human import RIGHT, arm_points_m
from worker.sim.render.camera import Camera, close_up_camera
from worker.sim.render.interpolation import ClipMotion
from worker.sim.render.task_look import TaskLook


def close_up(look: TaskLook, motion: ClipMotion, width: int, height: int) -> Camera:
    """The camera of a clip's close-up. It stays where it is while the person moves."""
    target_m = motion.target_m[0]
    axes = _skin_axes(motion) if look.itch else rotation_of(motion.head_quaternions[0])
    towards = _unit(axes @ np.asarray(look.inset_from))
    return close_up_camera(target_m + axes @ np.asarray(look.inset_offset_m), towards, look.inset_span_m, width, height)


def _skin_axes(motion: ClipMotion) -> FloatArray:
    """(3, 3) in columns: level and away from the robot, out of the skin at the itch, and up.

    All three are the same for every clip of a scenario, so that two clips are seen from the same place.
    """
    points_m, itch_m = arm_points_m(motion.body, motion.arms_rad[0, RIGHT], RIGHT), motion.target_m[0]
    start_m, end_m = min(pairwise(points_m[:3]), key=lambda bone: _distance_m(itch_m, *bone))
    along, out = _unit(end_m - start_m), itch_m - start_m
    away = (itch_m - motion.frames[0, 0, :3, 3]) * [1, 1, 0]
    return np.column_stack([_unit(away), _unit(out - (out @ along) * along), [0, 0, 1]])


def _distance_m(point_m: FloatArray, start_m: FloatArray, end_m: FloatArray) -> float:
    share = np.clip((point_m - start_m) @ (end_m - start_m) / ((end_m - start_m) @ (end_m - start_m)), 0.0, 1.0)
    return float(np.linalg.norm(point_m - start_m - share * (end_m - start_m)))


def _unit(vector: FloatArray) -> FloatArray:
    return np.asarray(vector / np.linalg.norm(vector))
