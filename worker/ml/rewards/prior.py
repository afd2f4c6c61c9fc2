"""What somebody may want before their first answer: they are of one of several populations, or like nobody known.

For the kinds that are linear in signals, whose weights mean the same for everybody. Every population is a Gaussian, and
the answers themselves say which of them somebody is of (reward_training.posterior). So a prior can be narrow where it
is right and is soon out of the way where it is not: nobody is pulled towards people whom their answers contradict.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import numpy.typing as npt

from worker.domain.type_aliases import FloatArray
from worker.ml.rewards.reward_models import RewardModel, StructuredReward

DEVIATION = 4.0
"""Of every weight of somebody who is like nobody known: wide, because a narrow prior spreads what is wanted over all
signals that go along with it (docs/results/chosen_modes.md)."""
INDIFFERENT, DECIDED = 0.5, 10.0
"""Deviations of the weights of somebody to whom one signal matters: of all others, and of that one, which decides as
much as all weights of a scripted person together. What else was tried: docs/decisions.md, 195."""
NOBODY_KNOWN, SCRIPTED, EARLIER = "nobody known", "scripted people", "earlier participants"
ONE_MATTERS = "people to whom one thing matters"
"""What populations are called."""
FEWEST_PEOPLE = 3
"""Fewer are no population."""
SHARED, OWN, FLOOR = 0.7, 0.3, 0.05
"""Shares of the covariance and of its diagonal, and of the variance of somebody who is like nobody known."""


@dataclass(frozen=True)
class Population:
    """People whose weights are N(mean, covariance), in log odds per standard deviation of a pair."""

    name: str
    """in a model's metrics"""
    mean: FloatArray
    """(S,)"""
    covariance: FloatArray
    """(S, S)"""

    @classmethod
    def anybody(cls, size: int) -> Self:
        """N(0, DEVIATION^2 I)"""
        return cls(NOBODY_KNOWN, np.zeros(size), DEVIATION**2 * np.eye(size))

    @classmethod
    def of(cls, name: str, weights: FloatArray) -> Self:
        """From the weights of P people, (P, S): their mean, .7 covariance + .3 diagonal + .05 of anybody()."""
        covariance = np.cov(weights, rowvar=False)
        shrunk = SHARED * covariance + OWN * np.diag(np.diag(covariance))
        return cls(name, weights.mean(axis=0), shrunk + FLOOR * cls.anybody(weights.shape[-1]).covariance)

    @classmethod
    def for_whom_matters(cls, column: int, size: int) -> Self:
        """N(0, INDIFFERENT^2) but for one signal, which is wanted or minded, N(0, DECIDED^2)."""
        deviations = np.full(size, INDIFFERENT)
        deviations[column] = DECIDED
        return cls(ONE_MATTERS, np.zeros(size), np.diag(deviations**2))

    def with_further(self, count: int, deviation: float) -> Self:
        """See Prior."""
        size = len(self.mean)
        covariance = np.diag(np.full(size + count, deviation**2))
        covariance[:size, :size] = self.covariance
        return replace(self, mean=np.append(self.mean, np.zeros(count)), covariance=covariance)


@dataclass(frozen=True)
class Prior:
    """The populations that somebody may be of; the first is anybody().

    Every name is as likely as the others, and so is every population among those of one name.
    """

    populations: tuple[Population, ...]

    @property
    def log_chances(self) -> FloatArray:
        """(P,) of each population before the first answer, up to a constant."""
        alike = Counter(each.name for each in self.populations)
        return -np.log([alike[each.name] for each in self.populations])

    def by_name(self, shares: FloatArray) -> dict[str, float]:
        """Of (P,) chances of populations the sum for each name."""
        sums = dict.fromkeys((each.name for each in self.populations), 0.0)
        for each, share in zip(self.populations, shares, strict=True):
            sums[each.name] += float(share)
        return sums

    @classmethod
    def standard(cls, size: int) -> Self:
        """Nobody is known."""
        return cls((Population.anybody(size),))

    def with_further(self, count: int, deviation: float) -> "Prior":
        """With so many more weights of which nobody knows more than N(0, deviation^2)."""
        return Prior(tuple(each.with_further(count, deviation) for each in self.populations))

    def or_for_whom_one_matters(self) -> "Prior":
        """Or somebody to whom hardly anything matters but one signal, whichever it is."""
        size = len(self.populations[0].mean)
        return Prior((*self.populations, *(Population.for_whom_matters(each, size) for each in range(size))))

    def or_like(self, name: str, weights: npt.ArrayLike) -> "Prior":
        """Or like P people with these weights, (P, S); too few are left out."""
        given = np.asarray(weights, np.float64)
        return Prior((*self.populations, Population.of(name, given))) if len(given) >= FEWEST_PEOPLE else self


def standardised_weights(models: Sequence[RewardModel], spread: FloatArray) -> list[FloatArray]:
    """What earlier participants' reward models weigh, (S,) each as in Population; ``spread`` (S,) as in SignalScale."""
    linear = [each for each in models if isinstance(each, StructuredReward)]
    return [each.weights_of_signals.mean(axis=0) * spread for each in linear]
