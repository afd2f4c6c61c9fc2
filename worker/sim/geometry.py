"""Shapes and frames: SI units, xyzw quaternions."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from worker.domain.type_aliases import FloatArray
from worker.sim.engine import pybullet

Vector = Sequence[float] | FloatArray
IDENTITY = (0.0, 0.0, 0.0, 1.0)


@dataclass(frozen=True)
class Shape:
    """One primitive in its body's frame; a capsule lies along z and ``length_m`` excludes its round caps."""

    kind: Literal["sphere", "capsule", "box"]
    radius_m: float = 0.01
    length_m: float = 0.0
    half_extents_m: tuple[float, float, float] = (0.01, 0.01, 0.01)
    position_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    quaternion: tuple[float, float, float, float] = IDENTITY

    @classmethod
    def box(cls, centre_m: tuple[float, float, float], size_m: tuple[float, float, float]) -> "Shape":
        """A box by its whole edge lengths."""
        return cls("box", half_extents_m=(size_m[0] / 2, size_m[1] / 2, size_m[2] / 2), position_m=centre_m)


def rotation_of(quaternion: Vector) -> FloatArray:
    """The (3, 3) rotation matrix of an xyzw quaternion."""
    return np.array(pybullet.getMatrixFromQuaternion(quaternion)).reshape(3, 3)


def compose(
    origin_m: Vector, quaternion: Vector, inner_m: Vector, inner_quaternion: Vector
) -> tuple[tuple[float, float, float], tuple[float, float, float, float]]:
    """A frame given in another frame, seen from outside."""
    position, turn = pybullet.multiplyTransforms(
        list(origin_m), list(quaternion), list(inner_m), list(inner_quaternion)
    )
    return tuple(position), tuple(turn)


def quaternion_of_euler(euler_rad: Vector) -> tuple[float, float, float, float]:
    """The xyzw quaternion of roll, pitch, yaw about fixed x, y, z axes."""
    return tuple(pybullet.getQuaternionFromEuler(list(euler_rad)))


def capsule_between(start_m: Vector, end_m: Vector, radius_m: float) -> Shape:
    """A capsule whose axis runs from start to end, both in the body's frame."""
    (x0, y0, z0), (x1, y1, z1) = start_m, end_m
    x, y, z = x1 - x0, y1 - y0, z1 - z0
    length = math.sqrt(x * x + y * y + z * z)
    # The shortest turn that takes the z axis to the capsule's; for one that points straight down any half turn will do.
    turn = (-y, x, 0.0, length + z) if length + z > 1e-9 * length else (1.0, 0.0, 0.0, 0.0)
    norm = math.sqrt(sum(part * part for part in turn))
    return Shape(
        "capsule",
        radius_m,
        length,
        position_m=((x0 + x1) / 2, (y0 + y1) / 2, (z0 + z1) / 2),
        quaternion=(turn[0] / norm, turn[1] / norm, turn[2] / norm, turn[3] / norm),
    )
