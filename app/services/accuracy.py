"""How well a participant's reward model foresaw their answers. Every answer was predicted before it was given."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import sqrt

WINDOW = 30
"""Answers in the running accuracy."""

FIRST_POINT = 5
"""Scored answers before a curve is drawn; fewer say nothing."""

_Z = 1.959964
"""Standard normal quantile of a two-sided 95 % interval."""


@dataclass(frozen=True)
class Share:
    """A share of correct predictions with its 95 % Wilson interval, all in [0, 1]."""

    correct: int
    scored: int
    low: float
    high: float

    @property
    def value(self) -> float:
        """The share itself."""
        return self.correct / self.scored


@dataclass(frozen=True)
class Point:
    """The accuracy over the last WINDOW scored answers, after ``scored`` of them."""

    scored: int
    recent: Share


@dataclass(frozen=True)
class Curve:
    """Accuracy over time; only answers that prefer a side and were predicted are scored."""

    points: Sequence[Point]
    overall: Share | None
    """None before the first scored answer."""

    @property
    def newest(self) -> Share | None:
        """The accuracy over the last answers; None while there are too few."""
        return self.points[-1].recent if self.points else None


def curve(hits: Sequence[bool]) -> Curve:
    """The curve of predictions that came true or not, in the order of the answers."""
    points = []
    for scored in range(FIRST_POINT, len(hits) + 1):
        window = hits[max(0, scored - WINDOW) : scored]
        points.append(Point(scored, wilson(sum(window), len(window))))
    return Curve(points, wilson(sum(hits), len(hits)) if hits else None)


def wilson(correct: int, scored: int) -> Share:
    """The 95 % Wilson score interval of a share; it stays within [0, 1] and is right for small counts."""
    share, z2 = correct / scored, _Z**2
    centre = (share + z2 / (2 * scored)) / (1 + z2 / scored)
    half = _Z * sqrt(share * (1 - share) / scored + z2 / (4 * scored**2)) / (1 + z2 / scored)
    return Share(correct, scored, max(0.0, centre - half), min(1.0, centre + half))
