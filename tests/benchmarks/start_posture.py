"""Search for the arm's start posture: which elbow configuration keeps clear of the person all the way to the mouth.

Run: python -m tests.benchmarks.start_posture    (about ten seconds; prints the numbers kept in worker/sim/feeding.py)
"""

import sys

import numpy as np

from worker.sim import human, jaco
from worker.sim.bullet import Bullet
from worker.sim.feeding import LEVEL_TOWARDS_PERSON, PERSON_PARTS, START_CENTRE_M, add_person, in_base_frame

RESTARTS = 4000
WAYPOINTS_M = ((-0.05, -0.10, 0.0), (0.05, -0.10, 0.0), (-0.05, 0.0, 0.0), (0.05, 0.0, 0.0), (0.0, 0.0, 0.04))


def main() -> None:
    """Score random restarts by manipulability, clearance and joint margins; print the best."""
    rng = np.random.default_rng(1)
    world = Bullet()
    jaco.add_to(world)
    add_person(world)
    mouth = np.array(human.NECK_PIVOT_M) + human.MOUTH_FROM_NECK_M
    goals = in_base_frame(np.array([START_CENTRE_M, *(mouth + np.array(WAYPOINTS_M))]))
    seeds = rng.uniform(np.maximum(jaco.LOWER_RAD, -np.pi), np.minimum(jaco.UPPER_RAD, 1.5 * np.pi), (RESTARTS, 7))
    chain: list[jaco.FloatArray] = []
    errors: list[jaco.FloatArray] = []
    for goal in goals:
        start = chain[0] if chain else seeds
        solved, error = jaco.solve_spoon_pose(start, np.tile(goal, (RESTARTS, 1)), LEVEL_TOWARDS_PERSON, 100)
        chain.append(solved)
        errors.append(error)
    usable = np.flatnonzero(np.max(errors, axis=0) < 5e-3)
    scored = sorted(((_score(world, [step[index] for step in chain]), index) for index in usable), reverse=True)
    for score, index in scored[:5]:
        angles = ", ".join(f"{angle:.4f}" for angle in chain[0][index])
        sys.stdout.write(f"{score:.3f}  {_clearance(world, [step[index] for step in chain]):.3f} m  ({angles})\n")


def _clearance(world: Bullet, postures: list[jaco.FloatArray]) -> float:
    gaps = []
    for posture in postures:
        world.set_joints("arm", posture)
        gaps += [world.clearance_m("arm", part, 0.3, (jaco.SPOON_LINK,)) for part in PERSON_PARTS]
    return min(gaps)


def _score(world: Bullet, postures: list[jaco.FloatArray]) -> float:
    stack = np.array(postures)
    jacobians = jaco.spoon_jacobian(jaco.link_frames(stack))
    manipulability = np.sqrt(np.linalg.det(jacobians @ jacobians.swapaxes(1, 2))).min()
    limited = [1, 3, 5]
    margin = np.minimum(stack - jaco.LOWER_RAD, jaco.UPPER_RAD - stack)[:, limited].min()
    travel = np.abs(stack[1:] - stack[0]).sum(1).max()
    clearance = _clearance(world, postures)
    return float(10 * min(manipulability, 0.06) + 2 * min(clearance, 0.10) + 0.5 * min(margin, 0.5) - 0.05 * travel)


if __name__ == "__main__":
    main()
