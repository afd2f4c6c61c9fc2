"""Reading a stored reward model, of whichever kind it is."""

from dataclasses import replace
from typing import Any

from safetensors.numpy import load

from worker.ml.rewards.beyond_sums.terms import RicherReward
from worker.ml.rewards.predicted_reward import PredictedReward
from worker.ml.rewards.reward_models import MlpReward, Normalisation, RewardModel, StructuredReward, stored_config

_KINDS: tuple[type[RewardModel], ...] = (StructuredReward, PredictedReward, RicherReward, MlpReward)
"""Those that need no torch."""


def load_reward_model(stored: bytes) -> RewardModel:
    """Read what to_bytes() wrote. Raises ValueError for a file that is something else."""
    config = stored_config(stored)
    return replace(
        _class_of(config).from_tensors(load(stored), config),
        normalisation=Normalisation(float(config["offset"]), float(config["scale"])),
        temperature=float(config.get("temperature", 1.0)),
        undone_column=config.get("undone_column"),
    )


def _class_of(config: dict[str, Any]) -> type[RewardModel]:
    for kind in _KINDS:
        if config.get("kind") == kind.kind:
            return kind
    from worker.ml.rewards.preference_transformer import PreferenceTransformer  # takes seconds: it runs in torch

    if config.get("kind") == PreferenceTransformer.kind:
        return PreferenceTransformer
    raise ValueError(f"Not a reward model: {config!r}.")
