"""A serial robot arm with a rigidly held tool, as data: kinematics in NumPy and the links the engine wants.

A new robot is a table of joints (see jaco.py); nothing here knows which one it is.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import NamedTuple

import numpy as np

from worker.domain.type_aliases import FloatArray
from worker.sim.bullet import Bullet, Link
from worker.sim.geometry import IDENTITY, Shape, capsule_between, compose, quaternion_of_euler

Point = tuple[float, float, float]
Rotation = tuple[Point, Point, Point]


class Joint(NamedTuple):
    """A revolute joint about its own z axis, and the link it moves."""

    link: str
    origin_m: Point
    """place of the joint in the previous link's frame"""
    origin_rpy: Point
    lower_rad: float
    upper_rad: float
    mass_kg: float
    end_m: Point
    """the link's capsule runs from its frame's origin to here"""
    radius_m: float


@dataclass(frozen=True)
class Tool:
    """What the hand holds. The tool frame's origin is its working point; its pose is given in the hand's frame."""

    name: str
    origin_m: Point
    rpy: Point
    shapes: tuple[Shape, ...]
    """collision shapes in the tool's frame"""
    mass_kg: float


@dataclass(frozen=True)
class RobotArm:
    """An arm of J revolute joints on a fixed base."""

    name: str
    joints: tuple[Joint, ...]
    base_height_m: float
    base_radius_m: float
    hand_origin_m: Point
    """the hand's frame in the last link's; the tool is held here"""
    hand_rpy: Point
    mount_m: Point
    """where the base stands in the world"""
    mount_rpy: Point

    @cached_property
    def lower_rad(self) -> FloatArray:
        """(J,)"""
        return np.array([joint.lower_rad for joint in self.joints])

    @cached_property
    def upper_rad(self) -> FloatArray:
        """(J,)"""
        return np.array([joint.upper_rad for joint in self.joints])

    @cached_property
    def mount_rotation(self) -> FloatArray:
        """(3, 3) from the base frame to the world's."""
        return rotation(self.mount_rpy)

    def in_base_frame(self, points_m: FloatArray) -> FloatArray:
        """World points (..., 3) as seen from the base."""
        seen: FloatArray = (points_m - np.array(self.mount_m)) @ self.mount_rotation
        return seen

    def link_frames(self, angles_rad: FloatArray, tool: Tool) -> FloatArray:
        """Frames of every link and of the tool in the base frame: (B, J) -> (B, J + 1, 4, 4)."""
        count = len(angles_rad)
        frames = np.empty((count, len(self.joints) + 1, 4, 4))
        frame = np.broadcast_to(np.eye(4), (count, 4, 4))
        for index, joint in enumerate(self.joints):
            turn = np.zeros((count, 4, 4))
            cosine, sine = np.cos(angles_rad[:, index]), np.sin(angles_rad[:, index])
            turn[:, 0, 0], turn[:, 0, 1], turn[:, 1, 0], turn[:, 1, 1] = cosine, -sine, sine, cosine
            turn[:, 2, 2] = turn[:, 3, 3] = 1.0
            frame = frame @ transform(joint.origin_m, joint.origin_rpy) @ turn
            frames[:, index] = frame
        frames[:, -1] = frame @ transform(self.hand_origin_m, self.hand_rpy) @ transform(tool.origin_m, tool.rpy)
        return frames

    def solve_pose(
        self, start_rad: FloatArray, positions_m: FloatArray, orientation: FloatArray, tool: Tool, iterations: int = 40
    ) -> tuple[FloatArray, FloatArray]:
        """Joint angles (B, J) that bring the tool to positions (B, 3) and orientation (3, 3) or (B, 3, 3), base frame.

        Damped least squares from ``start_rad`` (B, J), so that the answer stays in the start's elbow configuration.
        Also returns the remaining error (B,), metres and radians added up.
        """
        angles = np.array(start_rad, float)
        error = np.empty((len(angles), 6))
        wanted = np.broadcast_to(orientation, (len(angles), 3, 3)).swapaxes(1, 2)
        for _ in range(iterations):
            frames = self.link_frames(angles, tool)
            error[:, :3] = positions_m - frames[:, -1, :3, 3]
            error[:, 3:] = 0.5 * np.cross(frames[:, -1, :3, :3].swapaxes(1, 2), wanted).sum(1)
            jacobian = tool_jacobian(frames)
            transposed = jacobian.swapaxes(1, 2)
            damped = jacobian @ transposed + 0.02**2 * np.eye(6)
            change = (transposed @ np.linalg.solve(damped, error[:, :, None]))[:, :, 0]
            angles = np.clip(angles + np.clip(change, -0.2, 0.2), self.lower_rad, self.upper_rad)
        return angles, np.linalg.norm(error[:, :3], axis=1) + np.linalg.norm(error[:, 3:], axis=1)

    def add_to(self, world: Bullet, tool: Tool, name: str = "arm", mounted: bool = True) -> None:
        """Add arm and tool to a world, on its mount or, for tests, at the origin."""
        place, turn = (self.mount_m, quaternion_of_euler(self.mount_rpy)) if mounted else ((0, 0, 0), IDENTITY)
        world.add_chain(name, _base_shapes(self), _links(self, tool), place, turn)


def tool_jacobian(frames: FloatArray) -> FloatArray:
    """Linear and angular velocity of the tool per joint rate, in the base frame: (B, J + 1, 4, 4) -> (B, 6, J)."""
    axes = frames[:, :-1, :3, 2]
    arms = frames[:, -1:, :3, 3] - frames[:, :-1, :3, 3]
    return np.concatenate([np.cross(axes, arms), axes], axis=-1).swapaxes(1, 2)


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


def transform(origin_m: Point, rpy: Point) -> FloatArray:
    """The (4, 4) matrix of a frame given in another one."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation(rpy), origin_m
    return matrix


@cache
def _base_shapes(robot: RobotArm) -> tuple[Shape, ...]:
    return (capsule_between((0, 0, 0), (0, 0, robot.base_height_m), robot.base_radius_m),)


@cache
def _links(robot: RobotArm, tool: Tool) -> tuple[Link, ...]:
    moving = [
        Link(
            joint.link,
            joint.origin_m,
            quaternion_of_euler(joint.origin_rpy),
            joint.mass_kg,
            (capsule_between((0, 0, 0), joint.end_m, joint.radius_m),),
        )
        for joint in robot.joints
    ]
    origin, quaternion = compose(
        robot.hand_origin_m, quaternion_of_euler(robot.hand_rpy), tool.origin_m, quaternion_of_euler(tool.rpy)
    )
    return (*moving, Link(tool.name, origin, quaternion, tool.mass_kg, tool.shapes, "fixed"))


@dataclass(frozen=True)
class Start:
    """Where a task begins: the tool somewhere in a cube, in one orientation, the arm in one elbow configuration."""

    centre_m: Point
    """in the world"""
    range_m: float
    """half the cube's edge"""
    tool_axes: Rotation
    """rows: the tool's x, y and z axis in the world"""
    posture_rad: tuple[float, ...]
    """a solution nearby; the worker's command start-posture finds some"""
    count: int = 256


@cache
def start_postures(robot: RobotArm, tool: Tool, start: Start) -> FloatArray:
    """(count, J) rad: postures with the tool in its start orientation, spread over the start's cube."""
    rng = np.random.default_rng(1)
    offsets = rng.uniform(-start.range_m, start.range_m, (start.count, 3))
    goals = robot.in_base_frame(np.array(start.centre_m) + offsets)
    first = np.tile(start.posture_rad, (start.count, 1))
    orientation = robot.mount_rotation.T @ np.array(start.tool_axes).T
    postures, errors = robot.solve_pose(first, goals, orientation, tool)
    if errors.max() > 1e-3:
        raise RuntimeError(f"A start posture of {tool.name} misses its goal by {errors.max():.4f}.")
    postures.flags.writeable = False
    return postures
