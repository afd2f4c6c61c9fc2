"""What each pair of a participant is for, from the first to the last: drawn once from their seed, known beforehand.

Practice comes first, then labels on whole trajectories, then the other labels with repeats and catch pairs among them.
Which clips a place gets is decided later, when the newest model can have a say; see query_selection.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
import numpy.typing as npt

from app.domain.preferences import Purpose
from app.domain.study_settings import StudySettings
from worker.domain.trajectory import SIGNALS
from worker.ml.acquisition import balanced_sides
from worker.ml.rewards.segments import SegmentPairs, Stretch

REPEAT_DISTANCE = 10
"""Answers from a pair to its repetition at least, so that nobody remembers the answer; fewer only where a study is too
short for it."""
CATCH_FROM = 12
"""Place among clips from which on catch pairs come: by then the pool is likely to have an obvious pair."""
_MOST_DIFFERENT = 0.1
"""Share of the pairs that are different enough for practice."""
_UNDELIVERED = "undelivered"
_UNCLEAN = ("spilled_on_person", "high_force_n")


@dataclass(frozen=True)
class Slot:
    """One place in the order of a participant's pairs."""

    ordinal: int
    """from 1"""
    purpose: Purpose
    repeats_ordinal: int | None = None
    """which place a repeat asks again"""
    swapped: bool = False
    """whether a repeat exchanges the sides"""


def plan(settings: StudySettings, seed: int) -> tuple[Slot, ...]:
    """Every place of one participant's pairs; the same settings and seed give the same plan."""
    return _plan(
        settings.practice_pairs,
        settings.introduction_count,
        settings.labels_per_participant - settings.introduction_count,
        settings.repeated_pairs,
        settings.catch_pairs,
        seed,
    )


@lru_cache(maxsize=512)
def _plan(practice: int, introduction: int, labels: int, repeats: int, catch: int, seed: int) -> tuple[Slot, ...]:
    rng = np.random.default_rng([seed, 0x9A17])
    slots = [Slot(place, Purpose.PRACTICE) for place in range(1, practice + 1)]
    slots += [Slot(len(slots) + place, Purpose.INTRODUCTION) for place in range(1, introduction + 1)]
    left = {Purpose.PREFERENCE: labels, Purpose.REPEAT: repeats, Purpose.CATCH: catch}
    swaps = iter(balanced_sides(repeats, rng))
    repeatable = [] if labels else list(range(practice + 1, len(slots) + 1))  # only where nothing else was asked
    begin = len(slots)
    while sum(left.values()):
        ordinal = len(slots) + 1
        old = [each for each in repeatable if ordinal - each >= REPEAT_DISTANCE]
        purpose = _draw(left, bool(old), ordinal - begin > CATCH_FROM, rng)
        left[purpose] -= 1
        if purpose is Purpose.REPEAT:
            asked = _asked_again(old, repeatable, slots, rng)
            slots.append(Slot(ordinal, purpose, asked, bool(next(swaps))))
            if asked in repeatable:
                repeatable.remove(asked)
            continue
        slots.append(Slot(ordinal, purpose))
        if purpose is Purpose.PREFERENCE:
            repeatable.append(ordinal)
    return tuple(slots)


def _draw(left: dict[Purpose, int], can_repeat: bool, can_catch: bool, rng: np.random.Generator) -> Purpose:
    """What comes next: in proportion to what is left of it; what cannot come yet only when nothing else is left."""
    chances = {
        Purpose.PREFERENCE: left[Purpose.PREFERENCE],
        Purpose.REPEAT: left[Purpose.REPEAT] if can_repeat else 0,
        Purpose.CATCH: left[Purpose.CATCH] if can_catch else 0,
    }
    if not sum(chances.values()):
        return next(each for each in (Purpose.PREFERENCE, Purpose.CATCH, Purpose.REPEAT) if left[each])
    weights = np.array(list(chances.values()), np.float64)
    return list(chances)[int(rng.choice(len(chances), p=weights / weights.sum()))]


def _asked_again(old: list[int], repeatable: list[int], slots: list[Slot], rng: np.random.Generator) -> int:
    """The place to ask again: an old one that was not yet repeated, else the oldest there is."""
    if old:
        return old[int(rng.integers(len(old)))]
    if repeatable:
        return repeatable[0]
    labels = [slot.ordinal for slot in slots if slot.purpose in (Purpose.PREFERENCE, Purpose.INTRODUCTION)]
    return labels[int(rng.integers(max(1, len(labels) // 2)))]


def very_different(pairs: SegmentPairs) -> npt.NDArray[np.int64]:
    """The rows of the pairs that differ most in what was measured, each signal in units of its spread; one at least."""
    differences = pairs.signal_differences()
    spread = np.sqrt((differences**2).mean(axis=0))
    distance = np.sqrt(((differences / np.where(spread > 1e-9, spread, np.inf)) ** 2).sum(axis=1))
    count = max(1, round(_MOST_DIFFERENT * len(distance)))
    return np.argsort(-distance, kind="stable")[:count]


def obvious_answer(left: Stretch, right: Stretch, signals: Sequence[str] = SIGNALS) -> Literal["left", "right"] | None:
    """Which side nobody would refuse: a clean success beside a run that fails and is seen to; None where that is open.

    Only what is shown counts: somebody who likes it slow may prefer a run that has not arrived at the end of the clip,
    so that one must have failed altogether.
    """
    if _clean(left, signals) and _failed(right, signals):
        return "left"
    return "right" if _clean(right, signals) and _failed(left, signals) else None


def _clean(side: Stretch, names: Sequence[str]) -> bool:
    signals = side.cut("signals")
    delivered = side.trajectory.success and not signals[-1, names.index(_UNDELIVERED)]
    return bool(delivered and not signals[:, [names.index(name) for name in _UNCLEAN if name in names]].any())


def _failed(side: Stretch, names: Sequence[str]) -> bool:
    return not side.trajectory.success and bool(side.cut("signals")[-1, names.index(_UNDELIVERED)])
