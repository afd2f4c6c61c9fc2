"""The page of tests.benchmarks.rivals from its table alone: every number on it follows from the rows."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from worker.analysis.comparison.aggregate import (
    Estimate,
    compare,
    difference,
    estimate,
    interquartile_mean,
    probability_of_improvement,
    profile,
)
from worker.analysis.filters.evaluation import mean_change, success_change
from worker.domain.type_aliases import FloatArray
from worker.experiments.benchmark_cell import default_method

TITLE = "# Is the default better than rivals of today?"
TOLERANCE = 0.02
"""Largest loss of success, as a share of episodes, with which the task counts as kept."""
GOAL_SEEDS = 5
THRESHOLDS = (0.0, 0.05, 0.1, 0.2)
_FINE = 1000.0

Row = Mapping[str, Any]
Name = tuple[str, str, str, int]


def name_of(row: Row) -> Name:
    """Task, user, method, seed."""
    return row["task"], row["user"], row["method"], int(row["seed"])


def gains_text(gains: FloatArray) -> str:
    """Shares of the stake, (N,), as thousandths."""
    return " ".join(str(round(_FINE * each)) for each in gains.tolist())


def successes_text(successes: npt.ArrayLike) -> str:
    """(N,) of 0 and 1 as digits."""
    return "".join("1" if each else "0" for each in np.asarray(successes))


def gains_of(row: Row, whose: str = "gains") -> FloatArray:
    """What gains_text() wrote."""
    return np.array([int(each) for each in str(row[whose]).split()]) / _FINE


def successes_of(row: Row, whose: str = "successes") -> FloatArray:
    """What successes_text() wrote."""
    return np.array([float(each) for each in str(row[whose])])


def page(rows: Sequence[Row]) -> str:
    """All below the mark."""
    found = {name_of(row): row for row in rows}
    seeds = sorted({name[3] for name in found})
    defaults = ", ".join(f"`{default_method(task)}` in {task}" for task in dict.fromkeys(name[0] for name in found))
    head = (
        f"{len(found)} cells of task, user, method and seed; seeds {', '.join(map(str, seeds))} of {GOAL_SEEDS} so far."
        f" The default is {defaults}; every other method is called a rival."
    )
    return "\n\n".join([head, _ahead(found), _together(found), _cells(found), _budgets(found)]) + "\n"


def _ahead(found: Mapping[Name, Row]) -> str:
    """Every cell in which a rival gains more, beyond the paired interval, kept task or not."""
    lines = [
        "## Where a rival is better than the default",
        "",
        "Difference of gains in points, paired by scenario, with its 95 % interval over scenarios.",
        "",
    ]
    ahead, behind, ties = [], 0, 0
    for (task, user, method, seed), row in found.items():
        own = found.get((task, user, default_method(task), seed))
        if own is None or own is row:
            continue
        change = mean_change(gains_of(own), gains_of(row))
        behind += change["high"] < 0
        ties += change["low"] <= 0 <= change["high"]
        if change["low"] > 0:
            lost = _success(row)
            verdict = "keeps the task" if lost["delta"] >= -TOLERANCE else "loses the task"
            ahead.append(
                f"* {task}, {user}, seed {seed}: `{method}` by {_interval(change)}; success"
                f" {100 * lost['delta']:+.1f} points ({verdict})."
            )
    total = len(ahead) + behind + ties
    lines += [
        f"Of {total} comparisons the rival is behind in {behind}, within the interval in {ties}, and ahead in"
        f" {len(ahead)}{':' if ahead else '.'}",
        "",
        *ahead,
    ]
    return "\n".join(lines).rstrip()


def _together(found: Mapping[Name, Row]) -> str:
    """Interquartile means over the cells and seeds that a rival shares with the default."""
    lines = [
        "## All cells together",
        "",
        "Interquartile means of gains in %, over the runs that the method shares with the default; 95 % intervals by"
        " stratified bootstrap (seeds, where there are several, and scenarios). P: the probability that a run of the"
        " method is better than one of the default. Last: share of the method's runs that gain more than so many %.",
        "",
        "| method | runs | gain | default there | difference | P(better than the default) |"
        + "".join(f" > {100 * each:.0f} |" for each in THRESHOLDS),
        "|---" * (6 + len(THRESHOLDS)) + "|",
    ]
    for method in dict.fromkeys(name[2] for name in found):
        strata, others = _shared(found, method)
        if not strata:
            continue
        is_default = all(method == default_method(name[0]) for name in found if name[2] == method)
        runs = sum(len(each) for each in strata)
        shares = " | ".join(f"{100 * each:.0f} %" for each in profile(strata, THRESHOLDS))
        own = _estimate(estimate(strata))
        if is_default:
            lines.append(f"| `{method}` | {runs} | {own} | - | - | - | {shares} |")
            continue
        better = compare(strata, others, probability_of_improvement)
        there = 100 * float(interquartile_mean([each.mean(axis=1) for each in others]))
        lines.append(
            f"| `{method}` | {runs} | {own} | {there:+.1f} | {_estimate(compare(strata, others, difference))}"
            f" | {better.value:.2f} [{better.low:.2f}, {better.high:.2f}] | {shares} |"
        )
    return "\n".join(lines)


def _shared(found: Mapping[Name, Row], method: str) -> tuple[list[FloatArray], list[FloatArray]]:
    """Per task and user (seeds, scenarios) of the method and of the default, in the seeds that both have."""
    strata, others = [], []
    for task, user in dict.fromkeys((name[0], name[1]) for name in found):
        seeds = [
            seed
            for seed in sorted({name[3] for name in found})
            if (task, user, method, seed) in found and (task, user, default_method(task), seed) in found
        ]
        if seeds:
            strata.append(np.array([gains_of(found[task, user, method, seed]) for seed in seeds]))
            others.append(np.array([gains_of(found[task, user, default_method(task), seed]) for seed in seeds]))
    return strata, others


def _cells(found: Mapping[Name, Row]) -> str:
    """Every cell; seeds together."""
    lines = [
        "## Cell by cell",
        "",
        "Gain: change of r^H in % of what the user minds and likes under the reference policy. Success in points."
        " Intervals over scenarios.",
        "",
    ]
    methods = list(dict.fromkeys(name[2] for name in found))
    for task in dict.fromkeys(name[0] for name in found):
        users = list(dict.fromkeys(name[1] for name in found if name[0] == task))
        lines += [
            f"### {task}",
            "",
            "| method |" + "".join(f" {user}: gain | success |" for user in users),
            "|---" * (1 + 2 * len(users)) + "|",
        ]
        for method in methods:
            cells = [_cell([row for name, row in found.items() if name[:3] == (task, user, method)]) for user in users]
            lines.append(f"| `{method}` | " + " | ".join(cells) + " |")
        lines.append("")
    return "\n".join(lines).rstrip()


def _cell(rows: Sequence[Row]) -> str:
    if not rows:
        return "- | -"
    gains = np.concatenate([gains_of(row) for row in rows])
    before, after = (
        np.concatenate([successes_of(row, whose) for row in rows]) for whose in ("successes_reference", "successes")
    )
    lost = success_change(before, after)
    return f"{_interval(mean_change(np.zeros(len(gains)), gains))} | {_interval(lost)}"


def _budgets(found: Mapping[Name, Row]) -> str:
    """What a fit was given: labels, environment steps, seconds."""
    lines = [
        "## What a fit needs",
        "",
        "Means over all fits. Labels are the person's own answers; environment steps are all that a method asked for,"
        " trials included; seconds are processor time of one core that other work shared.",
        "",
        "| method | fits | labels | environment steps | processor s |",
        "|---" * 5 + "|",
    ]
    for method in dict.fromkeys(name[2] for name in found):
        of_method = [row for name, row in found.items() if name[2] == method]
        means = (np.mean([float(row[what]) for row in of_method]) for what in ("labels", "environment_steps", "cpu_s"))
        lines.append(f"| `{method}` | {len(of_method)} | " + " | ".join(f"{each:.0f}" for each in means) + " |")
    return "\n".join(lines)


def _success(row: Row) -> dict[str, float]:
    return success_change(successes_of(row, "successes_reference"), successes_of(row))


def _interval(change: Mapping[str, float]) -> str:
    return f"{100 * change['delta']:+.1f} [{100 * change['low']:+.1f}, {100 * change['high']:+.1f}]"


def _estimate(found: Estimate) -> str:
    return _interval({"delta": found.value, "low": found.low, "high": found.high})
