"""Trains once, for everybody, what foresees a task's signals: ``python -m worker foresee --task NAME``.

The rollouts are behaviours like those of a study's pool, in scenarios of their own. They are kept, so an interrupted
run goes on where it was; the predictor and its record ship with the studio.
"""

import json
import platform
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

from worker.compute import simulation
from worker.compute.pools import Compute, Lane
from worker.domain.scenarios import SIGNAL_PREDICTOR, SIGNAL_PREDICTOR_TEST, first_of
from worker.experiments.rollout_cache import BEHAVIOURS_PER_SCENARIO, RolloutCache
from worker.ml.rewards import signal_training
from worker.ml.rewards.signal_training import PredictorTraining
from worker.tasks import registry

SCENARIOS = 150
TESTED_SCENARIOS = 30
"""in which nothing is learned, only measured"""
BLOCK = 5


def foresee(
    task: str,
    work_directory: Path,
    processes: int,
    scenarios: int = SCENARIOS,
    tested: int = TESTED_SCENARIOS,
    training: PredictorTraining | None = None,
    target: Path | None = None,
) -> dict[str, Any]:
    """Run what is missing, train the predictor of signals, write it and its record; returns the record.

    ``target``: where it goes; the task's checkpoints when None.
    """
    learned_from = first_of(SIGNAL_PREDICTOR, scenarios)
    tested_on = first_of(SIGNAL_PREDICTOR_TEST, tested)
    _roll_out(task, work_directory, processes, [*learned_from, *tested_on])
    cached, config = RolloutCache(task, work_directory), training or PredictorTraining()
    with tqdm(total=config.steps, unit="step", desc="training") as bar:
        predictor = signal_training.fit(cached.behaviours(learned_from), 0, config, lambda step: _moved(bar, step))
    clip_steps = registry.installed_task(task).description.usual_clip_steps
    file = target or simulation.predictor_file(task)
    predictor.save(file)
    record = {
        "command": f"python -m worker foresee --task {task} --scenarios {scenarios}",
        "scenarios": [learned_from.start, learned_from.stop - 1],
        "behaviours_per_scenario": BEHAVIOURS_PER_SCENARIO,
        "tested_scenarios": [tested_on.start, tested_on.stop - 1],
        "steps": config.steps,
        "clip_steps": clip_steps,
        "explained_share": signal_training.explained(predictor, cached.behaviours(tested_on), clip_steps),
        "versions": {"python": platform.python_version(), "numpy": np.__version__, "torch": torch.__version__},
    }
    file.with_suffix(".json").write_text(json.dumps(record, indent=2) + "\n")
    return record


def keep_behaviours(task: str, directory: Path, scenarios: Sequence[int]) -> None:
    """Make the rollouts of these scenarios that are not there yet."""
    RolloutCache(task, directory).behaviours(scenarios)


def _roll_out(task: str, directory: Path, processes: int, scenarios: Sequence[int]) -> None:
    blocks = [scenarios[first : first + BLOCK] for first in range(0, len(scenarios), BLOCK)]
    compute = Compute(processes)
    try:
        with tqdm(total=len(scenarios), unit="scenario", desc="behaviours") as bar:
            for first in range(0, len(blocks), processes):
                batch = blocks[first : first + processes]
                jobs = [(task, directory, block) for block in batch]
                compute.run_all(Lane.LEARNING, lambda: None, keep_behaviours, jobs)
                bar.update(sum(map(len, batch)))
    finally:
        compute.close()


def _moved(bar: "tqdm[Any]", step: int) -> None:
    bar.update(step - bar.n)
