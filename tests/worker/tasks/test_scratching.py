"""The yielding arm and the counting of strokes: what Itch Scratching adds to what every task promises."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from worker.ml.policies.gaussian import GaussianPolicy
from worker.sim import human
from worker.sim.bullet import Bullet
from worker.sim.geometry import rotation_of
from worker.sim.human import BODY_SHAPES, RIGHT, Person, draw_person
from worker.sim.measures import HIGH_FORCE_N
from worker.sim.seated_person import PERSON
from worker.tasks.registry import checkpoint
from worker.tasks.scratching.environment import (
    BARE_SKIN,
    SCRATCHING,
    STROKES_NEEDED,
    TIP_RADIUS_M,
    Scratch,
    ScratchingEnv,
)
from worker.tasks.scratching.yielding_arm import FOREARM, UPPER_ARM, YieldingArm

REFERENCE_POLICY = checkpoint("scratching") / "policy.safetensors"


@pytest.fixture(scope="module")
def env() -> Iterator[ScratchingEnv]:
    environment = ScratchingEnv()
    yield environment
    environment.close()


@pytest.fixture
def world() -> Iterator[Bullet]:
    bullet = Bullet(gravity_m_s2=0.0)
    yield bullet
    bullet.close()


def field(observation: np.ndarray, name: str) -> np.ndarray:
    part: np.ndarray = observation[..., SCRATCHING.observation.slice_of(name)]
    return part


def someone(impairment: human.Impairment = "none", scenario: int = 0) -> Person:
    return draw_person(np.random.default_rng(scenario), impairments=(impairment,), right_arm=ScratchingEnv.right_arm)


def reach(env: ScratchingEnv, offset_m: np.ndarray) -> np.ndarray:
    """The action that leads the tip, in its present orientation, to a place relative to the itch."""
    away = env.target_m + offset_m - env._tool
    away *= min(1.0, 0.03 / max(float(np.linalg.norm(away)), 1e-9))
    goal = env.robot.in_base_frame((env._tool + away)[None])
    orientation = env.robot.link_frames(env._command[None], env.tool)[0, -1, :3, :3]
    wanted, _ = env.robot.solve_pose(env._command[None], goal, orientation, env.tool, 6)
    action: np.ndarray = np.clip((wanted[0] - env._command) / 0.05, -1, 1).astype(np.float32)
    return action


def scratch(env: ScratchingEnv, scenario: int, depth_m: float, sweep_m: float = 0.02) -> list[dict[str, Any]]:
    """A scripted robot that rubs to and fro along the limb, with the tip's centre so deep below a resting one."""
    env.reset(seed=scenario)
    infos, touching = [], 0
    for _ in range(SCRATCHING.episode_steps):
        height = TIP_RADIUS_M - depth_m if touching else 0.06
        sweep = sweep_m * np.sin(2 * np.pi * touching / 8)
        offset = height * env._outward - sweep * env._limb[:, 2]
        touching += bool(touching or np.linalg.norm(env.target_m + offset - env._tool) < 0.02)
        infos.append(env.step(reach(env, offset))[4])
    return infos


# Counting, by hand


def test_a_stroke_counts_once_the_touch_has_moved_by_more_than_a_centimetre() -> None:
    counted = Scratch()
    along = [0.0, 0.004, 0.009, 0.011, 0.020, 0.022, 0.012]
    strokes = [counted.rub(np.array([0.0, 0.0, z]), 2.0) for z in along]
    # The first touch counts; then .011 (from 0), .022 (from .011); .012 is exactly one centimetre back.
    assert strokes == [True, False, False, True, False, True, False]
    assert counted.strokes == 3


@pytest.mark.parametrize(("force", "counts"), [(0.0, False), (0.29, False), (0.3, True), (9.9, True), (10.0, False)])
def test_only_a_touch_that_is_felt_and_gentle_counts(force: float, counts: bool) -> None:
    assert Scratch().rub(np.zeros(3), force) is counts


def test_touching_nothing_or_elsewhere_counts_nothing_but_its_force_is_remembered() -> None:
    counted = Scratch()
    assert not counted.rub(None, 12.0)
    assert (counted.strokes, counted.peak_force_n) == (0, 12.0)


# The arm


@pytest.mark.parametrize("body", BODY_SHAPES)
def test_the_chain_is_where_the_persons_arm_is(world: Bullet, body: str) -> None:
    person = draw_person(np.random.default_rng(5), bodies=(body,), right_arm=ScratchingEnv.right_arm)
    arm = YieldingArm(world, person)
    shoulder, elbow, *_ = human.arm_points_m(person.body, person.arms_rad[RIGHT], RIGHT)
    np.testing.assert_allclose(arm.angles_rad(), person.arms_rad[RIGHT], atol=1e-9)
    for limb, joint, turn in (
        (UPPER_ARM, shoulder, human.upper_arm_rotation),
        (FOREARM, elbow, human.forearm_rotation),
    ):
        origin, quaternion = world.link_pose(PERSON, limb)
        np.testing.assert_allclose(origin, joint, atol=1e-6)
        np.testing.assert_allclose(rotation_of(quaternion), turn(person.arms_rad[RIGHT], RIGHT), atol=1e-6)


def test_left_alone_the_arm_does_not_move(world: Bullet) -> None:
    arm = YieldingArm(world, someone())
    before = arm.angles_rad()
    for _ in range(100):
        world.step()
    np.testing.assert_allclose(arm.angles_rad(), before, atol=1e-6)


def displaced(world: Bullet, impairment: human.Impairment = "none") -> tuple[YieldingArm, np.ndarray]:
    arm = YieldingArm(world, someone(impairment))
    rest = arm.angles_rad()
    flexion, abduction, rotation, elbow = rest + 0.2
    world.set_joints(PERSON, [abduction, flexion, rotation, elbow])
    return arm, rest


def test_a_displaced_arm_comes_back_within_a_second(world: Bullet) -> None:
    arm, rest = displaced(world)
    for _ in range(50):
        world.step()
    assert np.abs(arm.angles_rad() - rest).max() < 0.02


def test_a_weak_arm_comes_back_more_slowly(world: Bullet) -> None:
    left = []
    for impairment in ("none", "weakness"):
        world.clear()
        arm, rest = displaced(world, impairment)
        for _ in range(8):
            world.step()
        left.append(np.abs(arm.angles_rad() - rest).sum())
    assert left[1] > left[0]


def test_a_trembling_arm_shakes_and_the_itch_with_it() -> None:
    spread = {}
    for impairment in ("none", "tremor"):
        environment = ScratchingEnv(impairments=(impairment,))
        environment.reset(seed=1)
        places = []
        for _ in range(20):
            environment.step(np.zeros(7, np.float32))
            places.append(environment.target_m)
        spread[impairment] = np.ptp(places, axis=0).max()
        environment.close()
    assert spread["none"] < 1e-4
    assert 0.002 < spread["tremor"] < 0.1


def test_the_arm_gives_way_to_the_tool_and_the_itch_moves_with_it(env: ScratchingEnv) -> None:
    scratch(env, 0, depth_m=0.01)
    given_way = np.degrees(np.abs(env.arm_positions_rad[RIGHT] - env.person.arms_rad[RIGHT]).max())
    assert 1.0 < given_way < 15.0
    origin, quaternion = env._world.link_pose(PERSON, env._itch.limb)
    np.testing.assert_allclose(env.target_m, origin + rotation_of(quaternion) @ env._itch.place_m, atol=1e-9)
    np.testing.assert_array_equal(env.arm_positions_rad[human.LEFT], env.person.arms_rad[human.LEFT])


# The itch


def test_itches_are_on_bare_skin_of_both_limbs_on_the_side_of_the_robot(env: ScratchingEnv) -> None:
    limbs = []
    for scenario in range(60):
        env.reset(seed=scenario)
        itch, arm = env._itch, env._arm
        limbs.append(itch.limb)
        low, high = BARE_SKIN[itch.limb]
        assert low <= -itch.place_m[2] / arm.length_m(itch.limb) <= high
        assert np.hypot(*itch.place_m[:2]) == pytest.approx(arm.radius_m(itch.limb))
        assert float(env._outward @ env._limb[:, 2]) == pytest.approx(0.0, abs=1e-6)
    assert 20 <= limbs.count(FOREARM) <= 40


# Scratching


def test_rubbing_gently_succeeds(env: ScratchingEnv) -> None:
    infos = scratch(env, 0, depth_m=0.005)
    touching = [info["signals"]["force_at_target_n"] for info in infos if info["signals"]["force_at_target_n"] > 0]
    assert infos[-1]["success"]
    assert infos[-1]["strokes"] >= STROKES_NEEDED
    assert np.mean(touching) < 4.0
    assert sum(info["costs"]["C_hf"] for info in infos) == 0.0


def test_rubbing_as_often_but_too_hard_fails_and_costs(env: ScratchingEnv) -> None:
    infos = scratch(env, 0, depth_m=0.02)
    hard = [
        info["signals"]["force_at_target_n"] for info in infos if info["signals"]["force_at_target_n"] >= HIGH_FORCE_N
    ]
    assert hard
    assert not infos[-1]["success"]
    assert sum(info["costs"]["C_hf"] for info in infos) == pytest.approx(sum(hard))


def test_resting_on_the_itch_is_no_scratching(env: ScratchingEnv) -> None:
    infos = scratch(env, 0, depth_m=0.005, sweep_m=0.0)
    assert infos[-1]["strokes"] <= 3
    assert infos[-1]["signals"]["force_at_target_n"] > 0.5
    assert infos[-1]["signals"]["undelivered"] == 1.0


def test_what_was_scratched_is_observed(env: ScratchingEnv) -> None:
    scratch(env, 0, depth_m=0.005)
    observation = env._observe()
    assert field(observation, "strokes")[0] == 1.0
    assert np.linalg.norm(field(observation, "tip_to_last_stroke_m")) < 0.06
    limb = env.robot.mount_rotation @ field(observation, "limb_direction")
    shoulder, elbow, wrist, _ = human.arm_points_m(env.person.body, env.arm_positions_rad[RIGHT], RIGHT)
    bone = elbow - shoulder if env._itch.limb == UPPER_ARM else wrist - elbow
    np.testing.assert_allclose(limb, bone / np.linalg.norm(bone), atol=1e-5)


def test_nothing_is_fed_or_spilled_here(env: ScratchingEnv) -> None:
    infos = scratch(env, 1, depth_m=0.005)
    assert {info["costs"]["C_fd"] for info in infos} == {info["costs"]["C_fdv"] for info in infos} == {0}
    assert env.particles.shape == (0, 3)


# The policy


@pytest.fixture(scope="module")
def policy() -> GaussianPolicy:
    return GaussianPolicy.load(REFERENCE_POLICY)


def test_the_shipped_policy_scratches_gently(env: ScratchingEnv, policy: GaussianPolicy) -> None:
    successes, forces = [], []
    for scenario in range(1_000_000, 1_000_010):
        observation, _ = env.reset(seed=scenario)
        for _ in range(SCRATCHING.episode_steps):
            observation, _, _, _, info = env.step(policy.mean(observation))
            forces.append(info["signals"]["force_at_target_n"])
        successes.append(info["success"])
    assert np.mean(successes) >= 0.8
    assert np.mean([force for force in forces if force > 0]) < 3.0


def test_its_modes_are_gentler_or_firmer_calmer_or_brisker(env: ScratchingEnv, policy: GaussianPolicy) -> None:
    def mean_signals(**axes: float) -> dict[str, float]:
        family = SCRATCHING.modes
        mode = np.array([axes.get(name, 0.0) for name in family.names], np.float32)
        summed: dict[str, float] = {"force_at_target_n": 0.0, "strokes": 0.0}
        for scenario in range(1_000_000, 1_000_004):
            observation, _ = env.reset(seed=scenario)
            for _ in range(SCRATCHING.episode_steps):
                action = family.speed_factor(observation, mode) * policy.mean(family.perceived(observation, mode))
                observation, _, _, _, info = env.step(action)
                for name in summed:
                    summed[name] += info["signals"][name]
        return summed

    assert mean_signals(press=-1.0)["force_at_target_n"] < 0.8 * mean_signals(press=1.0)["force_at_target_n"]
    assert mean_signals(stroke_speed=-0.8)["strokes"] < 0.8 * mean_signals(stroke_speed=0.4)["strokes"]
