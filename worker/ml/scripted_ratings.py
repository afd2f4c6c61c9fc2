"""How a scripted participant rates a robot they watched. Invented, for rehearsals: no people were measured.

What somebody has seen while comparing is the yardstick: q is the share of the pool's episodes whose preference reward
r^H (summed over the episode) was lower than that of the episode to be rated. With e drawn anew for every rating and b
once per person, both Gaussian,

    personalisation = 1 + 4 (q + b + e)
    satisfaction    = 1 + 4 ((1 - w) q + w success + b + e')

rounded and cut to 1 .. 5. So a robot that suits somebody but fails is personal without satisfying, which is how the
paper explains its own ratings of PrefFT.
"""

from dataclasses import dataclass

import numpy as np

from worker.domain.type_aliases import FloatArray

POINTS = 5


@dataclass(frozen=True)
class RatingManner:
    """How exactly somebody rates; all in shares of the scale from 1 to 5."""

    noise: float = 0.12
    """standard deviation of e and e'"""
    leniency: float = 0.08
    """standard deviation of b over people"""
    success_share: float = 0.5
    """w: how much of the satisfaction is whether the task was done"""


class ScriptedRater:
    """One person's ratings."""

    def __init__(self, seen_returns: FloatArray, manner: RatingManner, rng: np.random.Generator) -> None:
        """``seen_returns`` (N,): r^H of the episodes of the pool, each summed."""
        self._seen = np.sort(np.asarray(seen_returns, np.float64))
        self._manner, self._rng = manner, rng
        self._bias = float(rng.normal(0.0, manner.leniency))

    def rate(self, preference_return: float, success: bool) -> tuple[int, int]:
        """Satisfaction and personalisation, 1 to 5 each."""
        share = self.share(preference_return)
        weight = self._manner.success_share
        return 1 + self.place((1 - weight) * share + weight * success), 1 + self.place(share)

    def share(self, preference_return: float) -> float:
        """q: the share of what was seen that is worse."""
        return float(np.searchsorted(self._seen, preference_return)) / len(self._seen)

    def place(self, share: float, places: int = POINTS) -> int:
        """Which of so many points is chosen for something this good, 0 to places - 1."""
        felt = share + self._bias + float(self._rng.normal(0.0, self._manner.noise))
        return int(np.clip(round((places - 1) * felt), 0, places - 1))
