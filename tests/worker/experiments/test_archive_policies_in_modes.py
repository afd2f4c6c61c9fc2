"""Modes in which archived policies are tried for everybody: how they are found, and those that ship."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from app.installed_tasks import catalogue
from worker.__main__ import main
from worker.compute import learning, simulation
from worker.compute.archived import everything_archived
from worker.experiments import archive_policies_in_modes
from worker.experiments.archive_policies_in_modes import Driven
from worker.experiments.rollout_cache import RolloutCache
from worker.ml.filters.exported.filter_act import act_of
from worker.ml.filters.exported.filter_module import FilterWeights
from worker.ml.filters.exported.shield import untried
from worker.ml.filters.fitting.filter_problem import FilterConfig
from worker.tasks import registry

SHIPPED = [name for name in catalogue.names() if simulation.archived_modes_file(name).exists()]


def tried(work: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    monkeypatch.setattr(simulation, "archived_modes_file", lambda task: work / "in_modes.json")
    return archive_policies_in_modes.archive_policies_in_modes("scratching", work, people=3, tried=2, scenarios=2)


def test_what_keeps_the_task_is_archived_and_driven_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    record = tried(tmp_path, monkeypatch)
    assert record == json.loads((tmp_path / "in_modes.json").read_text())
    assert 1 <= len(record["modes"]) <= 2
    policies = simulation.archived_policies("scratching")
    kept = [each for each in record["modes"] if each["kept"]]
    assert kept, "two scenarios are easy"
    assert all((each["scenarios"], each["failed"]) == (2, 0) for each in kept)
    found = [each for each in everything_archived("scratching") if each.mode]
    assert [(each.policy, each.mode) for each in found] == [(policies[each["policy"]], each["mode"]) for each in kept]
    task, frozen = registry.task("scratching"), simulation.reference_policy("scratching")
    rollouts = RolloutCache("scratching", tmp_path / "rollouts")
    (rollout,) = rollouts.archived([7])[len(policies)].driven
    shield = untried(task.observation, frozen.action_size, rollouts.reference(FilterConfig().gate_block(task)))
    weights = FilterWeights(refined=found[0].policy.weights, refined_mode=found[0].mode, shield=shield)
    assert shield, "no touch is much harder than the frozen policy's"
    act = act_of(task.modes, frozen, weights)
    (again,) = learning.run_scenarios("scratching", act, [7], 0.0, 0)
    np.testing.assert_array_equal(rollout.actions, again.actions)

    monkeypatch.setattr(learning, "run_scenarios", lambda *_: pytest.fail("it was driven again"))
    assert tried(tmp_path, monkeypatch) == record


def test_what_loses_the_task_or_presses_somebody_is_told_and_not_archived(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(archive_policies_in_modes, "LARGEST_LOSS", -2.0)
    record = tried(tmp_path, monkeypatch)
    assert [each["kept"] for each in record["modes"]] == [False, False]
    first, second = (each["mode"] for each in record["modes"])
    assert first != second
    assert not [each for each in everything_archived("scratching") if each.mode]


def test_modes_of_what_is_gone_are_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    name, *_ = simulation.archived_policies("scratching")
    modes: Sequence[dict[str, Any]] = (
        {"policy": "gone", "mode": {"speed_far": 0.1}, "kept": True},
        {"policy": name, "mode": {"axis_of_yesterday": 0.1}, "kept": True},
        {"policy": name, "mode": {"speed_far": 0.1}, "kept": True},
    )
    (tmp_path / "in_modes.json").write_text(json.dumps({"modes": modes}))
    monkeypatch.setattr(simulation, "archived_modes_file", lambda task: tmp_path / "in_modes.json")
    assert [each.mode for each in everything_archived("scratching") if each.mode] == [{"speed_far": 0.1}]


def test_a_task_without_policies_says_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(simulation, "archived_policies", lambda task: {})
    assert main(["archive-policies-in-modes", "--task", "feeding", "--work-directory", str(tmp_path)]) == 1
    assert "`python -m worker archive-policies --task feeding` refines some" in capsys.readouterr().err


@pytest.mark.parametrize("task", SHIPPED)
def test_those_that_ship_are_of_their_task_and_keep_it(task: str) -> None:
    modes = registry.task(task).modes
    record = json.loads(simulation.archived_modes_file(task).read_text())
    assert record["command"] == f"python -m worker archive-policies-in-modes --task {task}"
    found = [each for each in everything_archived(task) if each.mode]
    assert len(found) == sum(each["kept"] for each in record["modes"]) > 0
    assert all(each["failed"] <= 0.01 * each["scenarios"] for each in record["modes"] if each["kept"])
    for each in found:
        at = np.array(modes.vector(each.mode))
        assert all(axis.low <= value <= axis.high for axis, value in zip(modes.axes, at, strict=True))


def driven(scenarios: int, failed: int = 0, pressed: int = 0) -> Driven:
    growth = np.array([100.0] * pressed + [0.0] * (scenarios - pressed))
    return Driven(np.zeros((scenarios, 1)), np.ones(scenarios), failed, growth)


def test_what_has_lost_too_much_is_driven_no_further_unless_it_can_win_that_back() -> None:
    alone = driven(500)
    assert driven(100, failed=5).keeps_task(alone), "five of 500 are one in a hundred"
    assert not driven(100, failed=6).keeps_task(alone)
    assert driven(100, failed=6).keeps_task(alone, winnable=1)
    assert driven(100, pressed=5).keeps_task(alone)
    assert not driven(100, pressed=6).keeps_task(alone, winnable=1)
    assert driven(100, pressed=6).keeps_task(driven(500, pressed=6))
