"""Trajectories made without physics: the arm waves and carries its food or water along."""

from dataclasses import replace

import numpy as np

from worker.domain.trajectory import COSTS, SIGNALS, Trajectory
from worker.domain.type_aliases import Float32Array, FloatArray
from worker.sim.arm import Tool, transform
from worker.sim.human import ARM_JOINTS, BODY_SHAPES, RIGHT, arm_points_m
from worker.sim.jaco import JACO
from worker.tasks.drinking.environment import CUP
from worker.tasks.feeding.environment import SPOON

POSTURE_RAD = np.array([-3.01, 3.73, 0.0, 4.89, 1.43, 1.76, 0.41])
"""The spoon is level between its start and the mouth."""
ARMS_RAD = np.radians([[6.0, 4.0, 11.0, 86.0], [5.0, 3.0, 8.0, 88.0]])
MOUNT = transform(JACO.mount_m, JACO.mount_rpy)


def waving_trajectory(steps: int, force_n: float = 0.0, body: str = "broad", skin_tone: int = 1) -> Trajectory:
    """The joints swing smoothly around one posture; eight pieces of food stay on the spoon."""
    time = np.arange(steps + 1)[:, None] * 0.1
    joints = POSTURE_RAD + 0.06 * np.sin(time + np.arange(7))
    spoon = tool_frames(joints, SPOON)
    seats = np.array([[x, y, 0.006] for x in (-0.015, -0.005, 0.005, 0.015) for y in (-0.006, 0.006)])
    shape = BODY_SHAPES[body]
    mouth = np.array(shape.neck_pivot_m) + shape.mouth_from_neck_m
    return Trajectory(
        observations=np.zeros((steps + 1, 28), np.float32),
        actions=np.zeros((steps, 7), np.float32),
        reference_actions=np.zeros((steps, 7), np.float32),
        signals=np.zeros((steps, len(SIGNALS)), np.float32),
        costs=np.zeros((steps, len(COSTS)), np.float32),
        task_rewards=np.zeros(steps, np.float32),
        joint_positions=joints.astype(np.float32),
        particles=carried(spoon, seats),
        head_quaternions=np.tile(np.array([0.0, 0.0, 0.0, 1.0], np.float32), (steps + 1, 1)),
        arm_positions_rad=np.tile(ARMS_RAD.astype(np.float32), (steps + 1, 1, 1)),
        target_m=np.tile(mouth.astype(np.float32), (steps + 1, 1)),
        contact_force_n=np.full(steps, force_n, np.float32),
        success=True,
        scenario=0,
        task="feeding",
        body=body,
        skin_tone=skin_tone,
    )


def pouring_trajectory(steps: int, pellets: int = 32) -> Trajectory:
    """The same with a cup and pellets of water in it."""
    trajectory = waving_trajectory(steps)
    rng = np.random.default_rng(0)
    seats = np.array([-0.04, 0.0, -0.06]) + rng.uniform(-0.02, 0.02, (pellets, 3))
    frames = tool_frames(trajectory.joint_positions.astype(float), CUP)
    return replace(trajectory, task="drinking", particles=carried(frames, seats))


def itching_trajectory(steps: int, lift_rad: float = 0.0) -> Trajectory:
    """The same with a scratcher, while the person's itching right forearm rises by so much."""
    trajectory = replace(waving_trajectory(steps), task="scratching", particles=np.empty((steps + 1, 0, 3), np.float32))
    share = np.linspace(0.0, 1.0, steps + 1)
    trajectory.arm_positions_rad[:, RIGHT, ARM_JOINTS.index("elbow_flexion")] += lift_rad * share
    for step, arms in enumerate(trajectory.arm_positions_rad):
        trajectory.target_m[step] = itch_m(arms[RIGHT])
    return trajectory


def itch_m(arm_rad: Float32Array) -> Float32Array:
    """(3,) in the middle of the top of the broad body's right forearm, in the world."""
    shape = BODY_SHAPES["broad"]
    _, elbow, wrist, _ = arm_points_m(shape, arm_rad.astype(float), RIGHT)
    return np.asarray((elbow + wrist) / 2 + [0.0, 0.0, shape.forearm_radius_m], np.float32)


def tool_frames(joints_rad: FloatArray, tool: Tool) -> FloatArray:
    """(T + 1, 4, 4) in the world."""
    return np.asarray(MOUNT @ JACO.link_frames(joints_rad, tool)[:, -1])


def carried(frames: FloatArray, seats_m: FloatArray) -> Float32Array:
    """Particles (T + 1, P, 3) that keep their places (P, 3) in a tool's frames (T + 1, 4, 4)."""
    places = np.einsum("tij,pj->tpi", frames[:, :3, :3], seats_m) + frames[:, None, :3, 3]
    return np.asarray(places, np.float32)
