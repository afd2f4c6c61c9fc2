"""Trains the reference policy that ships with the studio: ``python -m worker pretrain``."""

from pathlib import Path
from typing import Any

from tqdm import tqdm

from worker.ml import sac
from worker.sim.feeding import FeedingEnv


def pretrain(seed: int, directory: Path) -> int:
    """Train the reference policy for Feeding by SAC, or resume a training that was interrupted (about ten minutes)."""
    config = sac.SacConfig(seed=seed)
    with tqdm(total=config.total_steps, unit="step", smoothing=0.05) as bar:

        def progress(steps: int, figures: dict[str, Any]) -> None:
            bar.update(steps - bar.n)
            bar.set_postfix({name: f"{value:.3g}" for name, value in figures.items()})

        sac.pretrain(FeedingEnv, config, directory, progress, f"python -m worker pretrain --seed {seed}")
    return 0
