"""What a study can choose from: how it learns, which pairs it asks, how finely clips are drawn."""

from enum import StrEnum


class Method(StrEnum):
    """How the personal filter is trained."""

    STUDIO = "studio"
    PRINTED = "printed"


class RewardKind(StrEnum):
    """Which reward model learns from the labels."""

    STRUCTURED = "structured"
    PREDICTED = "predicted"
    MLP = "mlp"
    PREFERENCE_TRANSFORMER = "preference_transformer"


class ClipQuality(StrEnum):
    """How finely clips are drawn."""

    SHARP = "sharp"
    QUICK = "quick"


class Strategy(StrEnum):
    """How the pairs to compare are chosen."""

    UNIFORM = "uniform"
    DISAGREEMENT = "disagreement"
    ENTROPY = "entropy"
    INFORMATION_GAIN = "information_gain"
    CONTESTED = "contested"
