"""Trains the reference policies that ship with the studio: ``python -m worker pretrain --task feeding``."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from tqdm import tqdm

from worker.compute import simulation
from worker.ml.policies import pretraining
from worker.ml.policies.imitation import Demonstrate
from worker.ml.policies.sac import SacConfig
from worker.tasks.drinking.demonstrator import scripted_pouring

TRAINING: Mapping[str, Mapping[str, Any]] = {
    "feeding": {},
    "drinking": {
        "total_steps": 200_000,
        "random_steps": 2_000,
        "initial_temperature": 0.02,
        "training_limit": 0.7,
        "action_limit": 0.5,
        "demonstrations": 45,
        "imitation_updates": 60_000,
        "evaluation_episodes": 100,
    },
    "scratching": {
        "total_steps": 120_000,
        "training_limit": 0.7,
        "evaluate_every_steps": 2_500,
        "input_scales": {"tip_to_last_stroke_m": 30.0, "tool_to_target_m": 10.0, "force_on_person_n": 0.3},
    },
}
"""What a task's training does otherwise than SacConfig's defaults."""

DEMONSTRATORS: Mapping[str, Callable[[], Demonstrate]] = {"drinking": scripted_pouring}
"""Scripted controllers for tasks that are not found by trial and error."""


def pretrain(task: str, seed: int, directory: Path) -> int:
    """Train a task's reference policy by SAC, or resume a training that was interrupted (ten to twenty minutes)."""
    config = SacConfig(simulation.task(task).observation, seed=seed, **TRAINING.get(task, {}))
    with tqdm(total=config.total_steps, unit="step", smoothing=0.05) as bar:

        def progress(steps: int, figures: dict[str, Any]) -> None:
            bar.update(steps - bar.n)
            bar.set_postfix({name: f"{value:.3g}" for name, value in figures.items()})

        command = f"python -m worker pretrain --task {task} --seed {seed}"
        demonstrate = DEMONSTRATORS[task]() if task in DEMONSTRATORS else None
        pretraining.pretrain(simulation.environment_class(task), config, directory, progress, command, demonstrate)
    return 0
