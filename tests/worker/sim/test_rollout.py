"""A rollout records one whole episode so that it can be replayed, redrawn and charged for."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from worker.domain.trajectory import OutdatedTrajectory, Trajectory
from worker.sim.rollout import rollout
from worker.tasks.feeding.environment import FEEDING, FeedingEnv
from worker.tasks.feeding.food import BALLS

EPISODE_STEPS = FEEDING.episode_steps


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
    trajectory = rollout(env, wiggle, scenario=3, reference=lambda observations: observations[:, 10:17])
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


def test_a_rollout_remembers_who_sat_there_and_where_everything_was(env: FeedingEnv) -> None:
    trajectory = rollout(env, wiggle, scenario=3)
    assert (trajectory.body, trajectory.skin_tone) == (env.person.body.name, env.person.skin_tone)
    np.testing.assert_allclose(trajectory.arm_positions_rad[7], env.person.arms_rad, atol=1e-6)
    np.testing.assert_allclose(trajectory.target_m[7], env.target_m, atol=1e-6)
    assert (trajectory.head_quaternions == trajectory.head_quaternions[0]).all()


def test_a_recording_of_an_older_version_says_what_it_lacks_and_what_to_do(env: FeedingEnv, tmp_path: Path) -> None:
    rollout(env, wiggle, scenario=3).save(tmp_path / "episode.npz")
    with np.load(tmp_path / "episode.npz") as stored:
        older = {name: array for name, array in stored.items() if name != "target_m"}
    np.savez(tmp_path / "older.npz", **older)
    with pytest.raises(OutdatedTrajectory, match="lacks target_m: an older version"):
        Trajectory.load(tmp_path / "older.npz")
