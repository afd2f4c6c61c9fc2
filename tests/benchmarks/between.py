"""How often tests between people, and tests of order and period, are wrong in invented studies whose truth is known.

    OMP_NUM_THREADS=1 python -m tests.benchmarks.between --studies 2000

Writes docs/results/between.csv, order_effects.csv and between.md, by the functions that the page of results uses.
"""

import argparse
import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from app.services.evaluation.evaluation_plan import williams_rows
from worker.analysis.comparison import result_pages
from worker.analysis.study.between import permutation, welch_t
from worker.analysis.study.hypothesis_tests import two_sample_t
from worker.analysis.study.order_effects import order_report
from worker.domain.type_aliases import FloatArray

RESULTS = Path("docs/results")
ALPHA, TRIALS, NOISE = 0.05, 3, 0.8
TITLE = "# Error rates between subjects, and of order and period"


@dataclass(frozen=True)
class Truth:
    """Two groups: people, spread between the people of each, and by how much the second is better."""

    name: str
    people: tuple[int, int]
    spreads: tuple[float, float]
    effect: float = 0.0


TRUTHS = tuple(
    Truth(name, people, spreads, effect)
    for effect in (0.0, 0.8)
    for name, spreads in (("equal spreads", (0.7, 0.7)), ("unequal spreads .3, 1", (0.3, 1.0)))
    for people in ((4, 4), (8, 8), (16, 16), (24, 24), (6, 18))
)


def group(people: int, mean: float, spread: float, rng: np.random.Generator) -> FloatArray:
    """Ratings of 1 to 5, (people, trials)."""
    worth = mean + rng.normal(0.0, spread, people)[:, None]
    return np.clip(np.rint(worth + rng.normal(0.0, NOISE, (people, TRIALS))), 1, 5)


def between_row(truth: Truth, studies: int) -> dict[str, Any]:
    """False alarms, or findings where there is an effect, and how often the interval misses the true difference."""
    rng = np.random.default_rng([*truth.people, int(10 * truth.spreads[0]), int(10 * truth.effect)])
    large = [
        group(200_000, 3 + effect, spread, rng).mean()
        for effect, spread in zip((0.0, truth.effect), truth.spreads, strict=True)
    ]
    difference = large[1] - large[0]
    tally = dict.fromkeys(("welch_t", "permutation", "two_sample_t", "misses", "computed"), 0)
    for _ in range(studies):
        first, second = (
            group(people, 3 + effect, spread, rng)
            for people, effect, spread in zip(truth.people, (0.0, truth.effect), truth.spreads, strict=True)
        )
        means = first.mean(axis=1).round(12), second.mean(axis=1).round(12)
        welch = welch_t(*means)
        results = {"welch_t": welch, "permutation": permutation(*means)}
        results["two_sample_t"] = two_sample_t(first.ravel(), second.ravel())
        for name, result in results.items():
            tally[name] += result.get("p", 1.0) < ALPHA
        if "low" in welch:
            tally["computed"] += 1
            tally["misses"] += not welch["low"] <= difference <= welch["high"]
    return {
        "truth": truth.name,
        "people": f"{truth.people[0]} and {truth.people[1]}",
        "effect": truth.effect,
        "studies": studies,
        **{
            f"{name}_percent": round(100 * tally[name] / studies, 1)
            for name in ("welch_t", "permutation", "two_sample_t")
        },
        "misses_percent": round(100 * tally["misses"] / max(tally["computed"], 1), 1),
    }


def order_row(people: int, drift: float, studies: int, methods: int = 3) -> dict[str, Any]:
    """How often a period or a carryover effect is found. ``drift``: points per block; there is no carryover."""
    rng, orders = np.random.default_rng([people, int(100 * drift), methods]), williams_rows(methods)
    tally = dict.fromkeys(("period", "carryover"), 0)
    for _ in range(studies):
        tables = []
        for person in range(people):
            level, worth = rng.normal(0.0, 0.6), rng.normal(0.0, 0.5, methods)
            for period, method in enumerate(orders[person % len(orders)]):
                felt = 3 + level + worth[method] + drift * period + rng.normal(0.0, NOISE, TRIALS)
                said = np.clip(np.rint(felt), 1, 5)
                tables += [(person, method, period * TRIALS + trial, value) for trial, value in enumerate(said)]
        rows = pd.DataFrame(tables, columns=["participant", "method", "order", "said"])
        report = order_report(rows, "said")
        for name in tally:
            tally[name] += report[name].get("p", 1.0) < ALPHA
    found = {f"{name}_percent": round(100 * count / studies, 1) for name, count in tally.items()}
    return {"people": people, "methods": methods, "drift": drift, "studies": studies, **found}


def _table(rows: Sequence[dict[str, Any]]) -> str:
    lines = ["| " + " | ".join(name.replace("_percent", ", %").replace("_", " ") for name in rows[0]) + " |"]
    lines += ["|---" * len(rows[0]) + "|", *("| " + " | ".join(map(str, each.values())) + " |" for each in rows)]
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure everything and write all files."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--studies", type=int, default=2000, help="of each truth")
    parser.add_argument("--to", type=Path, default=RESULTS, help="folder to write to")
    options = parser.parse_args(arguments)
    between = [between_row(truth, options.studies) for truth in TRUTHS]
    order = [
        order_row(people, drift, max(options.studies // 4, 1)) for drift in (0.0, 0.3) for people in (6, 8, 16, 24)
    ]
    for name, rows in (("between", between), ("order_effects", order)):
        with (options.to / f"{name}.csv").open("w", newline="") as file:
            writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)
    page = options.to / "between.md"
    page.write_text(result_pages.page(page, TITLE, f"{_table(between)}\n\n{_table(order)}"))


if __name__ == "__main__":
    main()
