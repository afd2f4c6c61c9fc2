"""Water in a cup: what Drinking adds to what every task promises (test_sim_environments.py)."""

from collections.abc import Iterator

import numpy as np
import pytest
import torch

from worker.ml.policies.gaussian import GaussianPolicy
from worker.sim.assistive import ACTION_UNIT_RAD
from worker.sim.jaco import JACO
from worker.tasks.drinking.demonstrator import ScriptedPouring
from worker.tasks.drinking.environment import (
    CUP,
    CUP_BASE_RADIUS_M,
    CUP_HEIGHT_M,
    CUP_RIM_RADIUS_M,
    DRINKING,
    PELLETS,
    DrinkingEnv,
    pellet_radius_m,
)
from worker.tasks.drinking.water import Cup
from worker.tasks.registry import checkpoint

REFERENCE_POLICY = checkpoint("drinking") / "policy.safetensors"
STILL = np.zeros(7, np.float32)
TIP = np.array([0, 0, 0, 0, 0, 0, 1], np.float32)
SWING = np.array([1, 0, 0, 0, 0, 0, 0], np.float32)
FAR_AWAY_M = np.array([1.0, -1.0, 0.7])


@pytest.fixture(scope="module")
def env() -> Iterator[DrinkingEnv]:
    environment = DrinkingEnv()
    yield environment
    environment.close()


@pytest.fixture(scope="module")
def policy() -> GaussianPolicy:
    return GaussianPolicy.load(REFERENCE_POLICY)


def field(observation: np.ndarray, name: str) -> float:
    return float(observation[DRINKING.observation.slice_of(name)][0])


def put(env: DrinkingEnv, pellet: int, place_m: np.ndarray) -> None:
    env._world.set_pose(env._water.names[pellet], place_m)


@pytest.mark.parametrize("pellets", [16, 32, 64])
def test_no_pellet_leaves_a_cup_that_is_swung_about_without_being_tipped(pellets: int) -> None:
    env = DrinkingEnv(pellets=pellets)
    env.reset(seed=1)
    for step in range(60):
        direction = 1.0 if step // 6 % 2 else -1.0
        observation, *_, info = env.step(0.7 * direction * SWING)
    assert info["spilled"] == 0
    assert field(observation, "water_in_cup") == 1.0
    env.close()


def test_water_in_a_cup_held_still_hardly_moves(env: DrinkingEnv) -> None:
    env.reset(seed=1)
    before = env.particles
    for _ in range(10):
        env.step(STILL)
    assert np.linalg.norm(env.particles - before, axis=1).mean() < 0.006


def test_a_tipped_cup_pours_over_its_rim_and_everything_is_spilled_once(env: DrinkingEnv) -> None:
    env.reset(seed=1)
    tilts, left, spilled = [], [], 0
    for _ in range(60):
        observation, *_, info = env.step(TIP)
        tilts.append(info["signals"]["tilt_rad"])
        left.append(field(observation, "water_in_cup"))
        spilled += info["signals"]["spilled"]
    assert spilled == info["spilled"] == PELLETS
    assert left[-1] == 0.0
    first = next(tilt for tilt, share in zip(tilts, left, strict=True) if share < 1.0)
    assert 0.8 < first < 1.6
    assert any(0.2 < share < 0.8 for share in left)
    assert info["signals"]["undelivered"] == 1.0


def test_a_pellet_that_falls_into_the_mouth_is_drunk_once_with_its_speed(env: DrinkingEnv) -> None:
    env.reset(seed=2)
    above = env.target_m + 0.02 * env._outward + (0.0, 0.0, 0.06)
    put(env, 0, above)
    drunk, intake = 0, 0.0
    for _ in range(5):
        observation, *_, info = env.step(STILL)
        intake += info["costs"]["C_fdv"]
        drunk += info["delivered"]
    # It falls at least 6 - 3 cm before it is within 3 cm of the mouth and at most 6 cm.
    assert np.sqrt(2 * 9.81 * 0.03) - 0.1 < intake < np.sqrt(2 * 9.81 * 0.07)
    assert info["delivered"] == 1
    assert field(observation, "water_drunk") == pytest.approx(1 / PELLETS)
    assert np.isnan(env.particles[0]).all()
    assert np.isfinite(env.particles[1:]).all()


def test_water_inside_the_cup_is_not_drunk_however_close_the_mouth(env: DrinkingEnv) -> None:
    env.reset(seed=2)
    reached = env._water.at_mouth(env.particles[0])
    assert reached
    env._water.drink(reached, env.particles[0], env._tool, env._tool_rotation)
    assert not env.step(STILL)[4]["delivered"]


def test_a_pellet_on_the_lap_touches_the_person_once_and_was_spilled_once(env: DrinkingEnv) -> None:
    env.reset(seed=1)
    put(env, 0, np.array([0.1, -0.2, 0.63]))
    steps = [env.step(STILL)[4] for _ in range(20)]
    assert sum(info["costs"]["C_fd"] for info in steps) == 1
    assert sum(info["signals"]["spilled"] for info in steps) == 1
    assert steps[-1]["delivered"] == 0


def test_what_has_been_spilled_cannot_be_drunk_afterwards(env: DrinkingEnv) -> None:
    env.reset(seed=1)
    put(env, 0, FAR_AWAY_M)
    env.step(STILL)
    put(env, 0, env.target_m + 0.02 * env._outward)
    info = env.step(STILL)[4]
    assert (info["delivered"], info["spilled"]) == (0, 1)


def test_water_on_the_floor_is_gone(env: DrinkingEnv) -> None:
    env.reset(seed=1)
    put(env, 0, FAR_AWAY_M)
    for _ in range(8):
        env.step(STILL)
    assert np.isnan(env.particles).all(1).tolist() == [True] + [False] * (PELLETS - 1)


def test_inside_and_distance_of_the_cup_are_those_of_its_measures() -> None:
    cup = Cup(CUP_BASE_RADIUS_M, CUP_RIM_RADIUS_M, CUP_HEIGHT_M)
    middle = np.array([-CUP_RIM_RADIUS_M, 0.0, -CUP_HEIGHT_M / 2])
    points = middle + np.array([[0, 0, 0], [0, 0, 0.039], [0, 0, 0.041], [0.033, 0, 0], [0.045, 0, 0], [0, 0.2, 0]])
    assert cup.contains(points).tolist() == [True, True, False, True, False, False]
    np.testing.assert_allclose(cup.distance_m(points[-1:]), 0.2 - CUP_RIM_RADIUS_M)


def test_any_number_of_pellets_is_the_same_amount_of_water() -> None:
    volumes = [pellets * pellet_radius_m(pellets) ** 3 for pellets in (16, 32, 64)]
    np.testing.assert_allclose(volumes, volumes[0])


@pytest.mark.parametrize("pellets", [0, 15, 65])
def test_too_few_or_too_many_pellets_are_refused(pellets: int) -> None:
    with pytest.raises(ValueError, match="from 16 to 64"):
        DrinkingEnv(pellets=pellets)


def test_the_scripted_pourer_gives_to_drink_gently(env: DrinkingEnv) -> None:
    pourer = ScriptedPouring(DRINKING.observation, JACO, CUP, ACTION_UNIT_RAD)
    for scenario in (5000, 5001):
        observation, _ = env.reset(seed=scenario)
        force = 0.0
        for _ in range(DRINKING.episode_steps):
            observation, *_, info = env.step(pourer(observation))
            force = max(force, info["contact_force_n"])
        assert info["success"]
        assert force < 20.0


def test_the_reference_policy_gives_to_drink_gently(env: DrinkingEnv, policy: GaussianPolicy) -> None:
    outcomes = []
    for scenario in range(1_000_000, 1_000_005):
        observation, _ = env.reset(seed=scenario)
        force = 0.0
        for _ in range(DRINKING.episode_steps):
            observation, *_, info = env.step(policy.mean(observation))
            force = max(force, info["contact_force_n"])
        outcomes.append((info["success"], force))
    assert sum(success for success, _ in outcomes) >= 4
    assert np.mean([force for _, force in outcomes]) < 10.0


def test_restoring_a_moment_in_mid_pour_continues_bit_identically(env: DrinkingEnv, policy: GaussianPolicy) -> None:
    observation, _ = env.reset(seed=4)
    while field(observation, "water_in_cup") > 0.8 or field(observation, "water_drunk") == 0.0:
        observation, *_ = env.step(policy.mean(observation))
    state = env.save_state()

    def pour_on(environment: DrinkingEnv, seen: np.ndarray) -> np.ndarray:
        places = []
        for _ in range(15):
            seen, *_ = environment.step(policy.mean(seen))
            places.append(environment.particles)
        return np.array(places)

    first = pour_on(env, observation)
    other = DrinkingEnv()
    restored = other.restore_state(state)
    np.testing.assert_array_equal(restored, observation)
    np.testing.assert_array_equal(pour_on(other, restored), first)
    other.close()


def seen_at(distance_m: float, tilt_rad: float) -> np.ndarray:
    """An observation with the cup tipped along the base's x axis, so far from the mouth."""
    observation = np.zeros(DRINKING.observation.size, np.float32)
    for name, value in {
        "tool_forward": (np.cos(tilt_rad), 0, -np.sin(tilt_rad)),
        "tool_up": (np.sin(tilt_rad), 0, np.cos(tilt_rad)),
        "tool_to_target_m": (distance_m, 0, 0),
        "target_outward": (-1, 0, 0),
        "joint_positions_rad": (0, 0, 0, 0, 0, 0, 1.0),
    }.items():
        observation[DRINKING.observation.slice_of(name)] = value
    return observation


def mode(**axes: float) -> np.ndarray:
    return np.array([axes.get(name, 0.0) for name in DRINKING.modes.names], np.float32)


def test_the_reference_mode_leaves_the_policy_alone() -> None:
    observation = seen_at(0.03, 1.0)
    np.testing.assert_allclose(DRINKING.modes.perceived(observation, mode()), observation, atol=1e-7)
    np.testing.assert_allclose(DRINKING.modes.speed_factor(observation, mode()), 1.0)


@pytest.mark.parametrize(("axis", "distance_m"), [("pour_angle", 0.03), ("tip_early", 0.30)])
def test_a_cup_to_be_tipped_further_looks_less_tipped_to_the_policy(axis: str, distance_m: float) -> None:
    perceived = DRINKING.modes.perceived(seen_at(distance_m, 1.0), mode(**{axis: 0.2}))
    expected = seen_at(distance_m, 0.8)
    expected[DRINKING.observation.slice_of("joint_positions_rad")][-1] = 0.8
    np.testing.assert_allclose(perceived, expected, atol=1e-6)


def test_haste_counts_at_the_mouth_and_speed_before_it() -> None:
    hasty = mode(pour_haste=0.4, speed_far=-1.0, speed_near=-1.0)
    np.testing.assert_allclose(DRINKING.modes.speed_factor(seen_at(0.03, 1.0), hasty), np.exp(0.4), rtol=1e-6)
    np.testing.assert_allclose(DRINKING.modes.speed_factor(seen_at(0.30, 0.5), hasty), np.exp(-1.0), rtol=1e-6)


def test_modes_are_the_same_in_numpy_and_torch() -> None:
    rng = np.random.default_rng(0)
    observations = np.stack([seen_at(distance, tilt) for distance, tilt in rng.uniform(0.02, 1.2, (20, 2))])
    modes = DRINKING.modes.sample(20, rng).astype(np.float32)
    pairs = [
        (function(observations, modes), function(torch.from_numpy(observations), torch.from_numpy(modes), torch))
        for function in (DRINKING.modes.perceived, DRINKING.modes.speed_factor)
    ]
    for in_numpy, in_torch in pairs:
        np.testing.assert_allclose(in_numpy, in_torch.numpy(), atol=1e-6)
