"""Whether the reward model does not fit a person: a flag for people to look at, from what the worker has measured."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from app.domain.models import Model
from app.services.answers.accuracy import ENOUGH_EVIDENCE

CHANGING = "changing"
IN_WORDS: Mapping[str, str] = {
    "worst_moments": "the worst moment, such as the highest speed or the hardest touch",
    "arrival": "when the robot arrives",
    "phases": "weights that differ between far away and close up",
    "poses": "weights that depend on how person and robot are placed at the start",
    CHANGING: "weights that change from the first answer to the last",
}
"""What explains answers, by the names of worker.ml.rewards.beyond_sums.misfit."""
DOUBT = 2.0
"""Evidence from which on the structured model follows it (worker.ml.rewards.beyond_sums.choice), though it says
too little for a flag. Who gives so much, and how many linear people do: docs/results/nonlinear_filters.md."""


@dataclass(frozen=True)
class Misfit:
    """Something richer explains somebody's answers better than weighted sums of signals."""

    explanation: str
    """What explains most, one of IN_WORDS."""
    evidence: float
    """How many times as probable richer models make the answers."""
    is_learned: bool = False
    """Whether the reward model follows it."""

    @property
    def is_shown(self) -> bool:
        """Whether there is enough evidence for a flag."""
        return self.evidence >= ENOUGH_EVIDENCE

    @property
    def in_model(self) -> str:
        """What the reward model makes of it, in words."""
        if not self.is_learned:
            return "the model has no terms for it"
        return "the model follows the last answers" if self.explanation == CHANGING else "the model has terms for it"

    @property
    def words(self) -> str:
        """What explains most, in words."""
        return IN_WORDS[self.explanation]


def misfit_of(models: Sequence[Model]) -> Misfit | None:
    """From a participant's reward models in the order of their labels, the newest of which counts.

    None while it has not been shown that the model does not fit. How often that is said wrongly, however often one
    looks: docs/results/misfit.md.
    """
    found = doubt_of(models)
    return found if found is not None and found.is_shown else None


def doubt_of(models: Sequence[Model]) -> Misfit | None:
    """The same for less evidence: whether weighted signals alone may not fit."""
    metrics = models[-1].metrics if models else {}
    found = metrics.get("misfit")
    if not isinstance(found, dict) or not found.get("evidence", 0.0) > DOUBT:
        return None
    explanation = str(found["explanation"])
    return Misfit(explanation, float(found["evidence"]), metrics.get("further") == explanation)
