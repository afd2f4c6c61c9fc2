"""The structured reward with further terms, for people whose answers weighted sums of signals do not explain."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import numpy as np

from worker.domain.type_aliases import Float32Array, FloatArray
from worker.ml.rewards.beyond_sums import explanations
from worker.ml.rewards.reward_models import StructuredReward
from worker.ml.rewards.segments import SegmentPairs
from worker.ml.rewards.signal_scale import SignalScale

_MEAN, _DEVIATION, _OF_SUMS = "scene_mean", "scene_deviation", "of_sums"


@dataclass(frozen=True)
class FurtherTerms:
    """What is read beside the signals for one of the explanations. Raises ValueError for none of them."""

    explanation: str
    signal_names: tuple[str, ...]
    """of the columns of signals"""
    scene: tuple[int, ...]
    """columns of the observation that say how an episode begins"""
    scene_mean: FloatArray
    scene_deviation: FloatArray
    """(C,) of these in the clips that were compared"""

    def __post_init__(self) -> None:
        if self.explanation not in explanations.NAMES:
            raise ValueError(f"There are no terms for {self.explanation!r}.")
        if missing := {*explanations.read_by(self.explanation)} - {*self.signal_names}:
            raise ValueError(f"Terms for {self.explanation!r} need the signals {', '.join(sorted(missing))}.")
        if not len(self.scene) == len(self.scene_mean) == len(self.scene_deviation):
            raise ValueError("Every column of the scene needs a mean and a deviation.")

    @classmethod
    def of(cls, pairs: SegmentPairs, explanation: str, signal_names: Sequence[str], scene: Sequence[int]) -> Self:
        """For what was compared."""
        mean, deviation = explanations.usual_scene(pairs, scene)
        return cls(explanation, tuple(signal_names), tuple(scene), mean, deviation)

    @property
    def amounts(self) -> tuple[str, ...]:
        """The signals of which the further terms are amounts, or none."""
        return explanations.amounts_of(self.explanation)

    @property
    def width(self) -> int:
        """How many numbers a step has: signals and further terms."""
        nothing = {name: np.zeros(1) for name in self.signal_names}
        further = explanations.of_group(self.explanation, nothing, np.zeros(len(self.scene)))
        return len(self.signal_names) + int(further.shape[-1])

    def added_to(self, signals: Float32Array, observations: Float32Array) -> FloatArray:
        """(..., T, S), (..., T, D) from an episode's start -> (..., T, S + F)"""
        measured = np.asarray(signals, np.float64)
        columns = {name: measured[..., place] for place, name in enumerate(self.signal_names)}
        begins = observations[..., 0, list(self.scene)].astype(np.float64)
        held = (begins - self.scene_mean) / self.scene_deviation
        return np.concatenate([measured, explanations.of_group(self.explanation, columns, held)], axis=-1)

    def completed(self, pairs: SegmentPairs) -> SegmentPairs:
        """The pairs with the further terms as signals."""
        return replace(pairs, signals=self.added_to(pairs.signals, pairs.observations).astype(np.float32))

    def scale_of(self, known: SignalScale, completed: SegmentPairs) -> SignalScale:
        """That of the signals, and of the further terms in the pairs, which are not limited: a worst moment of a clip
        is not one per step."""
        further = SignalScale.of(completed).spread[len(known.spread) :]
        unlimited = np.full(len(further), np.inf)
        return SignalScale(
            np.append(known.spread, further),
            np.append(known.least_per_step, -unlimited),
            np.append(known.most_per_step, unlimited),
        )

    def reward(self, fitted: StructuredReward, linear: StructuredReward) -> "RicherReward":
        """From what was fitted to completed pairs, and to them without further terms."""
        return RicherReward.with_terms(fitted, self, linear.weights)


@dataclass(frozen=True, kw_only=True)
class RicherReward(StructuredReward):
    """Linear in the signals and in further terms, which depend on what came before in the episode."""

    kind: ClassVar[str] = "richer"
    is_linear: ClassVar[bool] = False
    terms: FurtherTerms
    of_sums: FloatArray
    """(E, S) the weights without further terms: what modes do to sums of signals is known beforehand, to terms not"""

    def __post_init__(self) -> None:
        if self.weights.shape[1] != self.terms.width:
            raise ValueError(
                f"Terms for {self.terms.explanation!r} need {self.terms.width} weights, not {self.weights.shape[1]}. "
                "The model is of another version: learn it anew."
            )

    @classmethod
    def with_terms(cls, fitted: StructuredReward, terms: FurtherTerms, of_sums: FloatArray) -> Self:
        """A structured model that was fitted to completed pairs, what completes them, and weights without that."""
        return cls(
            weights=fitted.weights,
            least_per_step=fitted.least_per_step,
            most_per_step=fitted.most_per_step,
            terms=terms,
            of_sums=of_sums,
        )

    def known_signals(self, signals: Float32Array, observations: Float32Array, actions: Float32Array) -> FloatArray:
        """See StructuredReward."""
        return self.terms.added_to(signals, observations)

    @property
    def weights_of_signals(self) -> FloatArray:
        """See StructuredReward."""
        return self.of_sums

    def tensors(self) -> dict[str, Float32Array]:
        """See RewardModel."""
        more = {_MEAN: self.terms.scene_mean, _DEVIATION: self.terms.scene_deviation, _OF_SUMS: self.of_sums}
        return super().tensors() | {name: each.astype(np.float32) for name, each in more.items()}

    def config(self) -> dict[str, Any]:
        """See RewardModel."""
        read = {name: list(getattr(self.terms, name)) for name in ("signal_names", "scene")}
        return super().config() | read | {"explanation": self.terms.explanation}

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, Float32Array], config: Mapping[str, Any]) -> Self:
        """See RewardModel."""
        terms = FurtherTerms(
            str(config["explanation"]),
            tuple(config["signal_names"]),
            tuple(config["scene"]),
            tensors[_MEAN].astype(np.float64),
            tensors[_DEVIATION].astype(np.float64),
        )
        of_sums = tensors[_OF_SUMS].astype(np.float64)
        return cls.with_terms(StructuredReward.from_tensors(tensors, config), terms, of_sums)
