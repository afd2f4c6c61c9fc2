"""What the Feeding environment promises to policies, to recordings and to whoever replays them."""

import subprocess
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as check_env_for_sb3

import worker
from worker.ml.policies import GaussianPolicy
from worker.sim import FEEDING, human, jaco
from worker.sim.bullet import Bullet, rotation_of
from worker.sim.feeding import (
    BASE_ROTATION,
    EPISODE_STEPS,
    PERSON_PARTS,
    START_CENTRE_M,
    START_RANGE_M,
    FeedingEnv,
    add_person,
    start_postures,
)
from worker.sim.food import BALLS
from worker.spaces import FEEDING_OBSERVATION
from worker.trajectory import SIGNALS

REFERENCE_POLICY = Path(worker.__file__).parent / "checkpoints" / "feeding" / "policy.safetensors"


@pytest.fixture(scope="module")
def env() -> Iterator[FeedingEnv]:
    environment = FeedingEnv()
    yield environment
    environment.close()


@pytest.fixture(scope="module")
def policy() -> GaussianPolicy:
    return GaussianPolicy.load(REFERENCE_POLICY)


def episode(env: FeedingEnv, scenario: int, policy: GaussianPolicy, noise: float = 0.3) -> np.ndarray:
    """Observations and rewards of an episode with a policy disturbed in a way that depends on the scenario only."""
    rng = np.random.default_rng(scenario)
    observation, _ = env.reset(seed=scenario)
    seen = [np.append(observation, 0.0)]
    for _ in range(EPISODE_STEPS):
        action = policy.mean(observation) + noise * rng.standard_normal(7)
        observation, reward, *_ = env.step(action.astype(np.float32))
        seen.append(np.append(observation, reward))
    return np.array(seen)


def field(observation: np.ndarray, name: str) -> np.ndarray:
    return observation[..., FEEDING_OBSERVATION.slice_of(name)]


def test_it_passes_gymnasiums_checker_without_a_warning() -> None:
    made = gymnasium.make(FEEDING)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(made.unwrapped)
    made.close()


def test_it_passes_stable_baselines_checker_without_a_warning() -> None:
    environment = FeedingEnv()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env_for_sb3(environment)
    environment.close()


def test_an_episode_is_truncated_after_exactly_one_hundred_steps(env: FeedingEnv) -> None:
    env.reset(seed=0)
    ends = [env.step(np.zeros(7, np.float32))[2:4] for _ in range(EPISODE_STEPS)]
    assert ends == [(False, False)] * 99 + [(False, True)]


def test_stepping_before_the_first_reset_is_refused() -> None:
    environment = FeedingEnv()
    with pytest.raises(gymnasium.error.ResetNeeded):
        environment.step(np.zeros(7, np.float32))
    environment.close()


def test_a_closed_environment_says_so_and_closes_twice() -> None:
    environment = FeedingEnv()
    environment.close()
    environment.close()
    with pytest.raises(RuntimeError, match="closed"):
        environment.reset(seed=0)


def test_the_same_seed_replays_bit_identically_after_other_episodes(env: FeedingEnv, policy: GaussianPolicy) -> None:
    scenarios = (3, 1_000_001, 17)
    first = {scenario: episode(env, scenario, policy) for scenario in scenarios}
    for scenario in reversed(scenarios):
        np.testing.assert_array_equal(episode(env, scenario, policy), first[scenario])


def test_the_same_seed_replays_bit_identically_in_a_fresh_process(env: FeedingEnv, policy: GaussianPolicy) -> None:
    program = (
        "import sys; from tests.worker.test_sim_feeding import *;"
        "e = FeedingEnv(); o = episode(e, 5, GaussianPolicy.load(REFERENCE_POLICY));"
        "sys.stdout.buffer.write(b'BEGIN' + o.tobytes())"
    )
    output = subprocess.run([sys.executable, "-c", program], capture_output=True, check=True).stdout
    replayed = np.frombuffer(output.split(b"BEGIN", 1)[1])
    np.testing.assert_array_equal(replayed, episode(env, 5, policy).ravel())


def test_different_seeds_are_different_scenarios(env: FeedingEnv) -> None:
    observations = np.array([env.reset(seed=scenario)[0] for scenario in range(20)])
    assert len(np.unique(field(observations, "neck_to_mouth_m"), axis=0)) == 20
    assert len(np.unique(field(observations, "spoon_position_m"), axis=0)) > 15


def test_resetting_without_a_seed_continues_the_generator_of_the_last_seed(env: FeedingEnv) -> None:
    def scenarios() -> list[int]:
        env.reset(seed=9)
        return [env.reset()[1]["scenario"] for _ in range(3)]

    first = scenarios()
    assert first == scenarios()
    assert len(set(first)) == 3


@pytest.mark.parametrize("moment", [1, 20, 70])
def test_restoring_a_saved_moment_continues_bit_identically(
    env: FeedingEnv, policy: GaussianPolicy, moment: int
) -> None:
    def play(steps: int, observation: np.ndarray) -> list[np.ndarray]:
        seen = []
        for _ in range(steps):
            observation, reward, *_ = env.step(policy.mean(observation))
            seen.append(np.append(observation, reward))
        return seen

    observation, _ = env.reset(seed=4)
    for _ in range(moment):
        observation, *_ = env.step(policy.mean(observation))
    state = env.save_state()
    first = play(25, observation)
    env.reset(seed=99)
    restored = env.restore_state(state)
    np.testing.assert_array_equal(restored, observation)
    np.testing.assert_array_equal(play(25, restored), first)


def test_start_postures_hold_the_spoon_level_near_the_start_and_clear_of_the_person() -> None:
    world = Bullet()
    jaco.add_to(world)
    add_person(world)
    for posture in start_postures()[::16]:
        world.set_joints("arm", posture)
        origin, quaternion = world.link_pose("arm", jaco.SPOON_LINK)
        assert np.abs(origin - START_CENTRE_M).max() < START_RANGE_M + 1e-3
        assert rotation_of(quaternion)[2, 2] > 0.9999
        assert min(world.clearance_m("arm", part, 0.3) for part in PERSON_PARTS) > 0.05
        assert (posture > jaco.LOWER_RAD + 0.1).all()
        assert (posture < jaco.UPPER_RAD - 0.1).all()
    world.close()


def test_our_kinematics_agree_with_the_engines() -> None:
    world = Bullet()
    jaco.add_to(world, at_home=False)
    postures = np.random.default_rng(0).uniform(-3, 3, (5, 7))
    frames = jaco.link_frames(postures)
    names = [*(joint.link for joint in jaco.JOINTS), jaco.SPOON_LINK]
    for posture, expected in zip(postures, frames, strict=True):
        world.set_joints("arm", posture)
        for name, frame in zip(names, expected, strict=True):
            origin, quaternion = world.link_pose("arm", name)
            np.testing.assert_allclose(frame[:3, 3], origin, atol=2e-6)
            np.testing.assert_allclose(frame[:3, :3], rotation_of(quaternion), atol=2e-6)
    world.close()


def test_observations_are_in_the_robots_base_frame_and_agree_with_each_other(
    env: FeedingEnv, policy: GaussianPolicy
) -> None:
    observation, _ = env.reset(seed=8)
    for _ in range(15):
        observation, *_ = env.step(policy.mean(observation))
    spoon = jaco.link_frames(field(observation, "joint_positions_rad").astype(float)[None])[0, -1]
    np.testing.assert_allclose(field(observation, "spoon_position_m"), spoon[:3, 3], atol=1e-5)
    np.testing.assert_allclose(field(observation, "spoon_forward"), spoon[:3, 0], atol=1e-5)
    np.testing.assert_allclose(field(observation, "spoon_up"), spoon[:3, 2], atol=1e-5)
    head = rotation_of(env.head_quaternion)
    np.testing.assert_allclose(
        field(observation, "face_direction"), BASE_ROTATION.T @ head @ human.FACE_IN_HEAD, atol=1e-6
    )
    mouth = human.NECK_PIVOT_M + head @ human.MOUTH_FROM_NECK_M
    seen = field(observation, "spoon_position_m") + field(observation, "spoon_to_mouth_m")
    np.testing.assert_allclose(BASE_ROTATION @ seen + jaco.ROBOT_BASE_M, mouth, atol=1e-5)


def test_food_stays_on_a_spoon_that_is_held_still(env: FeedingEnv) -> None:
    env.reset(seed=1)
    for _ in range(EPISODE_STEPS):
        observation, _, _, _, info = env.step(np.zeros(7, np.float32))
    assert (info["eaten"], info["spilled"]) == (0, 0)
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
    assert info["success"] is (info["eaten"] >= 6)
    assert info["eaten"] >= 6
    assert field(observation, "food_eaten")[0] == info["eaten"] / BALLS
    assert np.isnan(env.particles).all(1).sum() >= info["eaten"]
    assert info["signals"]["undelivered"] == 0.0
    assert 0.0 < intake < BALLS * 1.0


def test_pressing_the_hand_into_the_person_is_force_away_from_the_mouth(env: FeedingEnv) -> None:
    env.reset(seed=2)
    posture = env.joint_positions
    reached, error = jaco.solve_spoon_pose(
        posture[None],
        ((np.array([[0.0, -0.02, 0.85]]) - jaco.ROBOT_BASE_M) @ BASE_ROTATION),
        BASE_ROTATION.T @ np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
        200,
    )
    assert error[0] < 0.05
    away, at_target = 0.0, 0.0
    for _ in range(60):
        action = np.clip((reached[0] - env.joint_positions) / 0.05, -1, 1).astype(np.float32)
        *_, info = env.step(action)
        away = max(away, info["signals"]["force_away_n"])
        at_target = max(at_target, info["signals"]["force_at_target_n"])
        total = info["signals"]["force_away_n"] + info["signals"]["force_at_target_n"]
        assert info["contact_force_n"] == pytest.approx(total, rel=1e-5)
    assert away > 1.0
    assert at_target == 0.0
    assert info["costs"]["C_f"] == info["signals"]["force_away_n"]


def test_measured_speed_is_the_distance_the_spoon_travelled(env: FeedingEnv, policy: GaussianPolicy) -> None:
    observation, _ = env.reset(seed=6)
    for _ in range(12):
        before = field(observation, "spoon_position_m")
        observation, _, _, _, info = env.step(policy.mean(observation))
        travelled = np.linalg.norm(field(observation, "spoon_position_m") - before) / 0.1
        assert info["signals"]["speed_m_s"] == pytest.approx(travelled, rel=0.25, abs=0.02)


def test_every_step_reports_every_signal_as_a_finite_number(env: FeedingEnv, policy: GaussianPolicy) -> None:
    observation, _ = env.reset(seed=7)
    for _ in range(EPISODE_STEPS):
        observation, _, _, _, info = env.step(policy.mean(observation))
        assert tuple(info["signals"]) == SIGNALS
        assert np.isfinite(list(info["signals"].values())).all()
        assert min(*info["costs"].values()) >= 0.0
        assert env.observation_space.contains(observation)
