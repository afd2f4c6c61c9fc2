"""How well a participant's reward model foresaw their answers. Every answer was predicted before it was given.

Pages, reports and exports take these figures from here, so that one answer is never counted in two ways.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from math import comb, inf, sqrt

from app.domain.preferences import Response

WINDOW = 30
"""Answers in the running accuracy."""

FIRST_POINT = 5
"""Scored answers before a curve is drawn; fewer say nothing."""

PATIENCE = 20
"""Scored answers after which a model that foresees more than half must have proved itself."""

ENOUGH_EVIDENCE = 20.0
"""1 / 5 %: whoever guesses ever reaches so much with a chance of at most 5 %, however often one looks (Ville)."""

_Z = 1.959964
"""Standard normal quantile of a two-sided 95 % interval."""


@dataclass(frozen=True)
class Share:
    """A share of correct predictions with its 95 % Wilson interval, all in [0, 1]."""

    correct: float
    """A half for every prediction without an opinion."""
    scored: int
    low: float
    high: float

    @property
    def value(self) -> float:
        """The share itself."""
        return self.correct / self.scored


@dataclass(frozen=True)
class Predicted:
    """One answer, and what was predicted of it."""

    response: Response
    predicted_right: float | None
    drawn_at_random: bool


@dataclass(frozen=True)
class AccuracyPoint:
    """The accuracy over the last WINDOW scored answers, after ``scored`` of them."""

    scored: int
    recent: Share


class Foresight(StrEnum):
    """What may be said of a model, as often as one likes to look."""

    UNKNOWN = "unknown"
    """Too few answers to say anything."""
    GUESSING = "guessing"
    """Not shown to be better than guessing, though it should be by now."""
    BETTER = "better"
    """Better than guessing."""


@dataclass(frozen=True)
class Curve:
    """Accuracy over time; only answers that prefer a side and were predicted are scored."""

    points: Sequence[AccuracyPoint]
    overall: Share | None
    """None before the first scored answer."""
    foresight: Foresight

    @property
    def newest(self) -> Share | None:
        """The accuracy over the last answers; None while there are too few."""
        return self.points[-1].recent if self.points else None

    @property
    def proven(self) -> bool:
        """Whether anything may be rested on the model."""
        return self.foresight is Foresight.BETTER


def hits(answers: Iterable[Predicted]) -> list[float]:
    """Of each answer that is scored: 1 foreseen, 0 not, 1/2 where the model had no opinion (exactly one half).

    Scored is what prefers a side, was predicted, and was drawn at random: what a model chose to ask is where it is
    worst; on that, every way of choosing well would look bad.
    """
    return [
        hit(answer.predicted_right, answer.response)
        for answer in answers
        if answer.drawn_at_random
        and answer.predicted_right is not None
        and answer.response in (Response.LEFT, Response.RIGHT)
    ]


def hit(predicted_right: float, response: Response) -> float:
    """1 foreseen, 0 not, 1/2 for a prediction without an opinion."""
    if predicted_right == 0.5:
        return 0.5
    return float((predicted_right > 0.5) == (response is Response.RIGHT))


def curve(found: Sequence[float]) -> Curve:
    """The curve of ``hits``, in the order of the answers."""
    points = []
    for scored in range(FIRST_POINT, len(found) + 1):
        window = found[max(0, scored - WINDOW) : scored]
        points.append(AccuracyPoint(scored, wilson(sum(window), len(window))))
    return Curve(points, wilson(sum(found), len(found)) if found else None, foresight(found))


def foresight(found: Sequence[float]) -> Foresight:
    """Whether a model foresees more than guessing would: by evidence that stands however often it is looked at."""
    correct, wrong = found.count(1.0), found.count(0.0)
    if evidence_against_guessing(correct, correct + wrong) >= ENOUGH_EVIDENCE:
        return Foresight.BETTER
    if len(found) < FIRST_POINT or (len(found) < PATIENCE and correct > wrong):
        return Foresight.UNKNOWN
    return Foresight.GUESSING


def evidence_against_guessing(correct: int, scored: int) -> float:
    """How much better somebody did who bet on the predictions than they may expect if these are right half the time.

    Accuracies from 1/2 to 1 are bet on alike (Robbins 1970): 2 int_{1/2}^1 p^k (1 - p)^(n - k) dp / 2^-n, which is the
    sum below. While every next prediction is right with a chance of at most 1/2, it is expected not to grow, so that
    it ever exceeds x with a chance of at most 1 / x.
    """
    total, ways = 0, 1  # ways: to choose ``fewer`` of scored + 1
    for fewer in range(correct + 1):
        total, ways = total + ways, ways * (scored + 1 - fewer) // (fewer + 1)
    return _ratio(total, (scored + 1) * comb(scored, correct))


def evidence_against_a_fair_coin(heads: int, tosses: int) -> float:
    """The same for a coin that may favour either side: every chance from 0 to 1 is bet on alike."""
    return _ratio(2**tosses, (tosses + 1) * comb(tosses, heads))


def _ratio(numerator: int, denominator: int) -> float:
    """Of numbers of any size; infinite where it is beyond doubt."""
    return inf if numerator >= denominator << 64 else numerator / denominator


def wilson(correct: float, scored: int) -> Share:
    """The 95 % Wilson score interval of a share; it stays within [0, 1] and is right for small counts."""
    share, z2 = correct / scored, _Z**2
    centre = (share + z2 / (2 * scored)) / (1 + z2 / scored)
    half = _Z * sqrt(share * (1 - share) / scored + z2 / (4 * scored**2)) / (1 + z2 / scored)
    return Share(correct, scored, max(0.0, centre - half), min(1.0, centre + half))
