"""Seconds from the last label to a bundle, stage by stage, as a study's worker does it.

    python -m tests.benchmarks.retraining --output docs/results/retraining

Per task: 200 answers of a scripted user, then what the worker does after an early milestone and after the last:
reward model, all stages of the filter, promise about harm, 100 unseen scenarios, ONNX export, bundle. Beforehand what
the worker does while people answer: it makes rollouts that are the same for everybody, in one process behind everything
else. Run it alone on the machine: these are plain seconds. A user's rows are written once measured, in place of older
ones; those of other users and tasks stay, so that it can be run task by task.
"""

import argparse
import os
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from tqdm import tqdm

from app.domain.study_settings import PAPER_PROTOCOL
from app.installed_tasks import catalogue
from tests.benchmarks import result_tables
from worker.analysis.comparison import result_pages
from worker.analysis.filters.promise import Outcome
from worker.compute import filter_finishing, learning, stages
from worker.compute.filter_fitting import FilterFit
from worker.compute.pools import Compute, Lane
from worker.domain.trajectory import Trajectory
from worker.experiments.benchmark_cell import BenchmarkConfig, BenchmarkUser, Cell
from worker.experiments.rollout_cache import RolloutCache
from worker.jobs.learning.reference_rollouts import make_ready
from worker.ml.export.bundle import Provenance
from worker.ml.filters.exported.filter_module import FilterWeights
from worker.ml.filters.fitting.filter_draft import FilterDraft
from worker.ml.filters.fitting.filter_problem import FilterConfig
from worker.ml.teachers import TASTES

STAGES = ("reward", "quick", "mode", "residual", "gate", "archived", "promise", "evaluation_and_bundle")
FILTERS = {"quick": stages.QUICK, "last": stages.LAST}
Row: TypeAlias = dict[str, Any]
PROVENANCE = Provenance("benchmark", "P01", 1, 200, "", 0, "2000-01-01T00:00:00+00:00", "", "none")


TITLE = "# From the last label to the bundle, in seconds"


def main() -> None:
    """Measure every task and user that was asked for."""
    options = _options()
    table = options.output.with_suffix(".csv")
    rows: list[Row] = list(result_tables.read(table))
    for task in tqdm(options.tasks, unit="task"):
        for measured in _measured(task, options):
            rows = _with(measured, rows)
            result_tables.write(table, rows)
    sys.stdout.write(_markdown(rows))
    page = options.output.with_suffix(".md")
    page.write_text(result_pages.page(page, TITLE, _tables(rows, options)))


def _with(measured: Sequence[Row], rows: Sequence[Row]) -> list[Row]:
    """A user's new rows among those of others; a table of other columns is begun anew."""
    new = measured[0]
    kept = [
        row for row in rows if row.keys() == new.keys() and (row["task"], row["user"]) != (new["task"], new["user"])
    ]
    return sorted([*kept, *measured], key=lambda row: catalogue.names().index(row["task"]))


def _measured(task: str, options: argparse.Namespace) -> Iterator[list[Row]]:
    """User by user, with one worker that has made everything ready."""
    cached = RolloutCache(task, options.work_directory / "rollouts")
    compute = Compute(options.processes)
    references: dict[tuple[str, range], list[Trajectory]] = {}
    outcomes: dict[tuple[str, int], list[Outcome]] = {}
    try:
        started = time.perf_counter()
        for lane in (Lane.REWARDS, Lane.LEARNING):
            compute.warm_up(lane, partial(learning.warm_up, task))
        make_ready(compute, references, outcomes, task, PAPER_PROTOCOL, 0)
        ahead = round(time.perf_counter() - started, 1)
        for user in options.users:
            cell = Cell(task, TASTES[user], "pbarl", 0)
            bench = BenchmarkUser(cell, BenchmarkConfig(), cached, options.work_directory)
            yield [
                {**_run(task, user, bench, compute, references, outcomes, each), "made_ready": ahead}
                for each in FILTERS
            ]
    finally:
        compute.close()


def _run(
    task: str,
    user: str,
    bench: BenchmarkUser,
    compute: Compute,
    references: dict[tuple[str, range], list[Trajectory]],
    outcomes: dict[tuple[str, int], list[Outcome]],
    which: str,
) -> Row:
    seconds, begun = dict.fromkeys(STAGES, 0.0), time.perf_counter()

    def measured(stage: str, started: float) -> None:
        seconds[stage] = round(time.perf_counter() - started, 2)

    answers = (bench.labelled, bench.targets.astype(np.float32), bench.scale, 0)
    reward, _ = compute.run(Lane.REWARDS, _no_beat, learning.fit_reward, task, "structured", *answers)
    measured("reward", begun)
    fitting = FilterFit(
        task,
        compute,
        _no_beat,
        reward,
        0,
        FilterConfig(),
        progress=lambda stage, share: None,
        references=references,
        version=len(PAPER_PROTOCOL.milestones) if which == "last" else 1,
        outcomes=outcomes,
        stages=FILTERS[which],
    )
    pool = bench.setting().pool
    by_stage: dict[str, Callable[[FilterDraft], FilterDraft]] = {
        "quick": lambda _: fitting.find_quickly(pool, archived=True),
        "mode": lambda _: fitting.find_mode(pool),
        "residual": fitting.train_residual,
        "gate": fitting.gate_residual,
        "archived": lambda draft: fitting.choose_archived(draft, pool),
        "promise": fitting.keep_promise,
    }
    draft = FilterDraft(FilterWeights())
    for stage in stages.before_finish(fitting.stages):
        started = time.perf_counter()
        draft = by_stage[stage](draft)
        measured(stage, started)
    started = time.perf_counter()
    finished = filter_finishing.finish(fitting, draft, PROVENANCE, {})
    measured("evaluation_and_bundle", started)
    evaluation = finished.metrics["evaluation"]
    return {
        "task": task,
        "user": user,
        "filter": which,
        "tried": sum(not trial.refined and trial.residual_share == 0.0 for trial in draft.trials),
        **seconds,
        "seconds": round(time.perf_counter() - begun, 1),
        "archived_policy": bool(draft.weights.refined),
        "success_delta": round(evaluation["success"]["delta"], 3),
        "promise_tests": ", ".join(_in_words(test) for test in draft.promise["tests"]),
    }


def _in_words(test: Mapping[str, Any]) -> str:
    return f"{test['harmed']} of {test['scenarios']} at {test['strength']:.0%}"


def _no_beat() -> None:
    """Nobody watches."""


def _markdown(rows: Sequence[Row]) -> str:
    names = list(rows[0])
    lines = ["| " + " | ".join(name.replace("_", " ") for name in names) + " |", "|---" * len(names) + "|"]
    lines += ["| " + " | ".join(str(row[name]) for name in names) + " |" for row in rows]
    return "\n".join(lines) + "\n"


def _tables(rows: Sequence[Row], options: argparse.Namespace) -> str:
    load = ", ".join(f"{value:.1f}" for value in os.getloadavg())
    return f"""\
200 scripted answers; {options.processes} processes of one thread on {os.cpu_count()} cores; load averages when the last
rows were written {load}.

{_markdown(rows)}"""


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", choices=catalogue.names(), default=catalogue.names())
    parser.add_argument("--users", nargs="+", choices=TASTES, default=["cautious", "impatient"])
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument(
        "--work-directory", type=Path, default=Path("data/benchmark"), help="of the benchmark's rollouts"
    )
    parser.add_argument(
        "--output", type=result_tables.stem, required=True, help="path without ending of the page and the table"
    )
    return parser.parse_args()


if __name__ == "__main__":
    main()
