"""The Jaco arm (j2s7s300: seven joints, spherical wrist) with a spoon, as data, kinematics and collision shapes.

Frames and joint limits follow the published j2s7s300 description; link shapes are our own capsules and boxes.
The spoon is rigidly held: its frame has its origin at the centre of the bowl, x towards the tip, z up out of the bowl.
"""

import math
from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from worker.sim.bullet import IDENTITY, Bullet, Link, Shape, capsule_between, compose, quaternion_of_euler

FloatArray = npt.NDArray[np.float64]
Point = tuple[float, float, float]

PI = math.pi
TAU = 2 * math.pi


class Joint(NamedTuple):
    """A revolute joint about its own z axis, and the link it moves."""

    link: str
    origin_m: Point
    """Place of the joint in the previous link's frame."""
    origin_rpy: Point
    lower_rad: float
    upper_rad: float
    mass_kg: float
    end_m: Point
    """The link's capsule runs from its frame's origin to here."""
    radius_m: float


BASE_LINK = "base"
BASE_HEIGHT_M = 0.15
BASE_RADIUS_M = 0.055

JOINTS = (
    Joint("link_1", (0, 0, 0.15675), (0, PI, 0), -TAU, TAU, 0.7477, (0, 0.0016, -0.11875), 0.043),
    Joint("link_2", (0, 0.0016, -0.11875), (-PI / 2, 0, PI), 0.8203, 5.4629, 0.8447, (0, -0.205, 0), 0.042),
    Joint("link_3", (0, -0.205, 0), (-PI / 2, 0, 0), -TAU, TAU, 0.8447, (0, 0, -0.205), 0.042),
    Joint("link_4", (0, 0, -0.205), (PI / 2, 0, PI), 0.5236, 5.7596, 0.6763, (0, 0.2073, -0.0114), 0.036),
    Joint("link_5", (0, 0.2073, -0.0114), (-PI / 2, 0, PI), -TAU, TAU, 0.463, (0, 0, -0.10375), 0.033),
    Joint("link_6", (0, 0, -0.10375), (PI / 2, 0, PI), 1.1345, 5.1487, 0.463, (0, 0.10375, 0), 0.033),
    Joint("link_7", (0, 0.10375, 0), (-PI / 2, 0, PI), -TAU, TAU, 0.99, (0, 0, -0.10), 0.036),
)
LOWER_RAD = np.array([joint.lower_rad for joint in JOINTS])
UPPER_RAD = np.array([joint.upper_rad for joint in JOINTS])

HAND_LINK = "hand"
HAND_ORIGIN_M: Point = (0, 0, -0.16)
HAND_RPY: Point = (PI, 0, 0)
"""The hand's frame (the benchmark's end effector) in link 7; the tool is held here."""

SPOON_LINK = "spoon"
SPOON_ORIGIN_M: Point = (0.13, 0, 0)
SPOON_RPY: Point = (-PI / 2, 0, 0)
"""The spoon's frame in the hand."""
SPOON_LENGTH_M, SPOON_WIDTH_M, SPOON_DEPTH_M, SPOON_WALL_M = 0.050, 0.038, 0.011, 0.003
HANDLE_LENGTH_M, HANDLE_WIDTH_M, HANDLE_HEIGHT_M = 0.11, 0.008, 0.005
SPOON_MASS_KG = 0.03

ROBOT_BASE_M: Point = (-0.45, -0.55, 0.45)
ROBOT_BASE_RPY: Point = (0.0, 0.0, -PI / 2)
"""Where the arm is mounted beside the person's right knee, in the world frame."""


def rotation(rpy: Sequence[float]) -> FloatArray:
    """The (3, 3) matrix of roll, pitch, yaw about fixed axes, as URDF means them."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(rpy), np.sin(rpy)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def link_frames(angles_rad: FloatArray) -> FloatArray:
    """Frames of links 1 to 7 and of the spoon in the base frame: (B, 7) -> (B, 8, 4, 4)."""
    count = len(angles_rad)
    frames = np.empty((count, len(JOINTS) + 1, 4, 4))
    frame = np.broadcast_to(np.eye(4), (count, 4, 4))
    for index, joint in enumerate(JOINTS):
        turn = np.zeros((count, 4, 4))
        cosine, sine = np.cos(angles_rad[:, index]), np.sin(angles_rad[:, index])
        turn[:, 0, 0], turn[:, 0, 1], turn[:, 1, 0], turn[:, 1, 1] = cosine, -sine, sine, cosine
        turn[:, 2, 2] = turn[:, 3, 3] = 1.0
        frame = frame @ _transform(joint.origin_m, joint.origin_rpy) @ turn
        frames[:, index] = frame
    hand = _transform(HAND_ORIGIN_M, HAND_RPY)
    frames[:, -1] = frame @ hand @ _transform(SPOON_ORIGIN_M, SPOON_RPY)
    return frames


def spoon_jacobian(frames: FloatArray) -> FloatArray:
    """Linear and angular velocity of the spoon per joint rate, in the base frame: (B, 8, 4, 4) -> (B, 6, 7)."""
    axes = frames[:, :7, :3, 2]
    arms = frames[:, 7:, :3, 3] - frames[:, :7, :3, 3]
    return np.concatenate([np.cross(axes, arms), axes], axis=-1).swapaxes(1, 2)


def solve_spoon_pose(
    start_rad: FloatArray, positions_m: FloatArray, orientation: FloatArray, iterations: int = 40
) -> tuple[FloatArray, FloatArray]:
    """Joint angles (B, 7) that bring the spoon to positions (B, 3) and one orientation (3, 3), all in the base frame.

    Damped least squares from ``start_rad`` (B, 7), so that the answer stays in the start's elbow configuration.
    Also returns the remaining error (B,), metres and radians added up.
    """
    angles = np.array(start_rad, float)
    error = np.empty((len(angles), 6))
    for _ in range(iterations):
        frames = link_frames(angles)
        error[:, :3] = positions_m - frames[:, -1, :3, 3]
        current = frames[:, -1, :3, :3].swapaxes(1, 2)
        error[:, 3:] = 0.5 * np.cross(current, orientation.T).sum(1)
        jacobian = spoon_jacobian(frames)
        transposed = jacobian.swapaxes(1, 2)
        damped = jacobian @ transposed + 0.02**2 * np.eye(6)
        change = (transposed @ np.linalg.solve(damped, error[:, :, None]))[:, :, 0]
        angles = np.clip(angles + np.clip(change, -0.2, 0.2), LOWER_RAD, UPPER_RAD)
    return angles, np.linalg.norm(error[:, :3], axis=1) + np.linalg.norm(error[:, 3:], axis=1)


def add_to(world: Bullet, name: str = "arm", at_home: bool = True) -> None:
    """Add arm and spoon to a world, beside the person or, for tests, at its origin."""
    base = [capsule_between((0, 0, 0), (0, 0, BASE_HEIGHT_M), BASE_RADIUS_M)]
    place, turn = (ROBOT_BASE_M, quaternion_of_euler(ROBOT_BASE_RPY)) if at_home else ((0, 0, 0), IDENTITY)
    world.add_chain(name, base, _links(), place, turn)


@cache
def _links() -> tuple[Link, ...]:
    moving = [
        Link(
            joint.link,
            joint.origin_m,
            quaternion_of_euler(joint.origin_rpy),
            joint.mass_kg,
            (capsule_between((0, 0, 0), joint.end_m, joint.radius_m),),
            turns=True,
        )
        for joint in JOINTS
    ]
    origin, quaternion = compose(
        HAND_ORIGIN_M, quaternion_of_euler(HAND_RPY), SPOON_ORIGIN_M, quaternion_of_euler(SPOON_RPY)
    )
    return (*moving, Link(SPOON_LINK, origin, quaternion, SPOON_MASS_KG, _spoon_boxes(), turns=False))


def _transform(origin_m: Point, rpy: Point) -> FloatArray:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation(rpy), origin_m
    return matrix


def _box(centre: Point, size: Point) -> Shape:
    return Shape("box", half_extents_m=(size[0] / 2, size[1] / 2, size[2] / 2), position_m=centre)


def _spoon_boxes() -> tuple[Shape, ...]:
    length, width, depth, wall = SPOON_LENGTH_M, SPOON_WIDTH_M, SPOON_DEPTH_M, SPOON_WALL_M
    rim = depth / 2 - wall / 2
    handle = (-length / 2 - HANDLE_LENGTH_M / 2, 0.0, depth / 2)
    return (
        _box((0, 0, -wall / 2), (length, width, wall)),
        _box((length / 2, 0, rim), (wall, width, depth)),
        _box((-length / 2, 0, rim), (wall, width, depth)),
        _box((0, width / 2, rim), (length, wall, depth)),
        _box((0, -width / 2, rim), (length, wall, depth)),
        _box(handle, (HANDLE_LENGTH_M, HANDLE_WIDTH_M, HANDLE_HEIGHT_M)),
    )
