"""What the filming processes do, and what they must not load to do it."""

import io
import subprocess
import sys
from copy import copy

import numpy as np
import pytest

from worker.compute import simulation
from worker.compute.behaviours import Behaviour
from worker.domain.trajectory import Trajectory
from worker.tasks import registry


def test_filming_loads_neither_torch_nor_the_engine_nor_the_database() -> None:
    heavy = "{'torch', 'dbos', 'sqlalchemy', 'onnxruntime'}"
    program = (
        f"import sys, worker.__main__, worker.compute.simulation; sys.exit(str({heavy} & sys.modules.keys() or ''))"
    )
    ran = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert ran.stderr.strip() == ""


def test_a_recorded_clip_shows_the_scenario_and_mode_it_was_asked_for() -> None:
    behaviour = Behaviour({"speed_far": 0.3, "to_side": 0.5})
    recorded = simulation.record_clip("feeding", "quick", 10_000_001, behaviour, 0, 2)
    trajectory = Trajectory.load(io.BytesIO(recorded.trajectory))
    assert trajectory.scenario == 10_000_001
    assert recorded.success == trajectory.success
    assert recorded.clip.n_frames == 3
    act = simulation.act_in_mode("feeding", [0.3, 0.0, 0.0, 0.5, 0.0])
    np.testing.assert_allclose(trajectory.actions[0], act(trajectory.observations[0]), atol=1e-6)


def test_the_reference_rollouts_are_the_frozen_policys_own() -> None:
    (rollout,) = simulation.reference_rollouts("feeding", 10_000_002, 1)
    expected = simulation.reference_policy("feeding").mean(rollout.observations[:-1])
    np.testing.assert_allclose(rollout.actions, expected, atol=1e-5)


def test_an_unknown_task_is_named_with_those_that_are_known() -> None:
    with pytest.raises(
        registry.UnknownTask, match="no task named 'dressing'; this installation knows feeding"
    ) as raised:
        registry.task("dressing")
    assert str(copy(raised.value)) == str(raised.value), "as it comes out of a compute process"
