"""What earlier participants wanted, as the prior of the next one: a start for the first ten to fifty labels.

For the structured kind only, whose weights mean the same for everybody. Pulling people together costs accuracy exactly
where they differ, so the prior is an option, and wide.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
import numpy.typing as npt

from worker.domain.type_aliases import FloatArray
from worker.ml.rewards.reward_models import RewardModel, StructuredReward

DEVIATION = 4.0
"""Of every weight when nobody is known: wide, because a narrow prior spreads what is wanted over all signals that go
along with it (docs/results/chosen_modes.md)."""
FEWEST_PEOPLE = 3
"""With fewer the prior is the one without anybody."""
SHARED, OWN, FLOOR = 0.7, 0.3, 0.05
"""Shares of the covariance and of its diagonal, and of the variance without anybody."""


@dataclass(frozen=True)
class Prior:
    """N(mean, covariance) of the weights in log odds per standard deviation of a pair."""

    mean: FloatArray
    """(S,)"""
    covariance: FloatArray
    """(S, S)"""

    @classmethod
    def standard(cls, size: int) -> Self:
        """N(0, DEVIATION^2 I)"""
        return cls(np.zeros(size), DEVIATION**2 * np.eye(size))

    @classmethod
    def pooled(cls, weights: npt.ArrayLike) -> Self:
        """From the weights of P people, (P, S): their mean, .7 covariance + .3 diagonal + .05 of standard()."""
        given = np.asarray(weights, np.float64)
        usual = cls.standard(given.shape[-1])
        if len(given) < FEWEST_PEOPLE:
            return usual
        covariance = np.cov(given, rowvar=False)
        shrunk = SHARED * covariance + OWN * np.diag(np.diag(covariance)) + FLOOR * usual.covariance
        return cls(given.mean(axis=0), shrunk)


def prior_of(models: Sequence[RewardModel], spread: FloatArray) -> Prior:
    """The prior that earlier participants' reward models give; ``spread`` (S,) as in SignalScale."""
    known = [each.weights.mean(axis=0) * spread for each in models if isinstance(each, StructuredReward)]
    return Prior.pooled(known) if known else Prior.standard(len(spread))
