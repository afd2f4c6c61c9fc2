"""How often do the intervals of rivals.md miss? Invented tables of two methods, counted.

    python -m tests.benchmarks.rivals_error_rates --output docs/results/rivals_error_rates

Nine strata whose means differ, runs that differ from seed to seed by SEED_SPREAD, scenarios by SCENARIO_SPREAD, half of
which two methods share: about what the first cells of rivals.csv show. Both methods are drawn from the same
distribution, so the true difference is 0 and the true probability of improvement one half. The intervals of a single
cell are counted in tables of as many scenarios as rivals.csv has.
"""

import argparse
from typing import Any

import numpy as np
from tqdm import tqdm

from tests.benchmarks import result_tables
from worker.analysis.comparison import aggregate, result_pages
from worker.analysis.comparison.table_files import to_csv
from worker.analysis.filters.evaluation import mean_change
from worker.domain.type_aliases import FloatArray

TITLE = "# How often do the intervals of the table of rivals miss?"
STRATA, SCENARIOS, CELL_SCENARIOS = 9, 20, 500
SEED_SPREAD, SCENARIO_SPREAD = 0.01, 0.035
IN_A_CELL = "difference in a cell"
MEASURES = {"difference of interquartile means": (aggregate.difference, 0.0)} | {
    "probability of improvement": (aggregate.probability_of_improvement, 0.5)
}


def main() -> None:
    """Write the table and the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tables", type=int, default=200)
    parser.add_argument(
        "--output", type=result_tables.stem, required=True, help="path without ending of the page and the table"
    )
    options = parser.parse_args()
    rows = []
    for seeds in (1, 3, 5):
        missed = dict.fromkeys(MEASURES, 0)
        for number in tqdm(range(options.tables), unit="table", desc=f"{seeds} seeds"):
            own, other = _invented(seeds, np.random.default_rng([seeds, number, 114]))
            for name, (measure, truth) in MEASURES.items():
                found = aggregate.compare(own, other, measure, number)
                missed[name] += not found.low <= truth <= found.high
        for name, count in missed.items():
            rows.append(_row(name, seeds, options.tables, count))
        rows.append(_row(IN_A_CELL, seeds, STRATA * options.tables, _missed_in_cells(seeds, options.tables)))
    options.output.with_suffix(".csv").write_text(to_csv(rows))
    page = options.output.with_suffix(".md")
    lines = ["| interval | seeds | intervals | misses, % (promised: 5) |", "|---" * 4 + "|"]
    lines += [
        f"| {row['interval']} | {row['seeds']} | {row['intervals']} | {100 * row['missed']:.1f} |" for row in rows
    ]
    page.write_text(result_pages.page(page, TITLE, "\n".join(lines)))


def _row(interval: str, seeds: int, count: int, missed: int) -> dict[str, Any]:
    return {"interval": interval, "seeds": seeds, "intervals": count, "missed": missed / count}


def _missed_in_cells(seeds: int, tables: int) -> int:
    """Intervals of the difference in a cell that exclude the truth: over seeds where there are several."""
    missed = 0
    for number in range(tables):
        for own, other in zip(
            *_invented(seeds, np.random.default_rng([seeds, number, 195]), CELL_SCENARIOS), strict=True
        ):
            runs = (own.mean(axis=1), other.mean(axis=1)) if seeds > 1 else (own[0], other[0])
            found = mean_change(*runs)
            missed += not found["low"] <= 0.0 <= found["high"]
    return missed


def _invented(
    seeds: int, rng: np.random.Generator, scenarios: int = SCENARIOS
) -> tuple[list[FloatArray], list[FloatArray]]:
    """Two methods that are equally good; per stratum (seeds, scenarios) each."""
    own: list[FloatArray] = []
    other: list[FloatArray] = []
    for mean in np.linspace(0.02, 0.2, STRATA):
        shared = rng.standard_normal((seeds, scenarios))
        for method in (own, other):
            apart = rng.standard_normal((seeds, scenarios))
            episodes = SCENARIO_SPREAD * np.sqrt(0.5) * (shared + apart)
            method.append(mean + SEED_SPREAD * rng.standard_normal((seeds, 1)) + episodes)
    return own, other


if __name__ == "__main__":
    main()
