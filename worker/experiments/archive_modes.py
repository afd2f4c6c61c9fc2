"""Tries modes that people would want once for everybody: ``python -m worker archive --task NAME``.

Each is driven through the same scenarios, and what it changes there is kept beside the response surface by which it was
found (response_surface.ModeArchive). Finished blocks are kept, so an interrupted run goes on where it was.
"""

import json
import platform
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from worker.compute import simulation
from worker.compute.pools import Compute
from worker.domain.scenarios import MODE_ARCHIVE, first_of
from worker.experiments.fit_response_surface import BLOCK, Block, joined, run_all, run_blocks, somebody
from worker.ml.filters.fitting.mode_archive import ModeArchive, tail_growth_n
from worker.ml.filters.fitting.response_surface import ResponseSurface, best_mode
from worker.tasks import registry

PEOPLE = 96
"""drawn at random, each of whom gives one mode"""
SCENARIOS = 200


class NoSurface(ValueError):
    """There is nothing by which modes could be found."""


def archive(
    task: str, work_directory: Path, processes: int, people: int = PEOPLE, scenarios: int = SCENARIOS
) -> dict[str, Any]:
    """Drive what is missing and write the archive into the task's response surface and its record, which is returned.

    Raises NoSurface where there is none, and ValueError where it was fitted for other signals or axes.
    ``scenarios``: in whole BLOCKs. Whoever explores the task anew needs another archive.
    """
    described, file = registry.task(task), simulation.surface_file(task)
    if not file.exists():
        raise NoSurface(f"There is no response surface; `python -m worker explore --task {task}` fits one.")
    work_directory.mkdir(parents=True, exist_ok=True)
    surface = replace(ResponseSurface.load(file, described.modes, described.signals), archive=None)
    rng = np.random.default_rng([people, 4])
    asked = [(surface, somebody(described, surface, rng), 0) for _ in range(people)]
    compute = Compute(processes)
    try:
        with tqdm(total=people, unit="person", desc="what people would want") as bar:
            modes = np.array(run_all(compute, best_mode, asked, 16, bar))
        blocks = [
            Block(task, first, np.repeat(modes[None], BLOCK, axis=0), work_directory / f"archive-{first}.npz")
            for first in first_of(MODE_ARCHIVE, scenarios)[::BLOCK]
        ]
        run_blocks(compute, blocks, "modes that people want")
    finally:
        compute.close()
    found = joined(blocks)
    signals = found.signals.reshape(scenarios, people, -1).mean(axis=0)
    success = found.success.reshape(scenarios, people).mean(axis=0)
    growth = tail_growth_n(found.force_growth_n.reshape(scenarios, people))
    replace(surface, archive=ModeArchive(modes, signals, success, growth)).save(file)
    record: dict[str, Any] = json.loads(file.with_suffix(".json").read_text())
    record["archive"] = {
        "command": f"python -m worker archive --task {task}",
        "modes": people,
        "scenarios": [MODE_ARCHIVE.start, MODE_ARCHIVE[scenarios - 1]],
        "success_delta": round(float(success.mean()), 4),
        "versions": {"python": platform.python_version(), "numpy": np.__version__},
    }
    file.with_suffix(".json").write_text(json.dumps(record, indent=2) + "\n")
    return record
