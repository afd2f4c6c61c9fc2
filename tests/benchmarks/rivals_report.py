"""The page of tests.benchmarks.rivals from its table alone: every number on it follows from the rows."""

from collections.abc import Callable, Mapping, Sequence
from itertools import product
from typing import Any

import numpy as np
import numpy.typing as npt

from app.installed_tasks import catalogue
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
from worker.experiments.benchmark_cell import PAPER_USERS, default_method

TITLE = "# Is the default better than rivals of today?"
TOLERANCE = 0.02
"""Largest loss of success, as a share of episodes, with which the task counts as kept."""
CHEAP_FIRST = (
    "pbarl",
    "pbarl_archived",
    "pbarl_refined",
    "pbarl_no_mode",
    "pbarl_no_residual",
    "pbarl_no_caution",
    "sliders",
    "preferential_bo",
    "clusters_3",
    "average",
    "residual_rl",
    "dsrl_flow",
    "sliders_noisy",
    "latent_people",
    "dsrl",
    "best_of_n",
    "prefft_lagrangian",
    "prefft",
    "prefft_anchored",
    "pbarl_printed",
    "pbrl_hri",
)
"""All that are to have every cell"""
GOAL_SEEDS = 5
ENOUGH_SEEDS = 3
"""for an interval over them"""
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
    found = {name_of(row): row for row in sorted(rows, key=lambda row: CHEAP_FIRST.index(row["method"]))}
    seeds = sorted({name[3] for name in found})
    defaults = ", ".join(f"`{default_method(task)}` in {task}" for task in dict.fromkeys(name[0] for name in found))
    aimed = list(product(catalogue.names(), PAPER_USERS, CHEAP_FIRST, range(GOAL_SEEDS)))
    absent = [f"`{method}`" for method in CHEAP_FIRST if method not in {name[2] for name in found}]
    not_begun = f" Not begun: {', '.join(absent)}." if absent else ""
    head = (
        f"{len(found.keys() & set(aimed))} of {len(aimed)} cells of task, user, method and seed; seeds"
        f" {', '.join(map(str, seeds))} of {GOAL_SEEDS} so far. The default is {defaults}; every other method is called"
        f" a rival.{not_begun}"
    )
    parts = [_ahead(found), _ahead_over_seeds(found), _together(found), _cells(found), _budgets(found), _ages(found)]
    return "\n\n".join([head, *parts]) + "\n"


def _ahead(found: Mapping[Name, Row]) -> str:
    """Every cell in which a rival gains more, beyond the paired interval, kept task or not."""
    lines = [
        "## Where a rival is better than the default",
        "",
        "Difference of gains in points, paired by scenario, with its 95 % interval over scenarios, seed by seed: these"
        " two trainings, not the methods.",
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
            lost = success_of(row)
            verdict = "keeps the task" if keeps_task(row) else "loses the task"
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


def _ahead_over_seeds(found: Mapping[Name, Row]) -> str:
    """Every cell in which a rival is not behind over the seeds that it shares with the default."""
    lines, behind = list[str](), 0
    for task, user, method in dict.fromkeys(name[:3] for name in found):
        (rivals, defaults), seeds = _paired(found, task, user, method)
        if method == default_method(task) or len(seeds) < ENOUGH_SEEDS:
            continue
        change = mean_change(_means(defaults, gains_of), _means(rivals, gains_of))
        if change["high"] < 0:
            behind += 1
            continue
        verdict = "ahead" if change["low"] > 0 else "within"
        lost = min(success_of(row)["delta"] for row in rivals)
        lines.append(
            f"* {task}, {user}, {len(seeds)} seeds: `{method}` by {_interval(change)} ({verdict}); success"
            f" {100 * lost:+.1f} points in the worst of them."
        )
    return "\n".join(
        [
            "## Where a rival is not behind over seeds",
            "",
            f"The same of every rival that shares {ENOUGH_SEEDS} seeds or more of a cell with the default, with its"
            " 95 % interval over seeds (Student's t): labels and trainings differ, so this is about the methods.",
            "",
            f"Behind in {behind} of {len(lines) + behind} comparisons{'; in the others:' if lines else '.'}",
            "",
            *lines,
        ]
    ).rstrip()


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
        (of_method, of_default), seeds = _paired(found, task, user, method)
        if seeds:
            strata.append(np.array([gains_of(row) for row in of_method]))
            others.append(np.array([gains_of(row) for row in of_default]))
    return strata, others


def _paired(
    found: Mapping[Name, Row], task: str, user: str, method: str
) -> tuple[tuple[list[Row], list[Row]], list[int]]:
    """The rows of a method and of the default in a cell, and the seeds that both have."""
    pairs = (method, default_method(task))
    seeds = [
        seed for seed in sorted({name[3] for name in found}) if all((task, user, each, seed) in found for each in pairs)
    ]
    own, default = ([found[task, user, each, seed] for seed in seeds] for each in pairs)
    return (own, default), seeds


def _means(rows: Sequence[Row], measure: Callable[[Row], FloatArray]) -> FloatArray:
    """(seeds,)"""
    return np.array([measure(row).mean() for row in rows])


def _cells(found: Mapping[Name, Row]) -> str:
    """Every cell; seeds together."""
    lines = [
        "## Cell by cell",
        "",
        "Gain: change of r^H in % of what the user minds and likes under the reference policy; behind it the number of"
        f" seeds. Success in points. 95 % intervals over seeds from {ENOUGH_SEEDS} on (t), with fewer over scenarios.",
        "",
    ]
    methods = list(dict.fromkeys(name[2] for name in found))
    for task in dict.fromkeys(name[0] for name in found):
        users = list(dict.fromkeys(name[1] for name in found if name[0] == task))
        lines += [
            f"### {task}",
            "",
            "| method |" + "".join(f" {user}: gain, seeds | success |" for user in users),
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
    if len(rows) >= ENOUGH_SEEDS:
        gains = _means(rows, gains_of)
        lost = mean_change(_means(rows, _successes_of_reference), _means(rows, successes_of))
        lost |= {"low": max(lost["low"], -1.0), "high": min(lost["high"], 1.0)}
    else:
        gains = np.concatenate([gains_of(row) for row in rows])
        before, after = (
            np.concatenate([measure(row) for row in rows]) for measure in (_successes_of_reference, successes_of)
        )
        lost = success_change(before, after)
    return f"{_interval(mean_change(np.zeros(len(gains)), gains))}, {len(rows)} | {_interval(lost)}"


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


def _ages(found: Mapping[Name, Row]) -> str:
    """When the rows were measured, by what the code was then."""
    tasks = list(dict.fromkeys(name[0] for name in found))
    lines = [
        "## How old the rows are",
        "",
        "The first and the last day on which a method's rows were measured.",
        "",
        "| method | " + " | ".join(tasks) + " |",
        "|---" * (1 + len(tasks)) + "|",
    ]
    for method in dict.fromkeys(name[2] for name in found):
        cells = []
        for task in tasks:
            days = sorted({row["measured"] for name, row in found.items() if (name[0], name[2]) == (task, method)})
            cells.append(" to ".join(dict.fromkeys((days[0], days[-1]))) if days else "-")
        lines.append(f"| `{method}` | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _successes_of_reference(row: Row) -> FloatArray:
    return successes_of(row, "successes_reference")


def keeps_task(row: Row) -> bool:
    """Whether no more than the tolerated share of episodes is lost."""
    return success_of(row)["delta"] >= -TOLERANCE


def success_of(row: Row) -> dict[str, float]:
    """Change of the share of episodes that succeed, against the reference policy's."""
    return success_change(_successes_of_reference(row), successes_of(row))


def _interval(change: Mapping[str, float]) -> str:
    return f"{100 * change['delta']:+.1f} [{100 * change['low']:+.1f}, {100 * change['high']:+.1f}]"


def _estimate(found: Estimate) -> str:
    return _interval({"delta": found.value, "low": found.low, "high": found.high})
