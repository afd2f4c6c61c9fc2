"""For somebody whose weights change from the first answer to the last: the structured reward of their last answers."""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from worker.ml.rewards.beyond_sums.misfit import order
from worker.ml.rewards.reward_models import StructuredReward
from worker.ml.rewards.segments import SegmentPairs
from worker.ml.rewards.signal_scale import SignalScale

LAST = 0.25
"""The share of the answers whose mean weights become the reward: those of the very last answer are known half as well,
and who errs more and more would seem to want hardly anything in the end (docs/results/nonlinear_filters.md)."""


@dataclass(frozen=True)
class ChangingWeights:
    """Weights that move along a line with the number of the answer, as columns beside the signals."""

    signals: int
    amounts: ClassVar[tuple[str, ...]] = ()

    def completed(self, pairs: SegmentPairs) -> SegmentPairs:
        """The pairs, in the order of their answers, with each signal times how far from the last ones it was asked."""
        far = order(len(pairs)) - order(len(pairs)).max() * (1.0 - LAST)
        moved = pairs.signals * far[:, None, None, None].astype(np.float32)
        return replace(pairs, signals=np.concatenate([pairs.signals, moved], axis=-1))

    def scale_of(self, known: SignalScale, completed: SegmentPairs) -> SignalScale:
        """That of the signals for the columns beside them, too, where nothing is limited."""
        unlimited = np.full(self.signals, np.inf)
        return SignalScale(
            np.append(known.spread, known.spread),
            np.append(known.least_per_step, -unlimited),
            np.append(known.most_per_step, unlimited),
        )

    def reward(self, fitted: StructuredReward, linear: StructuredReward) -> StructuredReward:
        """From what was fitted to completed pairs, the reward of the last answers; ``linear`` is that of all alike."""
        return replace(linear, weights=fitted.weights[:, : self.signals])
