"""Scripted teachers: simulated participants with known tastes, for rehearsals, tests and measurements.

A teacher sees the preference reward r^H of every step (the paper's Eq. 9; worker.sim.costs.preference_rewards computes
it for an omega) and names the segment with the larger sum. How it errs follows B-Pref (Lee et al. 2021), with every
threshold in units of the spread of returns, so that a setting means the same for every taste.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from math import isfinite
from typing import Self

import numpy as np
import numpy.typing as npt

from worker.domain.responses import Response
from worker.domain.trajectory import COSTS, SIGNALS
from worker.domain.type_aliases import FloatArray


class User(StrEnum):
    """The paper's three types of users."""

    NEUTRAL = "neutral"
    CAUTIOUS = "cautious"
    IMPATIENT = "impatient"


OMEGA: Mapping[User, tuple[float, ...]] = {
    User.NEUTRAL: (1.0, 1.0, 1.0, 1.0, 1.0, 1.0),
    User.CAUTIOUS: (1.0, 2.0, 1.5, 2.5, 3.0, 2.0),
    User.IMPATIENT: (2.0, 0.5, 0.75, 0.5, 1.5, 0.5),
}
"""The paper's omega, in the order of worker.domain.trajectory.COSTS."""


@dataclass(frozen=True)
class Taste:
    """Somebody outside the paper's types: an omega with the calibrated costs, and more costs per unit of a signal."""

    name: str
    omega: tuple[float, ...] = (1.0,) * 6
    per_signal: Mapping[str, float] = field(default_factory=dict)
    """per control step; below 0: likes it"""

    def __post_init__(self) -> None:
        if len(self.omega) != len(COSTS) or any(not isfinite(weight) for weight in self.omega):
            raise ValueError(f"A taste needs {len(COSTS)} finite weights, for {', '.join(COSTS)}; got {self.omega}.")
        unknown = self.per_signal.keys() - set(SIGNALS)
        if unknown:
            raise ValueError(f"No signal is called {', '.join(sorted(unknown))}; there are {', '.join(SIGNALS)}.")

    @classmethod
    def of_omega(cls, omega: Sequence[float]) -> Self:
        """Somebody with these weights, named after them."""
        return cls("omega-" + "-".join(f"{weight:g}" for weight in omega), tuple(omega))


class LabTaste(Taste):
    """Somebody with a laboratory's task, who minds its signals alone; which there are, the task knows."""

    def __post_init__(self) -> None:
        if not self.per_signal or any(not isfinite(weight) for weight in self.per_signal.values()):
            raise ValueError(f"Somebody must mind a signal, with a finite weight; got {dict(self.per_signal)}.")

    def step_rewards(self, signals: npt.ArrayLike, names: Sequence[str]) -> FloatArray:
        """(..., S) -> (...,) of every step. Raises ValueError for signals that the task does not have."""
        rewards: FloatArray = np.asarray(signals, np.float64) @ self.signal_weights(names)
        return rewards

    def signal_weights(self, names: Sequence[str]) -> FloatArray:
        """(S,) of a task's signals, above 0: wanted. Raises ValueError."""
        unknown = sorted(self.per_signal.keys() - set(names))
        if unknown:
            raise ValueError(f"No signal is called {', '.join(unknown)}; there are {', '.join(names)}.")
        return -np.array([self.per_signal.get(name, 0.0) for name in names])


OF_LABS: tuple[LabTaste, ...] = (
    LabTaste("quick", per_signal={"undelivered": 1.0}),
    LabTaste("smooth", per_signal={"action_change_squared": 1.0}),
)
"""Who rehearses a laboratory's task when nobody else is named: what they mind is measured in every lab."""

OPPOSED: tuple[tuple[Taste, Taste], ...] = (
    (
        Taste("slow", (1.0, 6.0, 1.0, 1.0, 1.0, 1.0), {"acceleration_squared_m2_s4": 0.3}),
        Taste("quick", (2.0, 0.1, 1.0, 1.0, 1.0, 1.0), {"undelivered": 0.1}),
    ),
    (
        Taste("close", per_signal={"lateral_offset_m": 8.0}),
        Taste("wide", per_signal={"lateral_offset_m": -8.0}),
    ),
    (
        Taste("gentle", (1.0, 1.0, 2.0, 2.0, 1.0, 2.0), {"near_speed_squared_m2_s2": 20.0, "force_squared_n2": 0.05}),
        Taste("brisk", (2.0, 0.1, 0.2, 0.2, 1.0, 0.2), {"near_speed_squared_m2_s2": -8.0, "force_squared_n2": -0.01}),
    ),
)
"""Users who truly differ: both of a pair care most about one thing, in opposite directions."""

INDIRECT: tuple[Taste, ...] = (
    Taste("steady", per_signal={"turn_speed_squared_rad2_s2": 3.0}),
    Taste("upright", per_signal={"tilt_rad": 0.3}),
    Taste("tidy", (1.0, 1.0, 1.0, 1.0, 8.0, 8.0), {"spilled": 5.0}),
)
"""Users whose taste no mode axis moves directly: how the tool turns, how it is held, what is spilled."""

TASTES: Mapping[str, Taste] = {
    **{user.value: Taste(user.value, OMEGA[user]) for user in User},
    **{taste.name: taste for pair in OPPOSED for taste in pair},
    **{taste.name: taste for taste in INDIRECT},
}
"""Everybody with a name: the paper's three, the opposed ones, and those that no mode is made for."""

_POPULATION_SIGNALS = {
    "lateral_offset_m": 8.0,
    "near_speed_squared_m2_s2": 8.0,
    "acceleration_squared_m2_s4": 0.2,
    "undelivered": 0.06,
}
"""Largest size of what the people of a population mind or like beyond the six items."""


def random_taste(name: str, rng: np.random.Generator) -> Taste:
    """Somebody of a population: each omega between a fifth and five times the reference, and one or two more likes."""
    omega = tuple(float(weight) for weight in 5.0 ** rng.uniform(-1.0, 1.0, len(COSTS)))
    minded = rng.choice(list(_POPULATION_SIGNALS), int(rng.integers(1, 3)), replace=False)
    return Taste(name, omega, {str(each): float(rng.uniform(-1, 1)) * _POPULATION_SIGNALS[each] for each in minded})


@dataclass(frozen=True)
class Manner:
    """How a teacher answers. The defaults are those of the measurements in docs/results."""

    rationality: float | None = None
    """beta: P(right) = sigmoid(beta * difference / spread); None always names the better one"""
    myopia: float = 1.0
    """gamma: step t of T counts gamma^(T - t), so that below 1 the end of a clip weighs more"""
    mistakes: float = 0.05
    """epsilon: share of answers that say the opposite"""
    equal_share: float = 0.10
    """share of pairs, those that differ least, that are called equal"""
    skip_share: float = 0.0
    """share of pairs on which the teacher cannot tell"""


@dataclass(frozen=True)
class ScriptedTeacher:
    """Answers pairs of segments. ``spread`` and ``equal_below`` are in units of returns; see calibrated()."""

    manner: Manner
    spread: float
    equal_below: float

    @classmethod
    def calibrated(cls, manner: Manner, pool_rewards: npt.ArrayLike) -> Self:
        """A teacher whose thresholds fit pairs like these: preference rewards (N, 2, T)."""
        returns = segment_returns(np.asarray(pool_rewards, np.float64), manner.myopia)
        differences = returns[:, 1] - returns[:, 0]
        spread = max(float(np.sqrt((differences**2).mean())), 1e-9)
        return cls(manner, spread, float(np.quantile(np.abs(differences), manner.equal_share)))

    def answer(self, left_rewards: npt.ArrayLike, right_rewards: npt.ArrayLike, rng: np.random.Generator) -> Response:
        """What this teacher says about one pair, from the preference rewards (T,) of the shown steps."""
        skips, errs, decides = rng.random(3)  # always three draws: one answer does not shift the next one's luck
        if skips < self.manner.skip_share:
            return "skip"
        left, right = segment_returns(np.array([left_rewards, right_rewards], np.float64), self.manner.myopia)
        difference = float(right - left)
        if self.manner.equal_share > 0.0 and abs(difference) <= self.equal_below:
            return "equal"
        names_right = difference > 0.0
        if self.manner.rationality is not None:
            odds = np.clip(self.manner.rationality * difference / self.spread, -50.0, 50.0)
            names_right = bool(decides < 1.0 / (1.0 + np.exp(-odds)))
        if errs < self.manner.mistakes:
            names_right = not names_right
        return "right" if names_right else "left"


def speaks_most(gains: FloatArray, qualities: Mapping[str, Sequence[int]]) -> str:
    """The quality that speaks most for a segment: gains (S,) of it over the other by signal, columns by quality."""
    return max(qualities, key=lambda name: float(gains[list(qualities[name])].sum()))


def truest(directions: Mapping[str, FloatArray], wants: FloatArray, most: int) -> list[str]:
    """The hints that say most of what somebody wants, at most so many: directions (S,) by name, wants (S,) by signal.

    ``wants``: weights in units of the usual differences. Nothing that is not wanted is among them.
    """
    gains = {name: float(each @ wants) for name, each in directions.items()}
    return [name for name in sorted(gains, key=lambda name: -gains[name]) if gains[name] > 0.0][:most]


def segment_returns(rewards: FloatArray, myopia: float = 1.0) -> FloatArray:
    """(..., T) -> (...): summed rewards, later steps counting more when myopia < 1."""
    returns: FloatArray = rewards @ myopia ** np.arange(rewards.shape[-1] - 1, -1, -1)
    return returns
