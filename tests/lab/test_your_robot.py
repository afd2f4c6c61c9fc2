"""docs/lab_toml.md holds: the example can be used as it is committed, and a filter of it acts like its mode."""

import re
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from app.installed_tasks import lab
from app.installed_tasks.lab import LabDescription, LabEnvironment, LabPolicy
from worker.compute import simulation
from worker.experiments.check_lab import checked
from worker.ml.filters.exported.filter_act import act_of
from worker.ml.filters.exported.filter_module import FilterWeights
from worker.ml.filters.fitting.response_surface import ResponseSurface
from worker.sim.lab.environment import LabStep
from worker.tasks import registry

ROOT = Path(__file__).parents[2]
EXAMPLE, PAGE = ROOT / "examples" / "reach", (ROOT / "docs" / "lab_toml.md").read_text()


@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::UserWarning")
@pytest.mark.slow
def test_the_example_can_be_used(tmp_path: Path) -> None:
    found = checked(EXAMPLE / "lab.toml", tmp_path / "sheet.png")
    assert found.wrong == ()
    assert found.remarks[0].startswith("3 of 3 episodes succeeded")
    assert (tmp_path / "sheet.png").exists()


def test_the_page_names_every_key_and_everything_a_function_is_given() -> None:
    named = set(re.findall(r"`[.]?([\w.]+)`", PAGE))
    for key in (*LabEnvironment.model_fields, *LabPolicy.model_fields):
        assert {key, f"environment.{key}", f"policy.{key}"} & named, key
    for key in LabDescription.model_fields:
        assert any(each.split(".")[0] == key for each in named) or key in {"environment", "policy"}, key
    assert {each.name for each in fields(LabStep)} <= named


def test_what_was_found_of_the_example_is_of_the_example_as_it_is(use: Callable[[Path], None]) -> None:
    use(EXAMPLE)
    task = registry.task("reach")
    assert task.signals[-2:] == ("height_m", "sideways_m")
    surface = ResponseSurface.load(simulation.surface_file("reach"), task.modes, task.signals)
    assert surface.axes == task.modes.names
    assert lab.read(EXAMPLE / "lab.toml").checkpoint == EXAMPLE / "checkpoint"


def test_an_exported_filter_does_what_its_mode_does(use: Callable[[Path], None]) -> None:
    use(EXAMPLE)
    task, policy = registry.task("reach"), simulation.reference_policy("reach")
    seen = np.random.default_rng(0).uniform(-0.3, 0.3, (40, task.observation.size)).astype(np.float32)
    low = {axis.name: axis.low for axis in task.modes.axes}
    for mode in ({}, low, {axis.name: axis.high for axis in task.modes.axes}):
        act = act_of(task.modes, policy, FilterWeights(mode=mode))
        wanted = task.modes.executed(seen, np.array(task.modes.vector(mode), np.float32), policy.mean(seen))
        got = np.array([act(each) for each in seen])
        np.testing.assert_allclose(got, np.clip(wanted, -1.0, 1.0), atol=1e-5)
    np.testing.assert_allclose(
        task.modes.executed(seen, np.zeros(len(low), np.float32), policy.mean(seen)), policy.mean(seen), atol=1e-6
    )
