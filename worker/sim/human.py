"""The seated person: where the parts of the body are. Collision and pictures share these numbers.

World frame, metres: z up, the person faces -y, the person's left is +x, the floor is z = 0.
Sources: proportions of the benchmark's male adult (facts sheet of Assistive Gym v1.0), simplified to capsules.
"""

from typing import NamedTuple

Point = tuple[float, float, float]

NECK_PIVOT_M: Point = (0.0, 0.03, 1.15)
"""The head turns about this point."""
MOUTH_FROM_NECK_M: Point = (0.0, -0.095, 0.05)
"""Centre of the mouth in the head's frame."""
FACE_IN_HEAD: Point = (0.0, -1.0, 0.0)
"""Unit vector out of the face in the head's frame."""
HEAD_RANGE_DEG = 30.0
"""The head is held still at a random Euler angle of up to this much about each axis."""


class Limb(NamedTuple):
    """A capsule from start to end."""

    name: str
    start_m: Point
    end_m: Point
    radius_m: float


class Ball(NamedTuple):
    """A sphere in the head's frame."""

    name: str
    centre_m: Point
    radius_m: float


BODY = (
    Limb("torso", (0.0, 0.06, 0.67), (0.0, 0.06, 0.97), 0.12),
    Limb("shoulders", (-0.12, 0.06, 1.00), (0.12, 0.06, 1.00), 0.085),
    Limb("neck", (0.0, 0.05, 1.08), (0.0, 0.05, 1.16), 0.05),
    Limb("right_upper_arm", (-0.20, 0.05, 1.00), (-0.20, 0.05, 0.72), 0.045),
    Limb("left_upper_arm", (0.20, 0.05, 1.00), (0.20, 0.05, 0.72), 0.045),
    Limb("right_forearm", (-0.20, 0.03, 0.72), (-0.20, -0.21, 0.72), 0.038),
    Limb("left_forearm", (0.20, 0.03, 0.72), (0.20, -0.21, 0.72), 0.038),
)
"""Torso and arms, in the world frame."""

LEGS = (
    Limb("right_thigh", (-0.09, 0.05, 0.53), (-0.11, -0.40, 0.53), 0.072),
    Limb("left_thigh", (0.09, 0.05, 0.53), (0.11, -0.40, 0.53), 0.072),
)
"""Where spilled food lands, in the world frame. A body of its own, so that the parts' bounds stay small."""

HEAD = (
    Ball("skull", (0.0, -0.01, 0.125), 0.088),
    Ball("chin", (0.0, -0.058, 0.0), 0.030),
)
"""Two spheres with a gap at the mouth, so that a spoon can enter."""
