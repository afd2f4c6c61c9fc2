"""The default beside rivals of today: tasks x users x seeds, method by method, as a table that grows.

    python -m tests.benchmarks.rivals --output docs/results/rivals

Every cell is fitted and driven through 500 unseen scenarios as `python -m worker benchmark` does; when it is done a row
is added to the table, with every single episode, and the page is written anew. What has a row is never run again, on
whatever machine. One process on one core, at the lowest priority, so it can run beside other work; interrupted, it
loses the present cell. Seeds are finished one by one, cheap methods first; --tasks, --users, --methods choose. With
--on-workers N the studio's workers do the cells (docs/deploy.md), N each at a time.
"""

import argparse
import json
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from app.installed_tasks import catalogue
from app.settings import Settings
from tests.benchmarks import result_tables, rivals_picture, rivals_report
from worker.analysis.comparison import result_pages
from worker.commands import options as spoken
from worker.domain.type_aliases import FloatArray
from worker.experiments import benchmark_cell
from worker.experiments.benchmark import PROFILES
from worker.experiments.benchmark_cell import PAPER_USERS, BenchmarkConfig, Cell
from worker.jobs import experiments
from worker.ml.methods.registry import METHODS
from worker.ml.teachers import Taste
from worker.sim.costs import preference_rewards, stakes
from worker.tasks import registry

TERMS: BenchmarkConfig = PROFILES["full"]


def main() -> None:
    """Run what has no row yet, cell by cell."""
    options = _options()
    table = options.output.with_suffix(".csv")
    rows: list[rivals_report.Row] = list(result_tables.read(table))
    known = {rivals_report.name_of(row) for row in rows}
    missing = [cell for cell in _cells(options) if (cell.task, cell.taste.name, cell.method, cell.seed) not in known]
    if not options.report_only:
        if options.on_workers:
            missing = _have_measured(missing, rows, options)
        os.nice(19 - os.nice(0))
        _measure(missing, rows, options)
    if rows:
        options.output.with_suffix(".svg").write_bytes(rivals_picture.svg(rows))
        page = options.output.with_suffix(".md")
        page.write_text(result_pages.page(page, rivals_report.TITLE, rivals_report.page(rows)))


def _measure(missing: Sequence[Cell], rows: list[rivals_report.Row], options: argparse.Namespace) -> None:
    for cell in tqdm(missing, unit="cell"):
        rows.append(_row(cell, options.work_directory))
        result_tables.write(options.output.with_suffix(".csv"), rows)


def _have_measured(missing: Sequence[Cell], rows: list[rivals_report.Row], options: argparse.Namespace) -> list[Cell]:
    """Have workers run the cells, and the reference policy's beside them; returns those that failed there."""
    work, left = options.work_directory, list(missing)

    def done() -> None:
        for cell in [each for each in left if all(_has(part, work) for part in (each, _of(each, "reference")))]:
            left.remove(cell)
            rows.append(_row(cell, work))
            result_tables.write(options.output.with_suffix(".csv"), rows)

    needed = dict.fromkeys(part for each in missing for part in (_of(each, "reference"), each))
    asked = [cell for cell in needed if not _has(cell, work)]
    failures = experiments.on_workers(Settings(), options.on_workers, asked, TERMS, work, done)
    sys.stderr.write("".join(f"{failure}\n" for failure in failures))
    return left


def _has(cell: Cell, work: Path) -> bool:
    return cell.path(TERMS, work).exists()


def _cells(options: argparse.Namespace) -> Iterator[Cell]:
    for seed in options.seeds:
        for method in options.methods:
            for task in options.tasks:
                for taste in options.users:
                    yield Cell(task, taste, method, seed)


def _row(cell: Cell, work: Path) -> Mapping[str, Any]:
    """The cell's record and what its episodes gained over the reference policy's, in thousandths of the stake."""
    reference, filtered = (_loaded(each, work) for each in (_of(cell, "reference"), cell))
    task, taste = registry.task(cell.task), cell.taste
    before, after = (_true(each, cell, preference_rewards) for each in (reference, filtered))
    stake = float(_true(reference, cell, stakes).mean())
    record = json.loads(str(filtered["record"]))
    return {
        "task": task.name,
        "user": taste.name,
        "method": cell.method,
        "seed": cell.seed,
        **{name: f"{record['spent'][name]:g}" for name in ("labels", "environment_steps", "cpu_s", "wall_s")},
        "first_scenario": int(filtered["scenarios"][0]),
        "gains": rivals_report.gains_text((after - before) / stake),
        "successes": rivals_report.successes_text(filtered["success"]),
        "successes_reference": rivals_report.successes_text(reference["success"]),
        "code": record["code"],
        "measured": datetime.fromtimestamp(cell.path(TERMS, work).stat().st_mtime, UTC).date().isoformat(),
        "notes": " ".join(record["notes"]),
    }


def _of(cell: Cell, method: str) -> Cell:
    return Cell(cell.task, cell.taste, method, cell.seed)


def _loaded(cell: Cell, work: Path) -> dict[str, Any]:
    path = cell.path(TERMS, work)
    if not path.exists():
        benchmark_cell.run_cell(cell, TERMS, work)
    with np.load(path, allow_pickle=False) as stored:
        return {name: stored[name] for name in stored.files}


def _true(arrays: Mapping[str, Any], cell: Cell, measure: Any) -> FloatArray:
    """(N,) of every episode, from its summed costs and signals: all of it is linear."""
    taste: Taste = cell.taste
    found: FloatArray = measure(
        registry.task(cell.task), arrays["costs"], arrays["signals"], taste.omega, TERMS.form, taste.per_signal
    )
    return found


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", choices=catalogue.names(), default=catalogue.names())
    parser.add_argument("--users", nargs="+", type=spoken.taste, default=list(PAPER_USERS.values()))
    parser.add_argument("--methods", nargs="+", choices=list(METHODS), default=list(rivals_report.CHEAP_FIRST))
    parser.add_argument("--seeds", nargs="+", type=int, default=list(range(rivals_report.GOAL_SEEDS)))
    parser.add_argument(
        "--work-directory", type=Path, default=Path("data/benchmark"), help="of rollouts and finished cells"
    )
    parser.add_argument("--on-workers", type=int, metavar="N", help="how many cells each worker does at a time")
    parser.add_argument("--report-only", action="store_true", help="run nothing, write the page from the table")
    parser.add_argument(
        "--output", type=result_tables.stem, required=True, help="path without ending of the page and the table"
    )
    return parser.parse_args()


if __name__ == "__main__":
    main()
