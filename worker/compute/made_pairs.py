"""Which two modes a pair shows that is made for one person: what their filter would do now, and a variation of it."""

from collections.abc import Sequence

import numpy as np

from worker.compute.behaviours import DIFFERENT_ENOUGH
from worker.compute.simulation import surface_file
from worker.ml.rewards.loading import load_reward_model
from worker.ml.rewards.reward_models import StructuredReward
from worker.tasks import registry


def modes_of_pair(
    task: str, stored_model: bytes, clip_steps: int, seed: int, number: int
) -> Sequence[dict[str, float]]:
    """Two modes by the names of their axes; none where nothing can be foreseen: the model is not linear in the signals,
    or the task has no response surface. ``number``: of the pair, each has another variation."""
    from worker.ml.filters.fitting.response_surface import (  # scipy, which the worker starts without
        ResponseSurface,
        best_mode,
    )
    from worker.ml.filters.fitting.variations import variation

    model, described = load_reward_model(stored_model), registry.task(task)
    if not isinstance(model, StructuredReward) or not model.is_linear or not surface_file(task).exists():
        return []
    surface = ResponseSurface.load(surface_file(task), described.modes, described.signals)
    wanted = best_mode(surface, model.signal_weights(), seed)
    rng = np.random.default_rng([seed, number, 0x3A1])
    other = variation(surface, model, wanted, clip_steps / described.episode_steps, DIFFERENT_ENOUGH, rng)
    return [described.modes.named(mode) for mode in (wanted, other)]
