"""Food on a spoon: what Feeding adds to what every task promises (test_sim_environments.py)."""

from collections.abc import Iterator

import numpy as np
import pytest

from worker.ml.policies.gaussian import GaussianPolicy
from worker.sim.bullet import Bullet
from worker.sim.geometry import rotation_of
from worker.sim.jaco import JACO
from worker.tasks.feeding.environment import FEEDING, SPOON, START, FeedingEnv
from worker.tasks.feeding.food import BALLS
from worker.tasks.registry import checkpoint

EPISODE_STEPS = FEEDING.episode_steps
REFERENCE_POLICY = checkpoint("feeding") / "policy.safetensors"


@pytest.fixture(scope="module")
def env() -> Iterator[FeedingEnv]:
    environment = FeedingEnv()
    yield environment
    environment.close()


@pytest.fixture(scope="module")
def policy() -> GaussianPolicy:
    return GaussianPolicy.load(REFERENCE_POLICY)


def field(observation: np.ndarray, name: str) -> np.ndarray:
    return observation[..., FEEDING.observation.slice_of(name)]


def test_our_kinematics_agree_with_the_engines() -> None:
    world = Bullet()
    JACO.add_to(world, SPOON, mounted=False)
    postures = np.random.default_rng(0).uniform(-3, 3, (5, 7))
    frames = JACO.link_frames(postures, SPOON)
    names = [*(joint.link for joint in JACO.joints), SPOON.name]
    for posture, expected in zip(postures, frames, strict=True):
        world.set_joints("arm", posture)
        for name, frame in zip(names, expected, strict=True):
            origin, quaternion = world.link_pose("arm", name)
            np.testing.assert_allclose(frame[:3, 3], origin, atol=2e-6)
            np.testing.assert_allclose(frame[:3, :3], rotation_of(quaternion), atol=2e-6)
    world.close()


def test_food_stays_on_a_spoon_that_is_held_still(env: FeedingEnv) -> None:
    env.reset(seed=1)
    for _ in range(EPISODE_STEPS):
        observation, _, _, _, info = env.step(np.zeros(7, np.float32))
    assert (info["delivered"], info["spilled"]) == (0, 0)
    assert field(observation, "food_on_spoon") == 1.0
    assert np.isfinite(env.particles).all()


def test_turning_the_spoon_over_spills_everything_once(env: FeedingEnv) -> None:
    env.reset(seed=1)
    turn = np.array([0, 0, 0, 0, 0, 0, 1], np.float32)
    spilled = 0.0
    for _ in range(EPISODE_STEPS):
        observation, _, _, _, info = env.step(turn)
        spilled += info["signals"]["spilled"]
    assert spilled == info["spilled"] == BALLS
    assert field(observation, "food_on_spoon") == 0.0
    assert np.isnan(env.particles).all()


def test_food_falling_on_the_legs_counts_as_hitting_the_person_once_per_ball(env: FeedingEnv) -> None:
    env.reset(seed=1)
    lap = np.array([0.1, -0.2, 0.75]) + 0.02 * np.arange(BALLS)[:, None] * [0, 1, 0]
    for name, place in zip(env._portion.names, lap, strict=True):
        env._world.set_pose(name, place)
    hits = sum(env.step(np.zeros(7, np.float32))[4]["costs"]["C_fd"] for _ in range(30))
    assert 6 <= hits <= BALLS


def test_what_was_eaten_is_counted_observed_and_gone(env: FeedingEnv, policy: GaussianPolicy) -> None:
    observation, _ = env.reset(seed=1_000_002)
    intake = 0.0
    for _ in range(EPISODE_STEPS):
        observation, _, _, _, info = env.step(policy.mean(observation))
        intake += info["costs"]["C_fdv"]
    assert info["success"] is (info["delivered"] >= 6)
    assert info["delivered"] >= 6
    assert field(observation, "food_eaten")[0] == info["delivered"] / BALLS
    assert np.isnan(env.particles).all(1).sum() >= info["delivered"]
    assert info["signals"]["undelivered"] == 0.0
    assert 0.0 < intake < BALLS * 1.0


def test_pressing_the_hand_into_the_person_is_force_away_from_the_mouth(env: FeedingEnv) -> None:
    env.reset(seed=2)
    posture = env.joint_positions
    chest = JACO.in_base_frame(np.array([[0.0, -0.02, 0.85]]))
    towards_person = JACO.mount_rotation.T @ np.array(START.tool_axes).T
    reached, error = JACO.solve_pose(posture[None], chest, towards_person, SPOON, 200)
    assert error[0] < 0.05
    away, at_target = 0.0, 0.0
    for _ in range(60):
        action = np.clip((reached[0] - env.joint_positions) / 0.05, -1, 1).astype(np.float32)
        *_, info = env.step(action)
        away = max(away, info["signals"]["force_away_n"])
        at_target = max(at_target, info["signals"]["force_at_target_n"])
    assert away > 1.0
    assert at_target == 0.0
    assert info["costs"]["C_f"] == info["signals"]["force_away_n"]
