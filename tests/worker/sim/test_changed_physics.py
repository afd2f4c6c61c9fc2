"""The worlds in which filters are tried without having been fitted there."""

import numpy as np
import pytest

from tests.benchmarks.changed_physics import CHANGES, Change, changed_environment
from worker.compute import simulation
from worker.domain.trajectory import Trajectory
from worker.domain.type_aliases import FloatArray
from worker.sim.assistive import AssistiveEnv
from worker.sim.engine import pybullet
from worker.sim.rollout import rollout
from worker.tasks import registry

SCENARIO = 9_500_001


def driven(env: AssistiveEnv, scenario: int = SCENARIO) -> Trajectory:
    return rollout(env, simulation.reference_policy(env.task.name).mean, scenario)


@pytest.fixture(scope="module")
def usual() -> Trajectory:
    return driven(registry.environment_class("scratching")())


def test_with_nothing_changed_it_is_the_usual_world(usual: Trajectory) -> None:
    same = driven(changed_environment("scratching", Change()))
    assert np.array_equal(same.observations, usual.observations)
    assert np.array_equal(same.signals, usual.signals)


@pytest.mark.parametrize("change", [name for name in CHANGES if name != "nothing"])
def test_every_change_makes_a_difference(change: str, usual: Trajectory) -> None:
    changed = driven(changed_environment("scratching", CHANGES[change]))
    assert not np.array_equal(changed.observations, usual.observations)


@pytest.mark.parametrize("task", ["feeding", "drinking", "scratching"])
def test_everything_is_changed_and_what_stays_for_the_next_episode_only_once(task: str) -> None:
    usual, changed = registry.environment_class(task)(), changed_environment(task, Change(friction=3.0, mass=2.0))
    for scenario in (1, 2, 3):
        changed.reset(seed=scenario)
    usual.reset(seed=3)
    assert masses_and_frictions(changed) == pytest.approx(masses_and_frictions(usual) * [2.0, 3.0])


def masses_and_frictions(env: AssistiveEnv) -> FloatArray:
    """(N, 2) of every link of every body, in the order of their names."""
    world = env._world
    links = [
        (body, link)
        for _, body in sorted(world._bodies.items())
        for link in range(-1, pybullet.getNumJoints(body, physicsClientId=world.client))
    ]
    return np.array([pybullet.getDynamicsInfo(*each, physicsClientId=world.client)[:2] for each in links])


def test_actions_come_one_step_late() -> None:
    moved = np.abs(np.diff(driven(changed_environment("feeding", Change(delay_steps=1))).joint_positions, axis=0))
    usual = np.abs(np.diff(driven(changed_environment("feeding", Change())).joint_positions, axis=0))
    assert moved[0].max() < 0.01 < usual[0].max()
