"""The page of tests.benchmarks.few_answers from its rows: every number on it follows from them."""

from collections.abc import Callable, Sequence
from itertools import product
from typing import NamedTuple

import numpy as np
from scipy import stats

from app.installed_tasks import catalogue
from worker.analysis.wilson import wilson_interval
from worker.domain.type_aliases import FloatArray

TITLE = "# What 25 answers lead to"
COUNTS = (25, 50, 100, 200)
FEW = (25,)
"""of the variants that know earlier people"""
WITHOUT = "now, but for one thing"
VARIANTS = {"before": COUNTS, "now": COUNTS, WITHOUT: COUNTS[:-1], "before, pooled": FEW, "now, pooled": FEW}
GROUPS = ("named", "drawn", "outside")


class Row(NamedTuple):
    """One user after so many answers."""

    task: str
    group: str
    user: str
    seed: int
    variant: str
    labels: int
    gain_percent: float
    kept_percent: float
    """the same of what a refinement that finds nothing better leaves"""
    best_percent: float
    success_points: float
    like_nobody_known: float
    """how likely it is that the user is of none of the prior's populations"""
    told_after: int
    """answers after which it was said that more hardly pay; 0: not yet, or not looked at"""
    told_gain: float
    """gain_percent of the mode at that time"""
    mode: str


Advantages = Callable[[str, Sequence[Row]], FloatArray]
"""(U,) of users of a task: by how much everybody's own mode is better for them than the better of two others'"""


def page(rows: Sequence[Row], advantages: Advantages) -> str:
    """All below the mark."""
    tables = [
        _table_of_gains(rows),
        _table_of_archives(rows),
        _table_of_one_thing(rows),
        _table_of_pooling(rows, advantages),
        _table_of_advice(rows),
        _table_of_lengths(rows),
    ]
    return "\n\n".join(tables)


def _table_of_gains(rows: Sequence[Row]) -> str:
    """Now against before with four times and with as many answers; intervals by Student's t over users."""
    lines = [
        "| task | people | best, % | before: 25 | 50 | 100 | 200 | now: 25 | 50 | 100 | 200 "
        "| now 25 - before 100 | now 50 - before 200 | both at 100 | both at 200 |",
        "|" + "---|" * 15,
    ]
    for task, group in product(catalogue.names(), GROUPS):
        gains = {
            (variant, count): _by_user(rows, task, group, variant, count)
            for variant, count in product(("before", "now"), COUNTS)
        }
        best = np.mean([row.best_percent for row in rows if (row.task, row.group) == (task, group)])
        means = [f"{gains[variant, count].mean():.1f}" for variant in ("before", "now") for count in COUNTS]
        compared = [
            _interval(gains["now", now] - gains["before", before])
            for now, before in ((25, 100), (50, 200), (100, 100), (200, 200))
        ]
        lines.append(f"| {task.capitalize()} | {group} | {best:.1f} | " + " | ".join([*means, *compared]) + " |")
    return "\n".join(lines)


def _table_of_archives(rows: Sequence[Row]) -> str:
    """What refinements that find nothing better leave, against the mode of before, where anybody's is not the mode."""
    lines = [
        "| task | people | with policies refined beforehand, now: 25 | 50 | 100 | 200 "
        "| 25 - before 100 | 50 - before 200 | not the mode at 25 |",
        "|" + "---|" * 9,
    ]
    for task, group in product(catalogue.names(), GROUPS):
        kept = {count: _by_user(rows, task, group, "now", count, "kept_percent") for count in COUNTS}
        others = kept[25] != _by_user(rows, task, group, "now", 25)
        if not others.any():
            continue
        means = [f"{each.mean():.1f}" for each in kept.values()]
        compared = [
            _interval(kept[now] - _by_user(rows, task, group, "before", before))
            for now, before in ((25, 100), (50, 200))
        ]
        cells = [task.capitalize(), group, *means, *compared, f"{others.sum()} of {len(others)}"]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _table_of_one_thing(rows: Sequence[Row]) -> str:
    """What it is worth that the prior knows people to whom one thing matters; intervals by Student's t over users."""
    counts = VARIANTS[WITHOUT]
    lines = [
        "| task | people | more by the prior with people to whom one thing matters, points: "
        + " | ".join(str(count) for count in counts)
        + " |",
        "|---|---|" + "---|" * len(counts),
    ]
    for task, group in product(catalogue.names(), GROUPS):
        more = [
            _interval(_by_user(rows, task, group, "now", count) - _by_user(rows, task, group, WITHOUT, count))
            for count in counts
        ]
        lines.append(f"| {task.capitalize()} | {group} | " + " | ".join(more) + " |")
    return "\n".join(lines)


def _table_of_pooling(rows: Sequence[Row], advantages: Advantages) -> str:
    """Whether people with earlier people behind them end up with each other's robots: threes of each group."""
    lines = [
        "| people | answers | prior | gained, % | own mode best | own beyond the better of the others' |",
        "|---|---|---|---|---|---|",
    ]
    for group, count, variant in product(GROUPS, FEW, VARIANTS):
        chosen = [row for row in rows if (row.group, row.labels, row.variant, row.seed) == (group, count, variant, 0)]
        more = np.concatenate(
            [advantages(task, [row for row in chosen if row.task == task]) for task in catalogue.names()]
        )
        gained = float(np.mean([row.gain_percent for row in chosen]))
        lines.append(
            f"| {group} | {count} | {variant} | {gained:.1f} | {(more > 0).sum()} of {len(more)} | {_interval(more)} |"
        )
    return "\n".join(lines)


def _table_of_advice(rows: Sequence[Row]) -> str:
    """Who is told within 100 answers that more hardly pay, and what going on to 200 would have gained them."""
    lines = ["| task | people | told | after | would have gained more than 3 points | in the mean |", "|" + "---|" * 6]
    for task, group in product(catalogue.names(), GROUPS):
        last = [row for row in rows if (row.task, row.group, row.variant, row.labels) == (task, group, "now", 200)]
        told = [row for row in last if 0 < row.told_after <= 100]
        lost = np.array([row.gain_percent - row.told_gain for row in told])
        after = f"{np.mean([row.told_after for row in told]):.0f}" if told else "-"
        mean = f"{lost.mean():.1f}" if told else "-"
        low, high = wilson_interval(int((lost > 3.0).sum()), len(told)) if told else (0.0, 1.0)
        wrong = f"{(lost > 3.0).sum()} of {len(told)} [{100 * max(low, 0.0):.0f}, {100 * high:.0f} %]"
        lines.append(f"| {task.capitalize()} | {group} | {len(told)} of {len(last)} | {after} | {wrong} | {mean} |")
    return "\n".join(lines)


def _table_of_lengths(rows: Sequence[Row]) -> str:
    """Of everybody, told or not: who would gain more than 3 points by going on to 200 answers."""
    lines = ["| task | answers | would gain more than 3 points by going on | still to gain, mean |", "|" + "---|" * 4]
    for task, count in product(catalogue.names(), COUNTS[:-1]):
        now, last = (
            np.concatenate([_by_user(rows, task, group, "now", each) for group in GROUPS])
            for each in (count, COUNTS[-1])
        )
        lost = last - now
        low, high = wilson_interval(int((lost > 3.0).sum()), len(lost))
        wrong = f"{(lost > 3.0).sum()} of {len(lost)} [{100 * max(low, 0.0):.0f}, {100 * high:.0f} %]"
        lines.append(f"| {task.capitalize()} | {count} | {wrong} | {lost.mean():.1f} |")
    return "\n".join(lines)


def _by_user(
    rows: Sequence[Row], task: str, group: str, variant: str, labels: int, of: str = "gain_percent"
) -> FloatArray:
    """(U,) gains, the mean over seeds."""
    gains: dict[str, list[float]] = {}
    for row in rows:
        if (row.task, row.group, row.variant, row.labels) == (task, group, variant, labels):
            gains.setdefault(row.user, []).append(getattr(row, of))
    return np.array([np.mean(each) for each in gains.values()])


def _interval(differences: FloatArray) -> str:
    middle = float(differences.mean())
    half = float(stats.t.ppf(0.975, len(differences) - 1) * differences.std(ddof=1) / np.sqrt(len(differences)))
    return f"{middle:+.1f} [{middle - half:+.1f}, {middle + half:+.1f}]"
