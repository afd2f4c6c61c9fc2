"""The behaviours of a pool: different enough to see, mostly modes, and the same whenever they are drawn again."""

import io
from dataclasses import replace

import numpy as np
import pytest

from app.installed_tasks import catalogue
from worker.compute import simulation
from worker.compute.behaviours import DIFFERENT_ENOUGH, Behaviour, draw_behaviours
from worker.domain.trajectory import Trajectory
from worker.tasks import registry

EARLY = ["success_40", "success_70"]


@pytest.fixture(params=catalogue.names())
def name(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def test_the_same_scenario_has_the_same_behaviours_and_another_one_others(name: str) -> None:
    first = simulation.behaviours(name, 11, 4)
    assert first == simulation.behaviours(name, 11, 4)
    assert first != simulation.behaviours(name, 12, 4)
    assert len({str(each.described()) for each in first}) == 4


def test_every_kind_of_behaviour_occurs_and_plain_modes_are_the_rule(name: str) -> None:
    task = registry.task(name)
    drawn = [each for scenario in range(150) for each in draw_behaviours(task, scenario, 4, EARLY)]
    plain = [each for each in drawn if not (each.temperature or each.disturbance or each.checkpoint)]
    assert 0.73 < len(plain) / len(drawn) < 0.87
    assert {each.temperature for each in drawn} == {0.0, 0.5, 1.0, 1.5}
    assert {each.disturbance for each in drawn} == {0.0, 0.1, 0.2}
    assert {each.checkpoint for each in drawn} == {"", *EARLY}


def test_behaviours_of_one_scenario_differ_on_some_axis_by_almost_half_its_range(name: str) -> None:
    family = registry.task(name).modes
    width = np.array([axis.high - axis.low for axis in family.axes])
    for scenario in range(30):
        drawn = draw_behaviours(registry.task(name), scenario, 4, EARLY)
        modes = [np.array(family.vector(each.mode)) for each in drawn]
        for index, mode in enumerate(modes):
            assert all((np.abs(mode - other) / width).max() >= DIFFERENT_ENOUGH for other in modes[:index])


def test_many_behaviours_on_few_axes_stand_closer_but_are_found() -> None:
    task = registry.task("feeding")
    narrow = replace(task, modes=replace(task.modes, axes=task.modes.axes[:1]))
    assert len({each.mode["speed_far"] for each in draw_behaviours(narrow, 3, 8)}) == 8


@pytest.mark.parametrize(
    "behaviour",
    [Behaviour(temperature=1.5, seed=(1, 2)), Behaviour({"speed_far": -0.4}, disturbance=0.2, seed=(1, 2))],
)
def test_chance_in_a_behaviour_comes_from_its_seed_alone(behaviour: Behaviour) -> None:
    observation = simulation.environment("feeding").reset(seed=3)[0]

    def actions() -> np.ndarray:
        act = simulation.act_as("feeding", behaviour)
        return np.array([act(observation) for _ in range(5)])

    np.testing.assert_array_equal(actions(), actions())
    assert np.abs(np.diff(actions(), axis=0)).max() > 0.0


def test_an_early_policy_acts_differently_from_the_finished_one() -> None:
    observation = simulation.environment("feeding").reset(seed=3)[0]
    early, finished = (
        simulation.act_as("feeding", Behaviour(checkpoint=each))(observation)
        for each in (simulation.early_policies("feeding")[0], "")
    )
    assert np.abs(early - finished).max() > 0.02


def test_what_is_stored_with_a_rollout_says_how_it_was_made() -> None:
    behaviour = Behaviour({"speed_far": -0.4, "press": 0.0}, disturbance=0.2, seed=(7, 1))
    assert behaviour.described() == {"mode": {"speed_far": -0.4, "press": 0.0}, "disturbance": 0.2, "seed": (7, 1)}
    recorded = simulation.record_clip("feeding", "quick", 7, behaviour, 0, 1)
    assert Trajectory.load(io.BytesIO(recorded.trajectory)).task == "feeding"
