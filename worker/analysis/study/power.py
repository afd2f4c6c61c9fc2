"""How likely a study of this very design is to find an effect, for several numbers of people: by simulation.

What somebody says of a method is 3 (the middle of the scale) + their own level + what the method is to them + the
noise of one rating, rounded and cut to 1 to 5. One method is better than all the others by the effect on average. A
share of those who begin drops out, and counts in no test. Every invented study is tested as the page of results
would: ratings for a difference of means (paired t, between arms Welch's), for their order (cumulative link model) or
for equivalence; head-to-heads by Bradley-Terry strengths, or Wilcoxon's test where they say nothing; corrected by Holm
over all comparisons of the design, of which one that this test cannot make counts as not found. Intervals of the power
are Wilson's, 95 %: they say how far the simulation may be off.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np

from worker.analysis.study.between import equivalence_between, means_of, welch_t
from worker.analysis.study.bradley_terry import comparisons
from worker.analysis.study.cumulative_link import cumulative_link, cumulative_link_between
from worker.analysis.study.effect_sizes import holm
from worker.analysis.study.hypothesis_tests import FEWEST_PAIRED, equivalence, paired_t
from worker.analysis.wilson import wilson_interval
from worker.domain.type_aliases import FloatArray

ALPHA, WANTED = 0.05, 0.8
_MIDDLE, _TIE = 3.0, 0.5
"""Of the scale; and the difference, in points, below which two robots side by side are called equal."""


@dataclass(frozen=True)
class Truth:
    """What is simulated. Effects, levels, spreads and noise in points of the scale."""

    methods: int
    better: int
    """Which method is better than the others."""
    compared: int
    """With which other one its difference is to be found."""
    arms: tuple[tuple[int, ...], ...]
    """Methods that the people of each arm meet; one arm: everybody meets all."""
    trials: int
    head_to_heads: int
    ties: bool
    effect: float
    spread: float
    """Standard deviation over people of the difference between two methods."""
    levels: float
    """Standard deviation over people of how they rate altogether."""
    noise: float
    dropout: float
    test: str = "difference"
    """Of the ratings; as app.domain.power_plan.PowerTest."""
    bound: float = 0.5
    """Of equivalence, in points."""

    @property
    def comparisons(self) -> int:
        """Of every two methods."""
        return self.methods * (self.methods - 1) // 2

    @property
    def wanted(self) -> tuple[int, int]:
        """The comparison that is to be found."""
        return min(self.better, self.compared), max(self.better, self.compared)


def power_at(truth: Truth, people: int, studies: int, seed: int) -> dict[str, Any]:
    """people, completed (mean), and for ``ratings`` and ``head_to_heads``: power, low, high.

    ``head_to_heads`` is None without any, and for equivalence, which they have no test of.
    """
    rng = np.random.default_rng([seed, people])
    found, found_side_by_side, completed = 0, 0, 0
    side_by_side = truth.head_to_heads > 0 and truth.test != "equivalence"
    for _ in range(studies):
        stayed = int(rng.binomial(people, 1 - truth.dropout))
        completed += stayed
        worth, arms = _worth(truth, stayed, rng)
        found += _ratings_find(truth, _ratings(truth, worth, rng), arms)
        if side_by_side:
            found_side_by_side += _is_found(truth, _head_to_heads_p(truth, worth, arms, rng))
    return {
        "people": people,
        "completed": completed / studies,
        "ratings": _power(found, studies),
        "head_to_heads": _power(found_side_by_side, studies) if side_by_side else None,
    }


def enough(rows: Sequence[dict[str, Any]], what: str) -> int | None:
    """The smallest number of people from which on the power is as wanted at all larger numbers, by its lower end."""
    fewest = None
    for row in reversed(rows):
        if row[what] is None or row[what]["low"] < WANTED:
            break
        fewest = row["people"]
    return fewest


def _power(found: int, studies: int) -> dict[str, float]:
    low, high = wilson_interval(found, studies)
    return {"power": found / studies, "low": low, "high": high}


def _worth(truth: Truth, people: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """What each method is to each person, (people, methods), and who meets which: True or False."""
    means = np.full(truth.methods, -truth.effect / 2)
    means[truth.better] = truth.effect / 2
    worth = _MIDDLE + means + rng.normal(0.0, truth.spread / 2**0.5, (people, truth.methods))
    worth += rng.normal(0.0, truth.levels, people)[:, None]
    meets = np.zeros((len(truth.arms), truth.methods), bool)
    for arm, methods in enumerate(truth.arms):
        meets[arm, list(methods)] = True
    return worth, meets[np.arange(people) % len(truth.arms)]


def _ratings(truth: Truth, worth: FloatArray, rng: np.random.Generator) -> FloatArray:
    """What everybody says of each method, 1 to 5: (people, methods, trials)."""
    said = worth[:, :, None] + rng.normal(0.0, truth.noise, (*worth.shape, truth.trials))
    return np.clip(np.rint(said), 1, 5)


def _ratings_find(truth: Truth, ratings: FloatArray, meets: Any) -> bool:
    """As _is_found of all p values, of which the others are needed only where Holm's correction decides."""
    p = _rating_p(truth, ratings, meets, *truth.wanted)
    if p is None or p >= ALPHA:
        return False
    return p * truth.comparisons < ALPHA or _is_found(truth, ratings_p(truth, ratings, meets))


def ratings_p(truth: Truth, ratings: FloatArray, meets: Any) -> list[float | None]:
    """Of every two methods, all by the one test that can compare the two in question; None: it cannot.

    ``ratings``: (people, methods, trials); ``meets`` (whether somebody meets a method): (people, methods).
    """
    return [_rating_p(truth, ratings, meets, *pair) for pair in combinations(range(truth.methods), 2)]


def _rating_p(truth: Truth, ratings: FloatArray, meets: Any, first: int, second: int) -> float | None:
    if (meets[:, truth.better] & meets[:, truth.compared]).sum() >= FEWEST_PAIRED:
        both = meets[:, first] & meets[:, second]
        return _paired(truth, list(ratings[both, first]), list(ratings[both, second])).get("p")
    alone = [list(ratings[meets[:, one] & ~meets[:, other], one]) for one, other in ((first, second), (second, first))]
    return _between(truth, *alone).get("p")


def _paired(truth: Truth, first: Sequence[FloatArray], second: Sequence[FloatArray]) -> dict[str, Any]:
    if truth.test == "cumulative_link":
        return cumulative_link(first, second)
    differences = (means_of(second) - means_of(first)).round(12)
    return equivalence(differences, truth.bound) if truth.test == "equivalence" else paired_t(differences)


def _between(truth: Truth, first: Sequence[FloatArray], second: Sequence[FloatArray]) -> dict[str, Any]:
    if truth.test == "cumulative_link":
        return cumulative_link_between(first, second)
    means = means_of(first), means_of(second)
    return equivalence_between(*means, truth.bound) if truth.test == "equivalence" else welch_t(*means)


def _head_to_heads_p(truth: Truth, worth: FloatArray, meets: Any, rng: np.random.Generator) -> list[float | None]:
    pairs = list(combinations(range(truth.methods), 2))
    wins = np.zeros((len(worth), truth.methods, truth.methods))
    for first, second in pairs:
        noise = rng.normal(0.0, truth.noise * 2**0.5, (len(worth), truth.head_to_heads))
        felt = (worth[:, first] - worth[:, second])[:, None] + noise
        won = (np.where(truth.ties & (np.abs(felt) < _TIE), 0.5, felt > 0)).sum(axis=1)
        both = meets[:, first] & meets[:, second]
        wins[:, first, second], wins[:, second, first] = both * won, both * (truth.head_to_heads - won)
    return [each["p"] for each in comparisons(wins)]


def _is_found(truth: Truth, p_values: Sequence[float | None]) -> bool:
    """Whether the comparison is significant after Holm's correction; in whichever direction."""
    p = holm(p_values)[list(combinations(range(truth.methods), 2)).index(truth.wanted)]
    return p is not None and p < ALPHA
