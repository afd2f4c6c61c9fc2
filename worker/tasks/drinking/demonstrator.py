"""A scripted way to give somebody to drink, by inverse kinematics: what the reference policy learns from at first.

It looks at nothing but the observation and remembers nothing, so that a policy can imitate it.
"""

from dataclasses import dataclass

import numpy as np

from worker.domain.spaces import Space
from worker.domain.type_aliases import Float32Array, FloatArray
from worker.sim.arm import RobotArm, Tool, tool_jacobian
from worker.sim.assistive import ACTION_UNIT_RAD
from worker.sim.jaco import JACO
from worker.tasks.drinking.environment import CUP, DRINKING

UP = np.array([0.0, 0.0, 1.0])
DAMPING = 0.05


@dataclass(frozen=True)
class ScriptedPouring:
    """observation (D,) -> action (7,). In words: come from the front, touch the lips with the rim, tip the cup."""

    observation: Space
    robot: RobotArm
    tool: Tool
    action_unit_rad: float
    largest_action: float = 0.7
    before_mouth_m: float = 0.020
    above_mouth_m: float = 0.008
    waiting_m: float = 0.08
    """how far in front of the lips the cup goes first"""
    step_m: float = 0.022
    """the rim moves this far in a control step"""
    tilt_step_rad: float = 0.040
    early_tilt_rad: float = 0.5
    """the cup is tipped so far on its way"""
    full_tilt_rad: float = 1.5
    turned_in_rad: float = 0.4
    follow: float = 0.4
    """share of the head's turn that the cup follows"""

    def __call__(self, observation: Float32Array) -> Float32Array:
        """See the class."""
        joints = self._field(observation, "joint_positions_rad")
        frames = self.robot.link_frames(joints[None], self.tool)
        rim, cup = frames[0, -1, :3, 3], frames[0, -1, :3, :3]
        target = rim + self._field(observation, "tool_to_target_m")
        outward = self._field(observation, "target_outward")
        level_out = _unit(outward * (1.0, 1.0, 0.0))
        lips = target + self.before_mouth_m * outward + self.above_mouth_m * UP
        aside = np.linalg.norm(np.cross(rim - lips, level_out))
        gap = float((rim - lips) @ level_out)
        arrived = np.linalg.norm(rim - lips) < 0.015
        waiting = 0.0 if aside < 0.03 else min(self.waiting_m, max(gap, 0.04))
        move = lips + waiting * level_out - rim
        move *= min(1.0, self.step_m / max(float(np.linalg.norm(move)), 1e-9))
        turn = self._turn(cup, level_out, bool(arrived))
        return self._joint_action(frames, joints, np.concatenate([move, turn]))

    def _turn(self, cup: FloatArray, level_out: FloatArray, arrived: bool) -> FloatArray:
        """The rotation vector of this control step: towards the head's side, and tipping."""
        forward = self.robot.mount_rotation.T @ np.array([0.0, 1.0, 0.0])
        yaw = np.arctan2(np.cross(forward, -level_out) @ UP, -level_out @ forward)
        angle = self.turned_in_rad + self.follow * yaw
        towards = np.cos(angle) * forward + np.sin(angle) * np.cross(UP, forward)
        tilt = float(np.arctan2(cup[:, 2] @ towards, cup[:, 2] @ UP))
        goal = self.full_tilt_rad if arrived else max(self.early_tilt_rad, tilt)
        tilt += float(np.clip(goal - tilt, -self.tilt_step_rad, self.tilt_step_rad))
        side = np.cross(UP, towards)
        wanted_up = np.cos(tilt) * UP + np.sin(tilt) * towards
        wanted = np.stack([np.cross(side, wanted_up), side, wanted_up], 1)
        error = 0.5 * np.cross(cup.T, wanted.T).sum(0)
        limited: FloatArray = np.clip(error, -0.06, 0.06)
        return limited

    def _joint_action(self, frames: FloatArray, joints: FloatArray, twist: FloatArray) -> Float32Array:
        jacobian = tool_jacobian(frames)[0]
        change = jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + DAMPING**2 * np.eye(6), twist)
        action = change / self.action_unit_rad
        return np.asarray(action / max(1.0, float(np.abs(action).max()) / self.largest_action), np.float32)

    def _field(self, observation: Float32Array, name: str) -> FloatArray:
        return np.asarray(observation[self.observation.slice_of(name)], np.float64)


def scripted_pouring() -> ScriptedPouring:
    """The controller for the arm and cup of DrinkingEnv."""
    return ScriptedPouring(DRINKING.observation, JACO, CUP, ACTION_UNIT_RAD)


def _unit(vector: FloatArray) -> FloatArray:
    scaled: FloatArray = vector / np.linalg.norm(vector)
    return scaled
