"""How large the signals of a pool are, and how much they differ."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from worker.domain.type_aliases import FloatArray
from worker.ml.rewards.segments import SegmentPairs

OUTLIER_SHARE = 0.01
"""Of the mean signals at either end: the single wildest clip does not say what is usual."""
_SMALLEST_SPREAD = 1e-6


@dataclass(frozen=True)
class SignalScale:
    """What the signals are like in the clips of a pool."""

    spread: FloatArray
    """(S,) root mean square of the summed differences of a pair; a column that never differs has 1"""
    least_per_step: FloatArray
    most_per_step: FloatArray
    """(S,) the smallest and the largest mean of each signal over the steps of one clip or episode, outliers excepted"""

    @classmethod
    def of(cls, pairs: SegmentPairs, episode_means: npt.ArrayLike = ()) -> "SignalScale":
        """From pairs like those that are asked, and the mean signals of whole episodes like those behind them, (N, S).

        Both count as shown: an episode goes on after its clip, most often with less motion.
        """
        shown = pairs.shown[..., None]
        width = pairs.signals.shape[-1]
        means = pairs.signals.mean(axis=2, dtype=np.float64, where=shown).reshape(-1, width)
        bounds = [usual(each) for each in (means, np.reshape(episode_means, (-1, width))) if len(each)]
        least, most = np.min([low for low, _ in bounds], axis=0), np.max([high for _, high in bounds], axis=0)
        return cls(_spread_of(pairs.signal_differences()), least, most)


def usual(means: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The least and the most of each signal, (S,) both, in mean signals (N, S), outliers excepted."""
    low, high = np.quantile(means, [OUTLIER_SHARE, 1.0 - OUTLIER_SHARE], axis=0)
    return low, high


def _spread_of(differences: FloatArray) -> FloatArray:
    spread = np.sqrt((differences**2).mean(axis=0))
    return np.where(spread > _SMALLEST_SPREAD, spread, 1.0)
