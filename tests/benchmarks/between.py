"""How often tests between people, and tests of order and period, are wrong in invented studies whose truth is known.

    OMP_NUM_THREADS=1 python -m tests.benchmarks.between --studies 500

Writes docs/results/between.csv, order_effects.csv and between.md, by the functions that the page of results uses.
"""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy import optimize, stats
from tqdm import tqdm

from app.services.evaluation.evaluation_plan import williams_rows
from tests.benchmarks import result_tables
from worker.analysis.comparison import result_pages
from worker.analysis.study.between import equivalence_between, means_of, permutation, welch_t
from worker.analysis.study.cumulative_link import fit_two, tested_between
from worker.analysis.study.hypothesis_tests import two_sample_t
from worker.analysis.study.order_effects import order_report
from worker.analysis.study.statistics import BOUND
from worker.domain.type_aliases import FloatArray

RESULTS = Path("docs/results")
ALPHA, TRIALS, NOISE = 0.05, 3, 0.8
TITLE = "# Error rates between subjects, and of order and period"


@dataclass(frozen=True)
class Truth:
    """Two groups: people, spread between the people of each, and what their ratings of 1 to 5 are on average."""

    name: str
    people: tuple[int, int]
    spreads: tuple[float, float]
    mean: float = 3.0
    """Of the first group's ratings, as they are given."""
    better: float = 0.0
    """By how much the second group's is higher."""


SIZES = ((4, 4), (8, 8), (16, 16), (24, 24), (6, 18))
TRUTHS = (
    *(Truth("equal spreads", people, (0.7, 0.7), better=better) for better in (0.0, BOUND, 0.8) for people in SIZES),
    *(
        Truth("unequal spreads .3, 1", people, (0.3, 1.0), better=better)
        for better in (0.0, BOUND)
        for people in (*SIZES, (18, 6))
    ),
    *(Truth("near an end", people, (0.7, 0.7), 4.3 - better, better) for better in (0.0, BOUND) for people in SIZES),
)
TESTS = (
    "welch_t",
    "permutation",
    "cumulative_link",
    "usual_errors",
    "two_sample_t",
    "equivalence",
)


def worth_of(mean: float, spread: float) -> float:
    """What a method is worth to people before rounding and cutting, if ratings of it are this high on average."""
    scatter = (spread**2 + NOISE**2) ** 0.5

    def excess(worth: float) -> float:
        return 1 + float(stats.norm.cdf((worth - np.arange(1.5, 5)) / scatter).sum()) - mean

    return float(optimize.brentq(excess, -5, 12))


def invented(truth: Truth, people: tuple[int, int], rng: np.random.Generator) -> list[list[FloatArray]]:
    """Of each group everybody's ratings."""
    groups = []
    for count, mean, spread in zip(people, (truth.mean, truth.mean + truth.better), truth.spreads, strict=True):
        worth = worth_of(mean, spread) + rng.normal(0.0, spread, count)[:, None]
        groups.append(list(np.clip(np.rint(worth + rng.normal(0.0, NOISE, (count, TRIALS))), 1, 5)))
    return groups


def results_of(first: Sequence[FloatArray], second: Sequence[FloatArray]) -> dict[str, dict[str, Any]]:
    """By test of TESTS, as the page of results has them; ``usual_errors``: as software prints the same model."""
    means = means_of(first), means_of(second)
    ratings = np.concatenate(first), np.concatenate(second)
    found = fit_two(first, second, paired=False)
    link, usual = tested_between(found, len(first), len(ratings[0]) + len(ratings[1])), {}
    if "p" in link:
        place = len(found.thresholds)
        usual["p"] = float(2 * stats.norm.sf(abs(found.effects[0]) / found.covariance()[place, place] ** 0.5))
    return {
        "welch_t": welch_t(*means),
        "permutation": permutation(*means),
        "cumulative_link": link,
        "usual_errors": usual,
        "two_sample_t": two_sample_t(*ratings),
        "equivalence": equivalence_between(*means, BOUND),
    }


def between_row(truth: Truth, studies: int) -> dict[str, Any]:
    """How often each test finds something, cannot be computed (the model), and how often intervals miss the truth.

    The true log odds are those of as many people as chance allows to be told: the model need not hold.
    """
    rng = np.random.default_rng(
        [*truth.people, *(round(10 * each) for each in (*truth.spreads, truth.mean, truth.better))]
    )
    many = invented(truth, (300 * truth.people[0], 300 * truth.people[1]), rng)
    true = {"welch_t": truth.better, "cumulative_link": float(fit_two(*many, paired=False).effects[0])}
    found, missed, computed = dict.fromkeys(TESTS, 0), dict.fromkeys(true, 0), dict.fromkeys(true, 0)
    for _ in range(studies):
        for test, result in results_of(*invented(truth, truth.people, rng)).items():
            found[test] += result.get("p", 1.0) < ALPHA
            if test in true and "low" in result:
                computed[test] += 1
                missed[test] += not result["low"] <= true[test] <= result["high"]
    return {
        "truth": truth.name,
        "people": f"{truth.people[0]} and {truth.people[1]}",
        "better": truth.better,
        "studies": studies,
        **{f"{test}_percent": round(100 * found[test] / studies, 1) for test in TESTS},
        **{f"{test}_misses_percent": round(100 * missed[test] / max(computed[test], 1), 1) for test in true},
        "model_not_computable_percent": round(100 * (1 - computed["cumulative_link"] / studies), 1),
    }


def studies_of(truth: Truth, studies: int) -> int:
    """Thrice as many where nothing differs: chance must move a false alarm rate by less than it may be off."""
    return studies if truth.better else 3 * studies


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
    parser.add_argument("--studies", type=int, default=500, help="of each truth; 3 times without effect, half of order")
    parser.add_argument("--to", type=Path, default=RESULTS, help="folder to write to")
    options = parser.parse_args(arguments)
    between = [between_row(truth, studies_of(truth, options.studies)) for truth in tqdm(TRUTHS, file=sys.stderr)]
    order = [
        order_row(people, drift, max(options.studies // 2, 1)) for drift in (0.0, 0.3) for people in (6, 8, 16, 24)
    ]
    for name, rows in (("between", between), ("order_effects", order)):
        result_tables.write(options.to / f"{name}.csv", rows)
    page = options.to / "between.md"
    page.write_text(result_pages.page(page, TITLE, f"{_table(between)}\n\n{_table(order)}"))


if __name__ == "__main__":
    main()
