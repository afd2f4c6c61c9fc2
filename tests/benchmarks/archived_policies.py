"""What policies that were refined beforehand are worth, to whom, and what would be lost without each of them.

    python -m tests.benchmarks.archived_policies --output docs/results/archived_policies

People are those of tests.benchmarks.few_answers: some with names, others drawn from the scripted population, others
outside it. Every archived policy is driven through 200 unseen scenarios. What it gains somebody is by what they truly
want, in % of what they mind and like under the reference policy; so is their best mode's gain, which is what the
response surface predicts. Nothing is learned from answers, and nothing is refined.
"""

from collections.abc import Iterator, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import torch

from app.installed_tasks import catalogue
from tests.benchmarks import answering, result_tables
from tests.benchmarks.few_answers import DRIVEN, FewAnswers
from tests.benchmarks.few_answers_report import GROUPS
from worker.analysis.comparison import result_pages
from worker.analysis.study.statistics import mean_interval
from worker.compute import simulation
from worker.domain.scenarios import EVALUATION, first_of
from worker.domain.type_aliases import FloatArray
from worker.experiments.rollout_cache import RolloutCache
from worker.ml.filters.fitting.filter_problem import FilterConfig
from worker.ml.filters.fitting.gate import largest_forces, signal_changes, successes

TITLE = "# What policies refined beforehand are worth"
MODE = "best mode"
Row = dict[str, Any]


def main() -> None:
    """See the module."""
    told = answering.parser(__doc__, "archived_policies", seeds=0)
    told.add_argument("--people", type=int, default=100, help="drawn, and as many outside")
    options = told.parse_args()
    torch.set_num_threads(1)
    archives = [name for name in catalogue.names() if simulation.archived_policies(name)]
    rows = [row for name in archives for row in measured(name, options.pools, options.people)]
    result_tables.write(options.output.with_suffix(".csv"), rows)
    page = options.output.with_suffix(".md")
    page.write_text(result_pages.page(page, TITLE, tables(rows)))


def measured(name: str, directory: Path, people: int) -> Iterator[Row]:
    """What everybody gains by their best mode and by every archived policy of a task."""
    bench, policies = FewAnswers(name, directory, people), list(_driven(name, directory))
    not_driven = dict.fromkeys(policies[0][2], "")
    for group, tastes in bench.tastes.items():
        for user, taste in tastes.items():
            who, wish = {"task": name, "group": group, "user": user}, bench.wish(taste)
            yield {**who, "policy": MODE, "gain_percent": round(wish.best, 3), **not_driven}
            for policy, changes, outcome in policies:
                yield {**who, "policy": policy, "gain_percent": round(wish.worth(changes), 3), **outcome}


def _driven(name: str, directory: Path) -> Iterator[tuple[str, FloatArray, Row]]:
    """Name, (S,) by how much signals change, and what happens, of every archived policy."""
    cached, unseen = RolloutCache(name, directory / "rollouts"), first_of(EVALUATION, DRIVEN)
    reference = cached.reference(unseen)
    for policy, archived in zip(simulation.archived_policies(name), cached.archived(unseen), strict=True):
        changed = successes(archived.driven) - successes(reference)
        pressed = largest_forces(archived.driven) - largest_forces(reference) > FilterConfig.pressed_n
        outcome = {
            "success_points": round(100 * float(changed.mean()), 2),
            "pressed_percent": round(100 * float(pressed.mean()), 2),
        }
        yield policy, signal_changes(reference, archived.driven).mean(axis=0), outcome


def tables(rows: Sequence[Row]) -> str:
    """All below the mark."""
    parts = ["## What they are worth", *_HEAD_OF_WORTH]
    policies = ["## What each is worth", *_HEAD_OF_POLICIES]
    for task, some in groupby(rows, lambda row: row["task"]):
        names, gains, outcomes = _arranged(list(some))
        for group, table in gains.items():
            best = table[:, 1:].max(axis=1)
            both, better = np.maximum(best, table[:, 0]), 100 * (best > table[:, 0]).mean()
            means = " | ".join(_mean(each) for each in (table[:, 0], best, both))
            parts.append(f"| {task} | {group}, {len(table)} | {means} | {better:.0f} % |")
        for column, name in enumerate(names, 1):
            worth = " | ".join(
                f"{_best_for(gains[group], column):.0f} % | {_lost_without(gains[group], column):.2f}"
                for group in GROUPS[1:]
            )
            policies.append(f"| {task} | `{name}` | {' | '.join(outcomes[name])} | {worth} |")
    return "\n".join([*parts, "", *policies])


_HEAD_OF_WORTH = (
    "",
    "Gain of true preference in % of the stake, the mean with its 95 % interval over people (Student's t).",
    "",
    "| task | people | best mode | best archived policy | the better of both | archived is better for |",
    "|---|---|---|---|---|---|",
)
_HEAD_OF_POLICIES = (
    "",
    "Success beside the reference policy's in points, and how often somebody is pressed more than",
    f"{FilterConfig.pressed_n:g} N harder, in {DRIVEN} scenarios.",
    "*Best for*: share of people for whom nothing else, mode or archived, gains more. *Lost*: points by which the",
    "better of both would fall in the mean if the policy were not there.",
    "",
    "| task | policy | success | pressed | best for drawn | lost by drawn | best for outside | lost by outside |",
    "|---|---|---|---|---|---|---|---|",
)


def _arranged(rows: Sequence[Row]) -> tuple[list[str], dict[str, FloatArray], dict[str, tuple[str, str]]]:
    """The policies' names, everybody's gains by mode and policies in this order, (U, 1 + P) by group, and outcomes."""
    names = [row["policy"] for row in rows if row["user"] == rows[0]["user"] and row["policy"] != MODE]
    gains = {
        group: np.array([float(row["gain_percent"]) for row in some]).reshape(-1, 1 + len(names))
        for group, some in groupby(rows, lambda row: row["group"])
    }
    outcomes = {
        row["policy"]: (f"{float(row['success_points']):+.1f}", f"{float(row['pressed_percent']):.1f} %")
        for row in rows
        if row["policy"] != MODE
    }
    return names, gains, outcomes


def _mean(gains: FloatArray) -> str:
    low, high = mean_interval(gains)
    interval = "" if low is None else f" [{low:+.1f}, {high:+.1f}]"
    return f"{gains.mean():+.1f}{interval}"


def _best_for(gains: FloatArray, column: int) -> float:
    return float(100 * (gains.argmax(axis=1) == column).mean())


def _lost_without(gains: FloatArray, column: int) -> float:
    return float((gains.max(axis=1) - np.delete(gains, column, axis=1).max(axis=1)).mean())


if __name__ == "__main__":
    main()
