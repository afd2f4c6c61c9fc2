"""Trains a task's reference policy: ``python -m worker pretrain --task NAME``."""

from pathlib import Path
from typing import Any

from tqdm import tqdm

from worker.ml.policies import pretraining
from worker.ml.policies.sac import SacConfig
from worker.tasks import registry


def pretrain(task: str, seed: int, directory: Path) -> int:
    """Train a task's reference policy by SAC, or resume a training that was interrupted (ten to twenty minutes)."""
    config = _config(task, seed)
    with tqdm(total=config.total_steps, unit="step", smoothing=0.05) as bar:

        def progress(steps: int, figures: dict[str, Any]) -> None:
            bar.update(steps - bar.n)
            bar.set_postfix({name: f"{value:.3g}" for name, value in figures.items()})

        command = f"python -m worker pretrain --task {task} --seed {seed}"
        demonstrate = registry.demonstrator(task)
        pretraining.pretrain(registry.environment_class(task), config, directory, progress, command, demonstrate)
    return 0


def _config(task: str, seed: int) -> SacConfig:
    installed = registry.installed_task(task)
    try:
        return SacConfig(registry.task(task).observation, seed=seed, **registry.coded(task).training)
    except TypeError as error:
        raise registry.broken(installed, "training", f"is not understood: {error}") from error
