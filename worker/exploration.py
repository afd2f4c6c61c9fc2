"""Explores once, for everybody, what a task's execution modes change: ``python -m worker explore --task feeding``.

Every scenario is executed by the reference policy and in random modes; the differences are fitted by a response
surface, which ships with the studio. Finished blocks are kept, so an interrupted exploration goes on where it was.
"""

import json
import platform
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from tqdm import tqdm

from worker import laboratory
from worker.compute import Compute, Lane
from worker.ml import response_surface
from worker.sim.rollout import rollout
from worker.trajectory import SIGNALS, Trajectory

FIRST_SCENARIO = 100_000
SCENARIOS = 200
MODES_PER_SCENARIO = 12
BLOCK = 10


def surface_file(task: str) -> Path:
    """Where a task's response surface is kept; its record lies beside it."""
    return laboratory.checkpoints(task) / "response_surface.safetensors"


@dataclass(frozen=True)
class Differences:
    """What modes changed, N rollouts each compared with the reference policy's in the same scenario."""

    modes: npt.NDArray[np.float64]
    """(N, A)"""
    signals: npt.NDArray[np.float64]
    """(N, S) of the episode's summed signals"""
    success: npt.NDArray[np.float64]
    """(N,) in {-1, 0, 1}"""
    reference_success: npt.NDArray[np.float64]
    """(scenarios,)"""


def explore(task: str, work_directory: Path, processes: int, scenarios: int = SCENARIOS) -> dict[str, Any]:
    """Run what is missing, fit the response surface, write it and its record; returns the record."""
    work_directory.mkdir(parents=True, exist_ok=True)
    starts = list(range(FIRST_SCENARIO, FIRST_SCENARIO + scenarios, BLOCK))
    files = [work_directory / f"differences-{start}.npz" for start in starts]
    missing = [(task, start, file) for start, file in zip(starts, files, strict=True) if not file.exists()]
    compute = Compute(processes)
    with tqdm(total=len(files), initial=len(files) - len(missing), unit="block") as bar:
        for first in range(0, len(missing), processes):
            batch = missing[first : first + processes]
            compute.run_all(Lane.LEARNING, lambda: None, compare_block, batch)
            bar.update(len(batch))
    compute.close()
    return _fit(task, scenarios, _joined(files))


def compare_block(task: str, first: int, target: Path) -> None:
    """Differences of one block of scenarios, written to a file that is either complete or absent."""
    policy, environment = laboratory.reference_policy(task), laboratory.environment(task)
    modes, signals, success, reference_success = [], [], [], []
    for scenario in range(first, first + BLOCK):
        reference = rollout(environment, policy.mean, scenario)
        reference_success.append(reference.success)
        for mode in laboratory.task(task).modes.sample(MODES_PER_SCENARIO, np.random.default_rng([scenario, 2])):
            changed = rollout(environment, laboratory.act_in_mode(task, mode), scenario)
            modes.append(mode)
            signals.append(
                changed.signals.sum(axis=0, dtype=np.float64) - reference.signals.sum(axis=0, dtype=np.float64)
            )
            success.append(float(changed.success) - float(reference.success))
    partial = target.with_suffix(".partial.npz")
    np.savez(partial, modes=modes, signals=signals, success=success, reference_success=reference_success)
    partial.replace(target)


def _joined(files: list[Path]) -> Differences:
    loaded = [np.load(file, allow_pickle=False) for file in files]
    names = ("modes", "signals", "success", "reference_success")
    return Differences(*(np.concatenate([each[name] for each in loaded]).astype(np.float64) for name in names))


def _fit(task: str, scenarios: int, found: Differences) -> dict[str, Any]:
    family = laboratory.task(task).modes
    successes = found.reference_success.repeat(MODES_PER_SCENARIO) + found.success
    surface = response_surface.fit(family, found.modes, found.signals, successes)
    surface.save(surface_file(task))
    predicted, _ = surface.predict(found.modes)
    residual = ((found.signals - predicted) ** 2).mean(axis=0)
    spread = np.maximum((found.signals**2).mean(axis=0), 1e-12)
    record = {
        "command": f"python -m worker explore --task {task} --scenarios {scenarios}",
        "scenarios": [FIRST_SCENARIO, FIRST_SCENARIO + scenarios - 1],
        "modes_per_scenario": MODES_PER_SCENARIO,
        "axes": {axis.name: [axis.low, axis.high] for axis in family.axes},
        "reference_success": float(found.reference_success.mean()),
        "mode_success": float(successes.mean()),
        "explained_share": {
            name: round(float(1 - residual[column] / spread[column]), 3)
            for column, name in enumerate(SIGNALS)
            if spread[column] > 1e-9
        },
        "versions": {"python": platform.python_version(), "numpy": np.__version__},
    }
    surface_file(task).with_suffix(".json").write_text(json.dumps(record, indent=2) + "\n")
    return record


def _summed(trajectory: Trajectory) -> npt.NDArray[np.float64]:
    summed: npt.NDArray[np.float64] = trajectory.signals.sum(axis=0, dtype=np.float64)
    return summed
