"""docs/new_task.md: the task it shows works as it stands."""

import importlib
import re
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from worker.sim.assistive import AssistiveEnv
from worker.sim.rollout import rollout

PAGE = Path(__file__).parents[2] / "docs" / "new_task.md"


@pytest.fixture
def env(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[AssistiveEnv]:
    found = re.search(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
    assert found
    (tmp_path / "dabbing.py").write_text(found[1])
    monkeypatch.syspath_prepend(tmp_path)
    module = importlib.import_module("dabbing")
    monkeypatch.delitem(sys.modules, "dabbing")
    gymnasium.register("Dabbing-v0", entry_point=module.DabbingEnv)
    environment = gymnasium.make("Dabbing-v0").unwrapped
    assert isinstance(environment, AssistiveEnv)
    yield environment
    environment.close()
    del gymnasium.registry["Dabbing-v0"]


def test_the_example_is_about_a_hundred_lines_and_passes_the_checker(env: AssistiveEnv) -> None:
    assert len(PAGE.read_text().split("```python\n")[1].split("```")[0].splitlines()) <= 110
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env)


def test_the_example_can_be_done_and_counts_gentle_touches(env: AssistiveEnv) -> None:
    """A controller that follows the straight line to the mouth, with the arm's own kinematics, succeeds."""

    def towards_mouth(observation: np.ndarray) -> np.ndarray:
        joints = observation[env.task.observation.slice_of("joint_positions_rad")].astype(float)
        tool = env.robot.link_frames(joints[None], env.tool)[0, -1]
        away = observation[env.task.observation.slice_of("tool_to_target_m")].astype(float)
        outward = observation[env.task.observation.slice_of("target_outward")].astype(float)
        goal = away + 0.01 * outward
        step = tool[:3, 3] + goal * min(1.0, 0.02 / max(float(np.linalg.norm(goal)), 1e-6))
        wanted, _ = env.robot.solve_pose(joints[None], step[None], tool[:3, :3], env.tool, 5)
        action: np.ndarray = np.clip((wanted[0] - joints) / 0.05, -1, 1).astype(np.float32)
        return action

    trajectories = [rollout(env, towards_mouth, scenario) for scenario in range(6)]
    assert sum(each.success for each in trajectories) >= 2
    for each in trajectories:
        strokes = each.signals[:, -1]
        assert each.success is bool(strokes.sum() >= 10)
