"""Pairs that follow a person: their robot as it would be now beside a variation of it, as near as the pool has them."""

from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any

import numpy as np

from app.domain.clips import Clip
from app.domain.models import Model
from app.domain.studies import Study
from app.storage import ArtefactStore
from worker.compute.simulation import surface_file
from worker.domain.modes import ModeFamily
from worker.domain.type_aliases import FloatArray
from worker.ml import acquisition
from worker.ml.rewards.loading import load_reward_model
from worker.ml.rewards.reward_models import StructuredReward
from worker.tasks import registry

FROM_ANSWER = 10
"""A model of fewer answers has no say: it names modes almost at random."""


def scores(
    store: ArtefactStore, study: Study, model: Model | None, seed: int, pairs: Sequence[tuple[Clip, Clip]]
) -> FloatArray | None:
    """(M,) how near every pair is to the mode that the person's filter would have now, -inf for clips of no mode alone.

    None where nothing can follow yet, or at all: too few answers, a model that is not linear in the signals, or a task
    without a response surface, such as recordings.
    """
    if model is None or model.label_count < FROM_ANSWER or study.material is not None:
        return None
    wanted = _mode(study.task, store.read(model.artefact_sha256), seed)
    if wanted is None:
        return None
    family = registry.task(study.task).modes
    rows: dict[int, int] = {}
    modes: list[FloatArray] = []
    for clip in (clip for pair in pairs for clip in pair):
        if clip.id not in rows:
            rows[clip.id] = len(modes)
            modes.append(mode_of(family, clip.rollout.mode))
    width = np.array([axis.high - axis.low for axis in family.axes])
    sides = np.array([(rows[left.id], rows[right.id]) for left, right in pairs])
    return acquisition.nearness(np.array(modes), sides, wanted, width)


@lru_cache(maxsize=64)
def _mode(task: str, stored_model: bytes, seed: int) -> FloatArray | None:
    """(A,) what the search of modes would try first; None where it cannot be foreseen."""
    from worker.ml.filters.response_surface import ResponseSurface, best_mode  # scipy, which the worker starts without

    model = load_reward_model(stored_model)
    if not isinstance(model, StructuredReward) or not surface_file(task).exists():
        return None
    described = registry.task(task)
    surface = ResponseSurface.load(surface_file(task), described.modes, described.signals)
    return best_mode(surface, model.signal_weights(), seed)


def mode_of(family: ModeFamily, described: Mapping[str, Any]) -> FloatArray:
    """(A,) of a behaviour as it is stored with a rollout.

    nan where something else than the mode was different, too, and for axes that an earlier version had.
    """
    mode = described.get("mode", {})
    if described.keys() - {"mode"} or mode.keys() - set(family.names):
        return np.full(len(family.axes), np.nan)
    return np.array(family.vector(mode))
