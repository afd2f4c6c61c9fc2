"""What every task's environment promises to policies, to recordings and to whoever replays them."""

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

from app.installed_tasks import catalogue
from tests.worker.sim.episodes import episode, policy_for
from worker.domain.trajectory import BODIES, SIGNALS
from worker.sim import human
from worker.sim.arm import start_postures
from worker.sim.assistive import ARM, AssistiveEnv
from worker.sim.bullet import Bullet
from worker.sim.geometry import rotation_of
from worker.sim.seated_person import PERSON, add_person
from worker.tasks.registry import environment_class

STILL = np.zeros(7, np.float32)


@pytest.fixture(params=catalogue.names(), scope="module")
def kind(request: pytest.FixtureRequest) -> type[AssistiveEnv]:
    return environment_class(request.param)


@pytest.fixture(scope="module")
def env(kind: type[AssistiveEnv]) -> Iterator[AssistiveEnv]:
    environment = kind()
    yield environment
    environment.close()


def field(env: AssistiveEnv, observation: np.ndarray, name: str) -> np.ndarray:
    return observation[..., env.task.observation.slice_of(name)]


def registered(kind: type[AssistiveEnv]) -> str:
    return f"pbarl/{kind.task.title}-v0"


def test_it_is_registered_and_passes_gymnasiums_checker_without_a_warning(kind: type[AssistiveEnv]) -> None:
    made = gymnasium.make(registered(kind))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(made.unwrapped)
    made.close()


def test_it_passes_stable_baselines_checker_without_a_warning(kind: type[AssistiveEnv]) -> None:
    environment = kind()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env_for_sb3(environment)
    environment.close()


def test_an_episode_is_truncated_after_exactly_its_length(env: AssistiveEnv) -> None:
    env.reset(seed=0)
    ends = [env.step(STILL)[2:4] for _ in range(env.task.episode_steps)]
    assert ends == [(False, False)] * (env.task.episode_steps - 1) + [(False, True)]


def test_stepping_before_the_first_reset_is_refused(kind: type[AssistiveEnv]) -> None:
    environment = kind()
    with pytest.raises(gymnasium.error.ResetNeeded):
        environment.step(STILL)
    environment.close()


def test_a_closed_environment_says_so_and_closes_twice(kind: type[AssistiveEnv]) -> None:
    environment = kind()
    environment.close()
    environment.close()
    with pytest.raises(RuntimeError, match="closed"):
        environment.reset(seed=0)


def test_the_same_seed_replays_bit_identically_after_other_episodes(env: AssistiveEnv) -> None:
    scenarios = (3, 1_000_001, 17)
    first = {scenario: episode(env, scenario) for scenario in scenarios}
    for scenario in reversed(scenarios):
        np.testing.assert_array_equal(episode(env, scenario), first[scenario])


def test_the_same_seed_replays_bit_identically_in_a_fresh_process(env: AssistiveEnv) -> None:
    program = (
        "import sys; from tests.worker.sim.episodes import episode;"
        "from worker.tasks.registry import environment_class;"
        f"o = episode(environment_class({env.task.name!r})(), 5);"
        "sys.stdout.buffer.write(b'BEGIN' + o.tobytes())"
    )
    output = subprocess.run([sys.executable, "-c", program], capture_output=True, check=True).stdout
    replayed = np.frombuffer(output.split(b"BEGIN", 1)[1])
    np.testing.assert_array_equal(replayed, episode(env, 5).ravel())


def test_trembling_people_replay_bit_identically_too(kind: type[AssistiveEnv]) -> None:
    environment = kind(impairments=("tremor",))
    first = episode(environment, 3)
    episode(environment, 4)
    np.testing.assert_array_equal(episode(environment, 3), first)
    environment.close()


def test_different_seeds_are_different_scenarios(env: AssistiveEnv) -> None:
    observations = np.array([env.reset(seed=scenario)[0] for scenario in range(20)])
    assert len(np.unique(field(env, observations, "body_to_target_m"), axis=0)) == 20
    assert len(np.unique(field(env, observations, "tool_position_m"), axis=0)) > 15


def test_resetting_without_a_seed_continues_the_generator_of_the_last_seed(env: AssistiveEnv) -> None:
    def scenarios() -> list[int]:
        env.reset(seed=9)
        return [env.reset()[1]["scenario"] for _ in range(3)]

    first = scenarios()
    assert first == scenarios()
    assert len(set(first)) == 3


@pytest.mark.parametrize("moment", [1, 20, 70])
def test_restoring_a_saved_moment_continues_bit_identically(env: AssistiveEnv, moment: int) -> None:
    policy = policy_for(type(env))

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


@pytest.mark.parametrize("mode", ["sync", "async"])
def test_several_run_side_by_side_exactly_as_they_run_alone(kind: type[AssistiveEnv], mode: str) -> None:
    together = gymnasium.make_vec(registered(kind), num_envs=3, vectorization_mode=mode)
    observations, _ = together.reset(seed=11)
    actions = np.random.default_rng(0).uniform(-1, 1, (5, 3, 7)).astype(np.float32)
    for each in actions:
        observations, *_ = together.step(each)
    together.close()
    alone = kind()
    for index, scenario in enumerate((11, 12, 13)):
        alone.reset(seed=scenario)
        for each in actions:
            observation, *_ = alone.step(each[index])
        np.testing.assert_array_equal(observations[index], observation)
    alone.close()


def test_start_postures_hold_the_tool_as_wanted_and_keep_clear_of_everybody(kind: type[AssistiveEnv]) -> None:
    world, robot = Bullet(), kind.robot
    postures = start_postures(robot, kind.tool, kind.start)
    for body in BODIES:
        world.clear()
        robot.add_to(world, kind.tool)
        add_person(world, human.draw_person(np.random.default_rng(0), (body,), right_arm=kind.right_arm))
        for posture in postures[::16]:
            world.set_joints(ARM, posture)
            origin, quaternion = world.link_pose(ARM, kind.tool.name)
            assert np.abs(origin - kind.start.centre_m).max() < kind.start.range_m + 1e-3
            np.testing.assert_allclose(rotation_of(quaternion).T, kind.start.tool_axes, atol=2e-3)
            assert world.clearance_m(ARM, PERSON, 0.3) > 0.02
            assert (posture > robot.lower_rad + 0.1).all()
            assert (posture < robot.upper_rad - 0.1).all()
    world.close()


def test_observations_are_in_the_robots_base_frame_and_agree_with_each_other(env: AssistiveEnv) -> None:
    policy, robot = policy_for(type(env)), env.robot
    observation, _ = env.reset(seed=8)
    for _ in range(15):
        observation, *_ = env.step(policy.mean(observation))
    joints = field(env, observation, "joint_positions_rad").astype(float)
    tool = robot.link_frames(joints[None], env.tool)[0, -1]
    np.testing.assert_allclose(field(env, observation, "tool_position_m"), tool[:3, 3], atol=1e-5)
    np.testing.assert_allclose(field(env, observation, "tool_forward"), tool[:3, 0], atol=1e-5)
    np.testing.assert_allclose(field(env, observation, "tool_up"), tool[:3, 2], atol=1e-5)
    seen = field(env, observation, "tool_position_m") + field(env, observation, "tool_to_target_m")
    np.testing.assert_allclose(robot.mount_rotation @ seen + robot.mount_m, env.target_m, atol=1e-5)
    assert np.linalg.norm(field(env, observation, "target_outward")) == pytest.approx(1.0, abs=1e-5)


def test_every_step_reports_every_signal_as_a_finite_number(env: AssistiveEnv) -> None:
    policy = policy_for(type(env))
    observation, _ = env.reset(seed=7)
    for _ in range(env.task.episode_steps):
        observation, _, _, _, info = env.step(policy.mean(observation))
        assert tuple(info["signals"]) == SIGNALS
        assert np.isfinite(list(info["signals"].values())).all()
        assert min(*info["costs"].values()) >= 0.0
        total = info["signals"]["force_away_n"] + info["signals"]["force_at_target_n"]
        assert info["contact_force_n"] == pytest.approx(total, rel=1e-5)
        assert env.observation_space.contains(observation)


def test_measured_speed_is_the_distance_the_tool_travelled(env: AssistiveEnv) -> None:
    policy = policy_for(type(env))
    observation, _ = env.reset(seed=6)
    for _ in range(12):
        before = field(env, observation, "tool_position_m")
        observation, _, _, _, info = env.step(policy.mean(observation))
        travelled = np.linalg.norm(field(env, observation, "tool_position_m") - before) / 0.1
        assert info["signals"]["speed_m_s"] == pytest.approx(travelled, rel=0.25, abs=0.02)


def test_people_differ_in_body_skin_and_pose(env: AssistiveEnv) -> None:
    people = []
    for scenario in range(60):
        env.reset(seed=scenario)
        people.append(env.person)
    assert {person.body.name for person in people} == set(BODIES)
    assert {person.skin_tone for person in people} == set(range(6))
    assert len({person.head_euler_rad for person in people}) == 60
    assert len({person.arms_rad.tobytes() for person in people}) == 60


def test_only_the_bodies_and_impairments_asked_for_are_drawn(kind: type[AssistiveEnv]) -> None:
    environment = kind(bodies=("slim",), impairments=("limits", "weakness"))
    drawn = []
    for scenario in range(20):
        environment.reset(seed=scenario)
        drawn.append((environment.person.body.name, environment.person.impairment))
    assert set(drawn) == {("slim", "limits"), ("slim", "weakness")}
    environment.close()


@pytest.mark.parametrize("bodies", [("tall",), ("slim", "tall"), ()])
def test_unknown_bodies_are_refused_by_name(kind: type[AssistiveEnv], bodies: tuple[str, ...]) -> None:
    with pytest.raises(ValueError, match="bodies must name at least one of broad, slim"):
        kind(bodies=bodies)


def test_unknown_impairments_are_refused_by_name(kind: type[AssistiveEnv]) -> None:
    with pytest.raises(ValueError, match="impairments must name at least one of none, tremor, weakness, limits"):
        kind(impairments=("cold",))  # type: ignore[arg-type]


@pytest.mark.long
def test_many_resets_do_not_grow_memory(kind: type[AssistiveEnv]) -> None:
    environment = kind()

    def resident_kib_after(resets: int) -> int:
        for scenario in range(resets):
            environment.reset(seed=scenario)
        return int(Path("/proc/self/statm").read_text().split()[1]) * 4

    before = resident_kib_after(500)
    assert resident_kib_after(2000) - before < 600
    environment.close()
