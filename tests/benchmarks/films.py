"""Real trajectories to look at and to time: the behaviours of a pool, on people as different as there are."""

from collections.abc import Iterator

from worker.compute import simulation
from worker.domain.trajectory import Trajectory
from worker.sim.rollout import rollout

FIRST_SCENARIO = 7_000


def films(task: str, count: int, first: int = FIRST_SCENARIO) -> Iterator[Trajectory]:
    """The first behaviour of each of so many scenarios."""
    for scenario in range(first, first + count):
        behaviour = simulation.behaviours(task, scenario, 1)[0]
        yield rollout(simulation.environment(task), simulation.act_as(task, behaviour), scenario)
