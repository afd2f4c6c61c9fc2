"""How often the intervals on the pages miss the truth, and how often flags are raised at people who deserve none."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from random import Random
from statistics import NormalDist
from typing import Any

import numpy as np

from app.domain.preferences import Purpose, Response
from app.services.answers import accuracy, consistency
from app.services.answers.consistency import JudgedAnswer
from worker.analysis.filters.evaluation import mean_change, success_change
from worker.analysis.study.effect_sizes import d_z_interval, rank_biserial, rank_biserial_interval
from worker.analysis.study.statistics import mean_interval
from worker.analysis.wilson import wilson_interval

Bounds = tuple[float | None, float | None]
Row = dict[str, Any]
ANSWERS = 200
"""Of one person, looked at after each."""
SLOW = 10
"""Times as few trials of what takes long: looks after every answer, exact intervals of effect sizes."""


def rows(trials: int) -> list[Row]:
    """Everything that is measured; ``trials`` of each."""
    return [*_intervals(trials), *_flags(trials)]


def _intervals(trials: int) -> Iterator[Row]:
    rng = np.random.default_rng(1)
    for share, count in ((0.5, 10), (0.75, 30), (0.75, 200), (0.95, 20)):
        about = f"{share:.0%} of {count}"
        yield _row("share of answers foreseen (Wilson)", about, share, trials, _share(rng, share, count))
    for people in (3, 8, 20):
        yield _row("mean over people (t)", f"{people} people, ratings 1 to 5 near 2", None, trials, _mean(rng, people))
    for people, truth in ((4, 0.8), (8, 0.0), (8, 0.8), (20, 0.8)):
        held = _d_z(rng, people, truth)
        yield _row("Cohen's d_z (noncentral t)", f"{people} people, true {truth:g}", truth, trials // SLOW, held)
    for people in (8, 20):
        for shift in RANKS:
            true = 2 * NormalDist().cdf(shift * 2**0.5) - 1
            yield _row(
                "rank-biserial (after Wilson)",
                f"{people} people, true {true:.2f}",
                true,
                trials,
                _ranks(rng, people, shift),
            )
    for pairs in (5, 8, 20):
        for rate in (0.5, 0.85, 1.0):
            yield _row("kappa (Wilson, carried through)", *_kappa(rng, pairs, rate, trials))
    for pairs in (8, 20):
        yield _row("best accuracy possible", f"true 90 %, {pairs} pairs asked twice", 0.9, trials, _ceiling(rng, pairs))
    for scenarios in (20, 100, 500):
        about = f"{scenarios} scenarios, 95 % and 92 %"
        yield _row("change of success (Newcombe)", about, -0.03, trials, _success(rng, scenarios))
        yield _row("change of a cost (t)", f"{scenarios} scenarios, skewed", 0.0, trials, _cost(rng, scenarios))
    for count in (20, 200):
        about = f"{count} answers, no trend"
        yield _row("time per 100 answers (t)", about, 0.0, trials // SLOW, _slowing(rng, count))


def _row(interval: str, about: str, truth: float | None, trials: int, draw: Callable[[], Bounds]) -> Row:
    """``draw``: an interval of new data; None for one that is not shown. ``truth`` None: what ``draw`` centres on 0."""
    found = [draw() for _ in range(trials)]
    shown = [(low, high) for low, high in found if low is not None and high is not None]
    aim = truth or 0.0
    missed = sum(not low - 1e-9 <= aim <= high + 1e-9 for low, high in shown)
    return {
        "what": interval,
        "truth": about,
        "trials": trials,
        "shown_percent": round(100 * len(shown) / trials, 1),
        "misses_percent": round(100 * missed / len(shown), 1) if shown else "",
    }


def _share(rng: np.random.Generator, share: float, count: int) -> Callable[[], Bounds]:
    return lambda: wilson_interval(int(rng.binomial(count, share)), count)


def _mean(rng: np.random.Generator, people: int) -> Callable[[], Bounds]:
    chances = np.array([0.4, 0.3, 0.2, 0.07, 0.03])
    mean = float(chances @ np.arange(1, 6))
    return lambda: mean_interval(rng.choice(np.arange(1, 6), (people, 3), p=chances).mean(axis=1) - mean)


def _d_z(rng: np.random.Generator, people: int, truth: float) -> Callable[[], Bounds]:
    def draw() -> Bounds:
        values = rng.normal(truth, 1.0, people)
        return d_z_interval(float(values.mean() / values.std(ddof=1) * people**0.5), people)

    return draw


RANKS = (0.0, 0.4, 0.8, 1.3)
"""Means of normal differences with a standard deviation of 1."""


def _ranks(rng: np.random.Generator, people: int, shift: float) -> Callable[[], Bounds]:
    return lambda: rank_biserial_interval(rank_biserial(rng.normal(shift, 1.0, people)), people)


def _pairs(rng: np.random.Generator, pairs: int, rate: float, equal: float = 0.0) -> list[JudgedAnswer]:
    """So many pairs asked twice; both answers are the person's true one with this chance, else the opposite."""
    first, again = [], []
    for place in range(pairs):
        told = [Response.LEFT if rng.random() < rate else Response.RIGHT for _ in range(2)]
        if rng.random() < equal:
            told = [Response.EQUAL, Response.EQUAL]
        sides = (2 * place, 2 * place + 1)
        first.append(JudgedAnswer(place, place, Purpose.PREFERENCE, told[0], *sides))
        again.append(
            JudgedAnswer(pairs + place, pairs + place, Purpose.REPEAT, told[1], *sides, repeats_query_id=place)
        )
    return [*first, *again]


def _kappa(
    rng: np.random.Generator, pairs: int, rate: float, trials: int
) -> tuple[str, float, int, Callable[[], Bounds]]:
    truth = 2 * (rate**2 + (1 - rate) ** 2) - 1

    def draw() -> Bounds:
        answers = _pairs(rng, pairs, rate)
        found = consistency.kappa(consistency.repeated(answers))
        return (found.low, found.high) if found else (None, None)

    return f"true {truth:.2f}, {pairs} pairs asked twice", truth, trials, draw


def _ceiling(rng: np.random.Generator, pairs: int) -> Callable[[], Bounds]:
    def draw() -> Bounds:
        found = consistency.repeats(consistency.repeated(_pairs(rng, pairs, 0.9))).ceiling
        return (found.low, found.high) if found else (None, None)

    return draw


def _success(rng: np.random.Generator, scenarios: int) -> Callable[[], Bounds]:
    """Both fail in the same hard scenarios, and one of them in a few more."""

    def draw() -> Bounds:
        luck = rng.random(scenarios)
        found = success_change((luck < 0.95).astype(float), (luck < 0.92).astype(float))
        return found["low"], found["high"]

    return draw


def _cost(rng: np.random.Generator, scenarios: int) -> Callable[[], Bounds]:
    def draw() -> Bounds:
        found = mean_change(np.zeros(scenarios), rng.exponential(1.0, scenarios) - 1.0)
        return found["low"], found["high"]

    return draw


def _slowing(rng: np.random.Generator, count: int) -> Callable[[], Bounds]:
    def draw() -> Bounds:
        times = np.exp(rng.normal(8.7, 0.5, count)).astype(int) + 1
        answers = [
            JudgedAnswer(
                place, place, Purpose.PREFERENCE, Response.LEFT, 0, 1, response_time_ms=int(time), clip_ms=6000
            )
            for place, time in enumerate(times)
        ]
        found = consistency.slowing(answers)
        return (found.per_hundred.low, found.per_hundred.high) if found else (None, None)

    return draw


def _flags(trials: int) -> Iterator[Row]:
    """Shares of people for whom a flag was raised at least once, when somebody looks after every answer."""
    people = max(1, trials // SLOW)
    names = ("catch_errors", "side_bias", "straight_line", "inconsistent")
    raised = [_ever_raised(Random(seed)) for seed in range(people)]  # noqa: S311
    about = f"honest, {ANSWERS} answers, slips 2 % (obvious pairs), 15 % contradictions"
    for name in names:
        yield _flag(f"flag {name}", about, [name in each for each in raised])
    for chance in (0.5, 0.6, 0.7, 0.8):
        better = [_ever_better(Random(seed), chance) for seed in range(people)]  # noqa: S311
        yield _flag("model called better than guessing", f"right in {chance:.0%}, {ANSWERS} answers", better)


def _flag(what: str, about: str, raised: Sequence[bool]) -> Row:
    share = round(100 * sum(raised) / len(raised), 1)
    return {"what": what, "truth": about, "trials": len(raised), "shown_percent": "", "misses_percent": share}


def _ever_raised(random: Random) -> set[str]:
    """Every 25th pair is an obvious one, every 10th an earlier one again."""
    answers: list[JudgedAnswer] = []
    raised: set[str] = set()
    for place in range(ANSWERS):
        answers.append(_next(random, answers, place))
        raised |= set(consistency.consistency(answers).flags)
    return raised


def _next(random: Random, answers: Sequence[JudgedAnswer], place: int) -> JudgedAnswer:
    side = random.choice((Response.LEFT, Response.RIGHT))
    other = {Response.LEFT: Response.RIGHT, Response.RIGHT: Response.LEFT}
    if place % 25 == 24:
        said = other[side] if random.random() < 0.02 else side
        return JudgedAnswer(place, place, Purpose.CATCH, said, 2 * place, 2 * place + 1, expected=side)
    if place % 10 == 9:
        before = answers[place - 9]
        said = other.get(before.response, side) if random.random() < 0.15 else before.response
        sides = (before.left_clip_id, before.right_clip_id)
        return JudgedAnswer(place, place, Purpose.REPEAT, said, *sides, repeats_query_id=before.query_id)
    return JudgedAnswer(place, place, Purpose.PREFERENCE, side, 2 * place, 2 * place + 1)


def _ever_better(random: Random, chance: float) -> bool:
    found: list[float] = []
    for _ in range(ANSWERS):
        found.append(float(random.random() < chance))
        if accuracy.foresight(found) is accuracy.Foresight.BETTER:
            return True
    return False


def page(found: Sequence[Mapping[str, Any]]) -> str:
    """Their part of docs/results/error_rates.md."""
    intervals = [row for row in found if row["shown_percent"] != ""]
    looks = [row for row in found if row["shown_percent"] == ""]
    return "\n\n".join(
        [
            "## Intervals: how often they miss the truth\n\nAll are 95 % intervals, so 5 % is what they promise. An"
            " interval that is not shown in some cases (too few pairs, nothing to say) is judged where it is shown."
            f" Cohen's d_z and the time per 100 answers are tried a {SLOW}th as often: chance moves them by 1.5"
            " points.",
            _table(intervals, ("interval", "truth", "shown, %", "misses, %")),
            "## Flags and verdicts: how often they are raised, looking after every answer",
            f"Tried a {SLOW}th as often.",
            _table(looks, ("what", "truth", "ever raised, % of people")),
        ]
    )


def _table(found: Sequence[Mapping[str, Any]], head: Sequence[str]) -> str:
    lines = ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    for row in found:
        shown = [row["shown_percent"]] if len(head) == 4 else []
        lines.append("| " + " | ".join(map(str, (row["what"], row["truth"], *shown, row["misses_percent"]))) + " |")
    return "\n".join(lines)
