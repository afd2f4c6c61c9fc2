"""Modes that are tried once for everybody: what is kept of them beside the response surface."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from app.installed_tasks import catalogue
from worker.__main__ import main
from worker.compute import simulation
from worker.experiments import archive_modes
from worker.experiments.fit_response_surface import BLOCK, Block
from worker.ml.filters.fitting.response_surface import ResponseSurface
from worker.tasks import registry

TASK = registry.task("scratching")


def test_what_modes_changed_is_kept_beside_the_surface_and_driven_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shipped = simulation.surface_file(TASK.name)
    file, work = tmp_path / shipped.name, tmp_path / "work"
    for each in (shipped, shipped.with_suffix(".json")):
        shutil.copy(each, tmp_path)
    before = ResponseSurface.load(file, TASK.modes)
    monkeypatch.setattr(simulation, "surface_file", lambda task: file)
    record = archive_modes.archive(TASK.name, work, 1, people=2, scenarios=BLOCK)
    surface = ResponseSurface.load(file, TASK.modes)
    assert surface.archive
    assert np.array_equal(surface.coefficients, before.coefficients)
    driven = np.load(next(work.iterdir()))
    np.testing.assert_allclose(surface.archive.modes, driven["modes"][:2], atol=1e-6)
    np.testing.assert_allclose(surface.archive.signals[1], driven["signals"][1::2].mean(axis=0), rtol=1e-5, atol=1e-6)
    assert surface.archive.success[0] == pytest.approx(driven["success"][::2].mean())
    growth_n = sorted(driven["force_growth_n"][::2])
    assert growth_n[-2] <= surface.archive.force_growth_n[0] + 1e-5 <= growth_n[-1] + 2e-5
    assert json.loads(file.with_suffix(".json").read_text()) == record
    assert record["archive"]["modes"] == 2

    written = file.read_bytes()
    monkeypatch.setattr(archive_modes, "run_blocks", lambda compute, blocks, what: assert_all_there(blocks))
    archive_modes.archive(TASK.name, work, 1, people=2, scenarios=BLOCK)
    assert file.read_bytes() == written


@pytest.mark.parametrize("name", catalogue.names())
def test_every_task_ships_with_an_archive_and_its_record(name: str) -> None:
    file, task = simulation.surface_file(name), registry.task(name)
    surface = ResponseSurface.load(file, task.modes, task.signals)
    record = json.loads(file.with_suffix(".json").read_text())["archive"]
    assert surface.archive
    assert len(surface.archive.modes) == record["modes"]
    assert surface.archive.success.mean() == pytest.approx(record["success_delta"], abs=1e-4)
    assert (surface.low <= surface.archive.modes).all()
    assert (surface.archive.modes <= surface.high).all()
    assert surface.archive.modes.any(axis=1).all(), "nobody's mode is the reference policy"


def test_a_task_that_was_not_explored_is_told_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(simulation, "surface_file", lambda task: tmp_path / "none.safetensors")
    assert main(["archive", "--task", TASK.name, "--work-directory", str(tmp_path / "work")]) == 1
    assert capsys.readouterr().err == (
        "Error: There is no response surface; `python -m worker explore --task scratching` fits one.\n"
    )
    assert not list(tmp_path.iterdir())


def assert_all_there(blocks: list[Block]) -> None:
    assert all(each.is_there() for each in blocks)
