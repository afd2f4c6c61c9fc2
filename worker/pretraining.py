"""Trains the reference policies that ship with the studio: ``python -m worker pretrain --task feeding``."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tqdm import tqdm

from worker import laboratory
from worker.ml import sac

TRAINING: Mapping[str, Mapping[str, Any]] = {"feeding": {}}
"""What a task's training does otherwise than SacConfig's defaults."""


def pretrain(task: str, seed: int, directory: Path) -> int:
    """Train a task's reference policy by SAC, or resume a training that was interrupted (ten to twenty minutes)."""
    config = sac.SacConfig(laboratory.task(task).observation, seed=seed, **TRAINING.get(task, {}))
    with tqdm(total=config.total_steps, unit="step", smoothing=0.05) as bar:

        def progress(steps: int, figures: dict[str, Any]) -> None:
            bar.update(steps - bar.n)
            bar.set_postfix({name: f"{value:.3g}" for name, value in figures.items()})

        command = f"python -m worker pretrain --task {task} --seed {seed}"
        sac.pretrain(laboratory.environment_class(task), config, directory, progress, command)
    return 0
