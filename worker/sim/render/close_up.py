"""Where the close-up in a film's corner is taken from: along the normal of the face, or of the skin that itches."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from worker.domain.type_aliases import FloatArray
from worker.sim.geometry import rotation_of
from worker.sim.human import RIGHT, Limb, arm_limbs, arm_points_m
from worker.sim.render.camera import CLOSE_UP_DISTANCE_M, Camera, close_up_camera
from worker.sim.render.interpolation import ClipMotion
from worker.sim.render.task_look import TaskLook

SWINGS_DEG = (0, 45, -45, 90, -90, 135, -135, 180)
"""About the normal of the skin, tried in this order until nothing of the person is in between."""
CLOTHES_M, BESIDE_M = 0.03, 0.08
"""What clothes and hair add to the radius of a limb; where the line of sight has left the limb that itches."""


def close_up(look: TaskLook, motion: ClipMotion, width: int, height: int) -> Camera:
    """The camera of a clip's close-up. It stays where it is while the person moves."""
    target_m = motion.target_m[0]
    axes = _skin_axes(motion) if look.itch else rotation_of(motion.head_quaternions[0])
    towards = _unit(axes @ np.asarray(look.inset_from))
    if look.itch:
        swings = [_swung(towards, axes[:, 1], np.radians(angle)) for angle in SWINGS_DEG]
        person = _upper_body(motion)
        towards = swings[int(np.argmax([min(_clearance_m(target_m, each, person), CLOTHES_M) for each in swings]))]
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


def _swung(direction: FloatArray, about: FloatArray, angle: float) -> FloatArray:
    """The direction turned about a unit vector."""
    kept = (direction @ about) * about
    return np.asarray(kept + np.cos(angle) * (direction - kept) + np.sin(angle) * np.cross(about, direction))


def _upper_body(motion: ClipMotion) -> Sequence[Limb]:
    """Trunk, head and right arm as capsules in the world."""
    body, turned = motion.body, rotation_of(motion.head_quaternions[0])
    centres_m = [(ball, body.neck_pivot_m + turned @ ball.centre_m) for ball in body.head]
    head = [Limb(ball.name, tuple(at_m), tuple(at_m), ball.radius_m) for ball, at_m in centres_m]
    return (*body.trunk, *head, *arm_limbs(body, motion.arms_rad[0, RIGHT], RIGHT))


def _clearance_m(itch_m: FloatArray, towards: FloatArray, limbs: Sequence[Limb]) -> float:
    """Between the limbs and the line from the itch to a camera in this direction; below 0: one is in between."""
    line_m = itch_m + np.linspace(BESIDE_M, CLOSE_UP_DISTANCE_M, 40)[:, None] * towards
    return min(
        _distance_m(point_m, np.array(limb.start_m), np.array(limb.end_m)) - limb.radius_m
        for limb in limbs
        for point_m in line_m
    )


def _distance_m(point_m: FloatArray, start_m: FloatArray, end_m: FloatArray) -> float:
    along = end_m - start_m
    share = np.clip((point_m - start_m) @ along / max(float(along @ along), 1e-12), 0.0, 1.0)
    return float(np.linalg.norm(point_m - start_m - share * along))


def _unit(vector: FloatArray) -> FloatArray:
    return np.asarray(vector / np.linalg.norm(vector))
