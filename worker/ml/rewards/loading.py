"""Reading a stored reward model, of whichever kind it is."""

from dataclasses import replace

from safetensors.numpy import load

from worker.ml.rewards.predicted_reward import PredictedReward
from worker.ml.rewards.preference_transformer import PreferenceTransformer
from worker.ml.rewards.reward_models import MlpReward, Normalisation, RewardModel, StructuredReward, stored_config

KINDS: tuple[type[RewardModel], ...] = (StructuredReward, PredictedReward, MlpReward, PreferenceTransformer)


def load_reward_model(stored: bytes) -> RewardModel:
    """Read what to_bytes() wrote. Raises ValueError for a file that is something else."""
    config = stored_config(stored)
    for kind in KINDS:
        if config.get("kind") == kind.kind:
            return replace(
                kind.from_tensors(load(stored), config),
                normalisation=Normalisation(float(config["offset"]), float(config["scale"])),
                temperature=float(config.get("temperature", 1.0)),
                undone_column=config.get("undone_column"),
            )
    raise ValueError(f"Not a reward model: {config!r}.")
