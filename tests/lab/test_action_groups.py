"""A group of actions that a lab.toml names has a gain of its own, through the same search for ranges as other ways."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tests.lab.test_check import change
from worker.compute import simulation
from worker.experiments import fit_response_surface
from worker.ml.filters.exported.filter_act import act_of
from worker.ml.filters.exported.filter_module import FilterWeights
from worker.sim.lab.found import Found
from worker.tasks import registry

GROUPS = """[modes]
leave_out = ["smooth", "hesitate", "push_x", "push_y", "shift_x", "shift_y", "speed_near"]

[modes.groups]
up = ["y"]

[fields]"""


@pytest.fixture
def explored(plane: Path, use: Callable[[Path], None]) -> Found:
    change(plane, "[fields]", GROUPS)
    use(plane)
    fit_response_surface.find_ranges("plane", scenarios=2)
    return registry.found_out("plane")


def test_a_group_has_a_range_that_the_program_finds_and_a_filter_uses_it(explored: Found) -> None:
    (axis,) = [axis for axis in explored.axes if axis.name == "gain_up"]
    assert axis.low < 0.0 < axis.high
    family, policy = registry.task("plane").modes, simulation.reference_policy("plane")
    seen = np.array([0.0, 0.0, 0.1, 0.05, 0.0, 0.0, 0.2], np.float32)
    slower = act_of(family, policy, FilterWeights(mode={"gain_up": axis.low}))
    usual = policy.mean(seen)
    np.testing.assert_allclose(slower(seen), usual * [1.0, np.exp(axis.low)], atol=1e-6)


def test_a_group_that_changes_nothing_is_no_way(plane: Path, use: Callable[[Path], None]) -> None:
    """Everything lies on one height: nobody could see how quickly it is changed."""
    change(plane, "[fields]", GROUPS)
    change(plane, "uniform(-1.0, 1.0, 2)", "uniform(-1.0, 1.0, 2) * [1.0, 0.0]", "plane.py")
    use(plane)
    fit_response_surface.find_ranges("plane", scenarios=2)
    found = registry.found_out("plane")
    assert [axis.name for axis in found.axes] == ["speed_far"]
    assert found.dropped["gain_up above 0"] == "changes nothing that is measured"
