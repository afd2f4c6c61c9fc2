"""A trajectory made without physics: the arm waves and carries its food along."""

import numpy as np

from worker.sim import jaco
from worker.trajectory import COSTS, SIGNALS, Trajectory

POSTURE_RAD = np.array([-3.01, 3.73, 0.0, 4.89, 1.43, 1.76, 0.41])
"""The spoon is level between its start and the mouth."""


def waving_trajectory(steps: int, force_n: float = 0.0) -> Trajectory:
    """The joints swing smoothly around one posture; eight pieces of food stay on the spoon."""
    time = np.arange(steps + 1)[:, None] * 0.1
    joints = POSTURE_RAD + 0.06 * np.sin(time + np.arange(7))
    spoon = jaco.link_frames(joints)[:, -1]
    seats = np.array([[x, y, 0.006] for x in (-0.015, -0.005, 0.005, 0.015) for y in (-0.006, 0.006)])
    in_base = np.einsum("tij,pj->tpi", spoon[:, :3, :3], seats) + spoon[:, None, :3, 3]
    particles = in_base @ jaco.rotation(jaco.ROBOT_BASE_RPY).T + jaco.ROBOT_BASE_M
    return Trajectory(
        observations=np.zeros((steps + 1, 28), np.float32),
        actions=np.zeros((steps, 7), np.float32),
        reference_actions=np.zeros((steps, 7), np.float32),
        signals=np.zeros((steps, len(SIGNALS)), np.float32),
        costs=np.zeros((steps, len(COSTS)), np.float32),
        task_rewards=np.zeros(steps, np.float32),
        joint_positions=joints.astype(np.float32),
        particles=particles.astype(np.float32),
        head_quaternion=np.array([0.0, 0.0, 0.0, 1.0], np.float32),
        contact_force_n=np.full(steps, force_n, np.float32),
        success=True,
        scenario=0,
        task="feeding",
    )
