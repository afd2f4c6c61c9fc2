"""A rollout records one whole episode so that it can be replayed, redrawn and charged for."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from worker.sim.feeding import EPISODE_STEPS, FeedingEnv
from worker.sim.food import BALLS
from worker.sim.rollout import rollout
from worker.trajectory import Trajectory


@pytest.fixture(scope="module")
def env() -> Iterator[FeedingEnv]:
    environment = FeedingEnv()
    yield environment
    environment.close()


def wiggle(observation: np.ndarray) -> np.ndarray:
    """A deterministic policy that depends on the observation and leaves the action box."""
    return np.sin(20 * observation[:7] + np.arange(7)) * 1.5


def test_a_rollout_has_one_more_state_than_actions_and_clips_actions(env: FeedingEnv) -> None:
    trajectory = rollout(env, wiggle, scenario=3)
    assert len(trajectory) == EPISODE_STEPS
    assert trajectory.particles.shape == (EPISODE_STEPS + 1, BALLS, 3)
    assert np.abs(trajectory.actions).max() == 1.0
    assert (trajectory.scenario, trajectory.task) == (3, "feeding")


def test_recorded_actions_replay_the_recorded_observations_bit_identically(env: FeedingEnv) -> None:
    trajectory = rollout(env, wiggle, scenario=11)
    actions = iter(trajectory.actions)
    replayed = rollout(env, lambda _: next(actions), scenario=11)
    np.testing.assert_array_equal(replayed.observations, trajectory.observations)
    np.testing.assert_array_equal(replayed.particles, trajectory.particles)
    np.testing.assert_array_equal(replayed.signals, trajectory.signals)


def test_the_reference_is_asked_in_the_same_states(env: FeedingEnv) -> None:
    trajectory = rollout(env, wiggle, scenario=3, reference=lambda observation: observation[10:17])
    np.testing.assert_array_equal(trajectory.reference_actions, trajectory.observations[:-1, 10:17])


def test_without_a_reference_the_executed_actions_stand_in(env: FeedingEnv) -> None:
    trajectory = rollout(env, wiggle, scenario=3)
    np.testing.assert_array_equal(trajectory.reference_actions, trajectory.actions)


def test_a_rollout_survives_being_stored(env: FeedingEnv, tmp_path: Path) -> None:
    trajectory = rollout(env, wiggle, scenario=3)
    trajectory.save(tmp_path / "episode.npz")
    stored = Trajectory.load(tmp_path / "episode.npz")
    np.testing.assert_array_equal(stored.observations, trajectory.observations)
    assert stored.success is trajectory.success
