"""The structured reward where the person carries no sensors: what cannot be measured is foreseen instead."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self

from worker.domain.type_aliases import Float32Array, FloatArray
from worker.ml.rewards.reward_models import StructuredReward
from worker.ml.rewards.signal_predictor import SignalPredictor

PREFIX = "predictor."
"""of the predictor's tensors: the file of a reward model needs nothing beside it"""


@dataclass(frozen=True, kw_only=True)
class PredictedReward(StructuredReward):
    """Linear in the signals, those of UNSENSED foreseen from state and action; rates actions nobody executed, too."""

    kind: ClassVar[str] = "predicted"
    predictor: SignalPredictor

    @classmethod
    def with_predictor(cls, fitted: StructuredReward, predictor: SignalPredictor) -> Self:
        """A structured model that was fitted to completed signals, and what completes them."""
        return cls(
            weights=fitted.weights,
            least_per_step=fitted.least_per_step,
            most_per_step=fitted.most_per_step,
            predictor=predictor,
        )

    def known_signals(self, signals: Float32Array, observations: Float32Array, actions: Float32Array) -> FloatArray:
        """See StructuredReward."""
        return self.predictor.completed(signals, observations, actions)

    def tensors(self) -> dict[str, Float32Array]:
        """See RewardModel."""
        return super().tensors() | {f"{PREFIX}{name}": each for name, each in self.predictor.tensors().items()}

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, Float32Array], config: Mapping[str, Any]) -> Self:
        """See RewardModel."""
        theirs = {name.removeprefix(PREFIX): each for name, each in tensors.items() if name.startswith(PREFIX)}
        return cls.with_predictor(StructuredReward.from_tensors(tensors, config), SignalPredictor.from_tensors(theirs))
