"""What a study can choose from: how it learns, which pairs it asks, how finely clips are drawn."""

from enum import StrEnum
from typing import Self


class Choice(StrEnum):
    """An enumeration whose members have words for people: ``UNIFORM = "uniform", "At random", "A hint."``"""

    label: str
    hint: str

    def __new__(cls, value: str, label: str = "", hint: str = "") -> Self:
        """The stored word, what people call it, and what they should know before they choose it."""
        member = str.__new__(cls, value)
        member._value_ = value
        member.label, member.hint = label, hint
        return member


class Method(Choice):
    """How the personal filter is trained."""

    STUDIO = "studio", "Studio", "The configuration that worked in our tests."
    PRINTED = "printed", "As printed", "PbARL exactly as in the paper, for comparison."


class RewardKind(Choice):
    """Which reward model learns from the labels."""

    STRUCTURED = "structured", "Structured", "Weights of measurable quantities; needs few answers."
    PREDICTED = (
        "predicted",
        "Structured, without sensors on the person",
        "The same, but forces and spills are predicted from what the robot sees and does.",
    )
    MLP = "mlp", "Neural network", "Of the robot's state and action; needs more answers."
    PREFERENCE_TRANSFORMER = (
        "preference_transformer",
        "Preference Transformer",
        "As in the paper; also sees what happened before, needs the most answers and seconds.",
    )

    @property
    def is_linear_in_signals(self) -> bool:
        """Whether it weighs quantities that people can name."""
        return self in {RewardKind.STRUCTURED, RewardKind.PREDICTED}


class ClipQuality(Choice):
    """How finely clips are drawn."""

    SHARP = "sharp", "Sharp", "960 \N{MULTIPLICATION SIGN} 720 pixels, 25 pictures per second."
    QUICK = (
        "quick",
        "Quick",
        "640 \N{MULTIPLICATION SIGN} 480 pixels, 15 pictures per second; made in less than half the time.",
    )


class Strategy(Choice):
    """How the pairs to compare are chosen."""

    UNIFORM = "uniform", "At random", "The accuracy is then an unbiased estimate."
    DISAGREEMENT = (
        "disagreement",
        "Where the model's members disagree",
        "Fewer answers were needed from 100 on in our tests.",
    )
    ENTROPY = (
        "entropy",
        "Where the answer is most open",
        "Fewest answers were needed in our tests, with scripted people.",
    )
    INFORMATION_GAIN = (
        "information_gain",
        "Where an answer says most",
        "Known as BALD; about as good as disagreement in our tests.",
    )
    CONTESTED = (
        "contested",
        "Where other people disagree",
        "Tells people apart by what others said; needs 200 answers to be as good as random in our tests.",
    )
