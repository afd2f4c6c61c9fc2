"""Search for a task's start posture: which elbow configuration keeps clear of the person all the way to the target.

Random restarts of inverse kinematics, scored by manipulability, clearance and margins of the joints.
"""

import sys

import numpy as np

from worker.domain.type_aliases import FloatArray
from worker.sim.arm import tool_jacobian
from worker.sim.assistive import ARM, AssistiveEnv
from worker.sim.seated_person import PERSON
from worker.tasks.registry import environment_class

SCENARIOS = 4
"""Targets of so many scenarios lie on the way."""
RESTARTS = 4000
LIMITED_JOINTS = [1, 3, 5]


def find_start_posture(task: str, restarts: int) -> int:
    """Print the five best postures for the task's Start: score, clearance in m, angles in rad. Takes seconds."""
    kind = environment_class(task)
    rng, robot = np.random.default_rng(1), kind.robot
    orientation = robot.mount_rotation.T @ np.array(kind.start.tool_axes).T
    low, high = np.maximum(robot.lower_rad, -np.pi), np.minimum(robot.upper_rad, 1.5 * np.pi)
    seeds = rng.uniform(low, high, (restarts, len(robot.joints)))
    chain: list[FloatArray] = []
    errors: list[FloatArray] = []
    for goal in robot.in_base_frame(np.array([kind.start.centre_m, *_targets(kind)])):
        start = chain[0] if chain else seeds
        solved, error = robot.solve_pose(start, np.tile(goal, (restarts, 1)), orientation, kind.tool, 100)
        chain.append(solved)
        errors.append(error)
    env = kind()
    env.reset(seed=0)
    usable = np.flatnonzero(np.max(errors, axis=0) < 5e-3)
    ways = {index: [step[index] for step in chain] for index in usable}
    for index in sorted(usable, key=lambda index: -_score(env, ways[index]))[:5]:
        angles = ", ".join(f"{angle:.4f}" for angle in chain[0][index])
        sys.stdout.write(f"{_score(env, ways[index]):.3f}  {_clearance_m(env, ways[index]):.3f} m  ({angles})\n")
    env.close()
    return 0


def _targets(kind: type[AssistiveEnv]) -> list[FloatArray]:
    env, targets = kind(), []
    for scenario in range(SCENARIOS):
        env.reset(seed=scenario)
        targets.append(env.target_m + 0.02 * env._outward)
    env.close()
    return targets


def _clearance_m(env: AssistiveEnv, postures: list[FloatArray]) -> float:
    """Smallest gap between the arm without its tool and the person, at most 0.3 m."""
    gaps = []
    for posture in postures:
        env._world.set_joints(ARM, posture)
        gaps.append(env._world.clearance_m(ARM, PERSON, 0.3, (env.tool.name,)))
    return min(gaps)


def _score(env: AssistiveEnv, postures: list[FloatArray]) -> float:
    robot, stack = env.robot, np.array(postures)
    jacobians = tool_jacobian(robot.link_frames(stack, env.tool))
    manipulability = np.sqrt(np.linalg.det(jacobians @ jacobians.swapaxes(1, 2))).min()
    margin = np.minimum(stack - robot.lower_rad, robot.upper_rad - stack)[:, LIMITED_JOINTS].min()
    travel = np.abs(stack[1:] - stack[0]).sum(1).max()
    clearance = _clearance_m(env, postures)
    return float(10 * min(manipulability, 0.06) + 2 * min(clearance, 0.10) + 0.5 * min(margin, 0.5) - 0.05 * travel)
