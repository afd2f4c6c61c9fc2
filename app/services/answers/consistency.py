"""How far a person's answers can be trusted: flags for people to look at. Nothing is ever deleted or left out by them.

Pure functions on answers in the order in which they were asked; pages and reports take these figures from here.
Intervals are 95 %: Wilson score intervals for shares (accuracy.wilson), normal ones where said so. None means that
there is too little to say anything, never that all is well. How often flags are raised at people who deserve none is
measured in docs/results/error_rates.md.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from math import comb, exp, log, sqrt
from statistics import median
from typing import Any

from sqlalchemy import Row

from app.domain.preferences import Label, LabelEvent, Purpose, Response
from app.services.answers.accuracy import ENOUGH_EVIDENCE, Share, evidence_against_a_fair_coin, wilson

_Z = 1.959964
"""Standard normal quantile of a two-sided 95 % interval."""

TOO_FAST = 0.5
"""Answers given before this share of both clips was played are too fast."""
FASTEST = 2.0
"""The highest speed that the page offers."""
SLIPS = 0.02
"""As often as anybody may answer an obvious pair the wrong way."""
LONG_RUN = 12
"""So many times the same answer in a row is a straight line; by chance once in some thousand answers left or right."""
FEWEST_FOR_A_TREND = 20
FEWEST_REPEATS = 5
"""Pairs asked twice, for kappa and for the best accuracy possible; fewer say nothing about either."""
FEWEST_TIMED = 10
"""Answers, before anybody is said to be too fast."""

_SIDES = (Response.LEFT, Response.RIGHT)
_OTHER_SIDE = {Response.LEFT: Response.RIGHT, Response.RIGHT: Response.LEFT}


@dataclass(frozen=True, slots=True)
class JudgedAnswer:
    """One answer that counts, with what judging it needs."""

    ordinal: int
    query_id: int
    purpose: Purpose
    response: Response
    left_clip_id: int
    right_clip_id: int
    repeats_query_id: int | None = None
    expected: Response | None = None
    response_time_ms: int | None = None
    clip_ms: int | None = None
    """How long the longer clip lasts in real time."""
    seen: float | None = None
    """At most this share of the clip of which less was played; None when not measured."""
    by_script: bool | None = None
    """Whether the page's script sent it; None: it was not noted yet."""

    @property
    def chosen_clip_id(self) -> int | None:
        """The preferred clip, wherever it stood; None for equal and can't tell."""
        return {Response.LEFT: self.left_clip_id, Response.RIGHT: self.right_clip_id}.get(self.response)


@dataclass(frozen=True)
class Estimate:
    """A number with its 95 % interval."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class Repeats:
    """What became of pairs that were asked twice. Pairs on which somebody could not tell, once or twice, are left out.

    ``decided`` counts pairs on which a side was preferred both times.
    """

    asked: int
    agreement: Share | None
    """Same clip, or equal, both times."""
    decided: Share | None
    kappa: Estimate | None
    """Cohen's kappa over (first clip, equal, second clip)."""
    ceiling: Estimate | None
    swapped: Share | None
    """Agreement where the sides were exchanged: low beside a high agreement otherwise means answering by side."""
    unswapped: Share | None


@dataclass(frozen=True)
class Trend:
    """A change from the first to the last answer."""

    per_hundred: Estimate
    """Change in percent per hundred answers (t interval)."""


@dataclass(frozen=True)
class Consistency:
    """Everything that is said about one person's answers."""

    answered: int
    repeats: Repeats
    catch_errors: Share | None
    """Share of catch pairs on which the obviously worse side was preferred."""
    left: Share | None
    """Share of left among answers that prefer a side; without bias its interval holds one half."""
    too_fast: Share | None
    without_script: int
    """Answers sent by the plain form: nobody saw to it that the clips had been played, or measured how."""
    longest_run: int
    slowing: Trend | None
    """Of response times, log-linear: below 0 is quicker with practice, well above 0 is tired."""
    early_agreement: Share | None
    late_agreement: Share | None
    """Agreement of the repeats in the first and the second half: less in the second speaks for fatigue."""
    balance: dict[Response, int]
    median_response_ms: float | None
    working_ms: int | None
    """All response times together."""

    @property
    def flags(self) -> Sequence[str]:
        """Names of what deserves a look; each is stricter than its interval alone would be, for one looks often."""
        raised = {
            "catch_errors": self.catch_errors is not None and _no_slips(self.catch_errors),
            "side_bias": self.left is not None and _no_fair_coin(self.left),
            "too_fast": self.too_fast is not None and self.too_fast.scored >= FEWEST_TIMED and self.too_fast.low > 0.1,
            "without_script": self.without_script > 0,
            "straight_line": self.longest_run >= LONG_RUN,
            "inconsistent": self.repeats.kappa is not None and self.repeats.kappa.high < 0.4,
            "slowing": self.slowing is not None and self.slowing.per_hundred.low > 25.0,
            "cannot_tell": self.answered >= FEWEST_FOR_A_TREND and self.balance[Response.SKIP] > self.answered / 3,
        }
        return [name for name, is_raised in raised.items() if is_raised]


def answers_of(labels: Sequence[Label]) -> list[JudgedAnswer]:
    """From rows as preferences.current_answers gives them, clips loaded; in the order of the queries."""
    return [
        JudgedAnswer(
            ordinal=each.query.ordinal,
            query_id=each.query.id,
            purpose=Purpose(each.query.purpose),
            response=each.response,
            left_clip_id=each.query.left_clip_id,
            right_clip_id=each.query.right_clip_id,
            repeats_query_id=each.query.repeats_query_id,
            expected=None if each.query.expected is None else Response(each.query.expected),
            response_time_ms=each.event.response_time_ms,
            clip_ms=max(each.query.left_clip.duration_ms, each.query.right_clip.duration_ms),
            seen=seen(each.event, each.query.left_clip.duration_ms, each.query.right_clip.duration_ms),
            by_script=each.event.by_script,
        )
        for each in labels
    ]


def seen(event: LabelEvent | Row[*tuple[Any, ...]], left_ms: int, right_ms: int) -> float | None:
    """The share that was played of the clip of which less was, at whatever speed; of an event, or its columns.

    Unknown when somebody moved through the clips by hand. Of answers from before this was recorded, what the time
    would have been enough for at the highest speed.
    """
    left_ms, right_ms = max(1, left_ms), max(1, right_ms)
    if event.watched_whole:
        return 1.0
    if event.left_watched_ms is not None and event.right_watched_ms is not None:
        if event.scrub_count:
            return None
        return min(1.0, event.left_watched_ms / left_ms, event.right_watched_ms / right_ms)
    if event.response_time_ms is None:
        return None
    return min(1.0, event.response_time_ms * FASTEST / max(left_ms, right_ms))


def consistency(answers: Sequence[JudgedAnswer]) -> Consistency:
    """Judge one person's answers. Practice is left out of everything."""
    earnest = [answer for answer in answers if answer.purpose is not Purpose.PRACTICE]
    pairs = repeated(earnest)
    half = len(pairs) // 2
    halves = (pairs[:half], pairs[half:]) if half >= FEWEST_REPEATS else ([], [])
    counted = Counter(answer.response for answer in earnest)
    times_ms = [answer.response_time_ms for answer in earnest if answer.response_time_ms is not None]
    return Consistency(
        answered=len(earnest),
        repeats=repeats(pairs),
        catch_errors=catch_errors(earnest),
        left=left_share(earnest),
        too_fast=too_fast(earnest),
        without_script=sum(answer.by_script is False for answer in earnest),
        longest_run=longest_run(earnest),
        slowing=slowing(earnest),
        early_agreement=agreement(halves[0]),
        late_agreement=agreement(halves[1]),
        balance={response: counted[response] for response in Response},
        median_response_ms=median(times_ms) if times_ms else None,
        working_ms=sum(times_ms) if times_ms else None,
    )


def repeated(answers: Sequence[JudgedAnswer]) -> list[tuple[JudgedAnswer, JudgedAnswer]]:
    """Every repeat with the answer it repeats, (before, again), in the order of the repeats."""
    by_query = {answer.query_id: answer for answer in answers}
    return [
        (by_query[again.repeats_query_id], again)
        for again in answers
        if again.purpose is Purpose.REPEAT and again.repeats_query_id in by_query
    ]


def repeats(pairs: Sequence[tuple[JudgedAnswer, JudgedAnswer]]) -> Repeats:
    """Test and retest; sides are taken out first, so that it is about clips."""
    decided = [pair for pair in _told(pairs) if all(each.response in _SIDES for each in pair)]
    same_side = [pair for pair in pairs if pair[0].left_clip_id == pair[1].left_clip_id]
    exchanged = [pair for pair in pairs if pair[0].left_clip_id != pair[1].left_clip_id]
    of_decided = agreement(decided)
    return Repeats(
        asked=len(pairs),
        agreement=agreement(pairs),
        decided=of_decided,
        kappa=kappa(pairs),
        ceiling=noise_ceiling(of_decided),
        swapped=agreement(exchanged),
        unswapped=agreement(same_side),
    )


def agreement(pairs: Sequence[tuple[JudgedAnswer, JudgedAnswer]]) -> Share | None:
    """Share of pairs answered alike both times (Wilson)."""
    told = _told(pairs)
    if not told:
        return None
    return wilson(sum(_verdict(before, before) == _verdict(again, before) for before, again in told), len(told))


def kappa(pairs: Sequence[tuple[JudgedAnswer, JudgedAnswer]]) -> Estimate | None:
    """Cohen's kappa (1960) of test and retest, with Wilson's interval of the agreement carried through.

    The table is made symmetric, since which clip of a pair is the first means nothing: chance agreement then follows
    from how often somebody says "equal". With p observed and e expected agreement, kappa = (p - e) / (1 - e). None for
    fewer than FEWEST_REPEATS pairs, and when every answer was "equal", where kappa is not defined.
    """
    observed, told = agreement(pairs), _told(pairs)
    if observed is None or len(told) < FEWEST_REPEATS:
        return None
    verdicts = [(_verdict(before, before), _verdict(again, before)) for before, again in told]
    equal = sum((first == 0) + (second == 0) for first, second in verdicts) / (2 * len(verdicts))
    expected = equal**2 + (1 - equal) ** 2 / 2  # either clip is as likely to be the preferred one
    if expected >= 1.0:
        return None
    value, low, high = ((share - expected) / (1 - expected) for share in (observed.value, observed.low, observed.high))
    return Estimate(value, low, high)


def noise_ceiling(decided: Share | None) -> Estimate | None:
    """How often the best of models could foresee this person, if every answer is the opposite at one fixed rate.

    With q the chance of the true answer, two answers agree with c = q^2 + (1 - q)^2, so q = (1 + sqrt(2 c - 1)) / 2.
    The interval is that of c (Wilson), carried through. Pairs differ in how hard they are, so it is approximate. None
    for fewer than FEWEST_REPEATS pairs, and while c may be 1/2 or less: it then says nothing.
    """
    if decided is None or decided.scored < FEWEST_REPEATS or decided.low <= 0.5:
        return None
    return Estimate(_ceiling(decided.value), _ceiling(decided.low), _ceiling(decided.high))


def catch_errors(answers: Sequence[JudgedAnswer]) -> Share | None:
    """Share of answered catch pairs with the worse side preferred; equal is no error, can't tell no answer (Wilson)."""
    caught = [
        answer
        for answer in answers
        if answer.purpose is Purpose.CATCH and answer.expected is not None and answer.response is not Response.SKIP
    ]
    wrong = sum(answer.expected is not None and answer.response is _OTHER_SIDE[answer.expected] for answer in caught)
    return wilson(wrong, len(caught)) if caught else None


def left_share(answers: Sequence[JudgedAnswer]) -> Share | None:
    """Share of left among answers that prefer a side (Wilson). Sides are drawn, so without bias it is one half.

    Catch pairs are left out: their answer is known.
    """
    sided = [answer for answer in answers if answer.response in _SIDES and answer.purpose is not Purpose.CATCH]
    return wilson(sum(answer.response is Response.LEFT for answer in sided), len(sided)) if sided else None


def too_fast(answers: Sequence[JudgedAnswer]) -> Share | None:
    """Share of answers given before TOO_FAST of both clips was played (Wilson)."""
    seen = [answer.seen for answer in answers if answer.seen is not None]
    return wilson(sum(share < TOO_FAST for share in seen), len(seen)) if seen else None


def longest_run(answers: Sequence[JudgedAnswer]) -> int:
    """The most times that the same was answered in a row."""
    return max((len(list(run)) for _, run in groupby(answers, key=lambda answer: answer.response)), default=0)


def slowing(answers: Sequence[JudgedAnswer]) -> Trend | None:
    """The trend of log response time beyond the clip's length over the answers: least squares (t interval)."""
    timed = [
        (place, _log_ratio(answer.response_time_ms, answer.clip_ms))
        for place, answer in enumerate(answers)
        if answer.response_time_ms and answer.clip_ms
    ]
    if len(timed) < FEWEST_FOR_A_TREND:
        return None
    count = len(timed)
    middle = sum(place for place, _ in timed) / count
    level = sum(value for _, value in timed) / count
    spread = sum((place - middle) ** 2 for place, _ in timed)
    slope = sum((place - middle) * (value - level) for place, value in timed) / spread
    residual = sum((value - level - slope * (place - middle)) ** 2 for place, value in timed)
    error = sqrt(residual / (count - 2) / spread)
    margin = _t_quantile(count - 2) * error
    low, value, high = (_percent(slope + step) for step in (-margin, 0.0, margin))
    return Trend(Estimate(value, low, high))


def _t_quantile(degrees_of_freedom: int) -> float:
    """The 97.5 % quantile of Student's t, right to three digits from 18 degrees of freedom on.

    Abramowitz and Stegun (1964), 26.7.5; the web server has no scipy.
    """
    first = (_Z**3 + _Z) / 4
    second = (5 * _Z**5 + 16 * _Z**3 + 3 * _Z) / 96
    return _Z + first / degrees_of_freedom + second / degrees_of_freedom**2


def _told(pairs: Sequence[tuple[JudgedAnswer, JudgedAnswer]]) -> list[tuple[JudgedAnswer, JudgedAnswer]]:
    return [pair for pair in pairs if all(each.response is not Response.SKIP for each in pair)]


def _verdict(answer: JudgedAnswer, before: JudgedAnswer) -> int:
    """1: the clip that stood on the left at first, -1: the other one, 0: equal."""
    if answer.chosen_clip_id is None:
        return 0
    return 1 if answer.chosen_clip_id == before.left_clip_id else -1


def _ceiling(agreeing: float) -> float:
    return (1.0 + sqrt(2.0 * agreeing - 1.0)) / 2.0


def _no_slips(errors: Share) -> bool:
    """Whether so many errors happen by slips in less than 5 % of cases."""
    wrong, asked = int(errors.correct), errors.scored
    fewer = sum(comb(asked, count) * SLIPS**count * (1 - SLIPS) ** (asked - count) for count in range(wrong))
    return 1.0 - fewer < 0.05


def _no_fair_coin(left: Share) -> bool:
    """Whether nobody without a side would get so far from one half, even if one looked after every answer."""
    return evidence_against_a_fair_coin(int(left.correct), left.scored) >= ENOUGH_EVIDENCE


def _log_ratio(response_time_ms: int | None, clip_ms: int | None) -> float:
    return log((response_time_ms or 1) / (clip_ms or 1))


def _percent(slope: float) -> float:
    """A slope of logs per answer as a change in percent over a hundred answers."""
    return 100.0 * (exp(min(50.0, 100.0 * slope)) - 1.0)
