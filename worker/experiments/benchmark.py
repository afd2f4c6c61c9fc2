"""Methods x tasks x users x seeds on unseen scenarios: ``python -m worker benchmark`` (the paper's Table I and more).

Every finished cell is a file; what is missing is run, spread over processes, and after every few cells all tables are
written anew from the cells there are. An interrupted run goes on where it was, and nothing is ever run twice.
"""

import json
import platform
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import torch
from tqdm import tqdm

from app.installed_tasks import catalogue
from worker.analysis.comparison import comparison_page, pareto
from worker.analysis.comparison.comparison_rows import Cells, EvaluatedCell, Row, pooled, table_rows
from worker.analysis.comparison.table_files import tables, to_csv
from worker.compute.pools import Compute, Lane
from worker.domain.trajectory import COSTS
from worker.experiments import benchmark_cell
from worker.experiments.benchmark_cell import INDIRECT_USERS, OPPOSED_USERS, PAPER_USERS, BenchmarkConfig, Cell
from worker.experiments.rollout_cache import RolloutCache, policy_mark
from worker.ml.filters.fitting.filter_problem import FilterConfig
from worker.ml.methods.latent_people import Latent
from worker.ml.methods.pbrl_hri import FromScratch
from worker.ml.methods.prefft import FineTuning
from worker.ml.methods.prefft_lagrangian import Constraint
from worker.ml.methods.registry import METHODS, MethodConfig
from worker.ml.methods.steered_rl import Steering
from worker.ml.reinforcement.refinement import Refinement
from worker.ml.teachers import Manner, Taste, random_taste
from worker.sim.costs import preference_rewards, stakes
from worker.tasks import registry
from worker.tasks.registry import checkpoint
from worker.whole_files import whole_files, written_whole

INTERRUPTED = 130
"""Exit code after Ctrl-C, as shells have it."""
REPORT_EVERY_S = 20.0
SHELF_CHUNK = 10
PROFILES = {
    "full": BenchmarkConfig(),
    "quick": BenchmarkConfig(
        labels=40,
        scenarios=20,
        smallest_pool=8,
        filter=FilterConfig(
            mode_attempts=2,
            gates=(0.5,),
            gate_scenarios=12,
            check_scenarios=12,
            watch_scenarios=12,
            residual_rounds=1,
            residual_rollouts=12,
            value_steps=200,
            adapter_steps=60,
        ),
        methods=MethodConfig(
            printed_steps=150,
            printed_rollouts=12,
            fine_tuning=FineTuning(steps=2_400, warm_up_steps=800, critic_first_updates=100, cloning_steps=300),
            from_scratch=FromScratch(steps=2_400, random_steps=800),
            value_rollouts=12,
            value_steps=200,
            steering=Steering(steps=2_400, warm_up_steps=800, critic_first_updates=100, flow_steps=100),
            refinement=Refinement(
                steps=2_400, warm_up_steps=800, imitation_steps=200, critic_first_updates=100, critic_again_updates=100
            ),
            constraint=Constraint(scenarios=10, every_steps=1_000),
            others=4,
            others_labels=20,
            latent=Latent(steps=100),
        ),
    ),
}
"""How much of everything; quick is for seeing it work and for tests, its numbers mean nothing."""


Done: TypeAlias = Callable[[], None]
"""Called whenever cells are finished."""
Run: TypeAlias = Callable[[Sequence[Cell], BenchmarkConfig, Path, Done], list[str]]
"""Makes the files of missing cells and returns what went wrong, cell by cell."""


@dataclass(frozen=True)
class Selection:
    """What is to be run; the tables also show what was run earlier under the same terms."""

    methods: Sequence[str] = tuple(METHODS)
    tasks: Sequence[str] = catalogue.names()
    tastes: Sequence[Taste] = tuple(PAPER_USERS.values())
    seeds: int = 1

    def cells(self) -> list[Cell]:
        """Seed by seed, method by method, the reference policy first: what is there early is already a table."""
        names = sorted({*self.methods, "reference"}, key=list(METHODS).index)
        return [
            Cell(task, taste, method, seed)
            for seed in range(self.seeds)
            for method in names
            for task in self.tasks
            for taste in self.tastes
        ]


def population(count: int) -> list[Taste]:
    """Users drawn at random, always the same ones."""
    return [random_taste(f"person-{number}", np.random.default_rng([number, 11])) for number in range(count)]


def benchmark(
    selection: Selection,
    terms: BenchmarkConfig,
    work: Path,
    output: Path,
    command: str,
    run: Run | None,
) -> int:
    """Run what is missing and write the tables; returns the exit code. ``run``: on_this_machine(), or on workers.

    None: nothing is run. 1: a cell failed, and its reason is on the standard error; all others were run. 130:
    interrupted.
    """
    missing = [cell for cell in selection.cells() if not cell.path(terms, work).exists()]
    failures: list[str] = []
    code, reported = 0, time.monotonic()

    def report_now_and_then() -> None:
        nonlocal reported
        if time.monotonic() - reported > REPORT_EVERY_S:
            _report(terms, work, output, command)
            reported = time.monotonic()

    if run is not None and missing:
        try:
            failures = run(missing, terms, work, report_now_and_then)
        except KeyboardInterrupt:
            sys.stderr.write("Interrupted. The same command goes on from here.\n")
            code = INTERRUPTED
    _report(terms, work, output, command)
    for failure in failures:
        sys.stderr.write(failure + "\n")
    return code or (1 if failures else 0)


# -- running -----------------------------------------------------------------------------------------------------------


def on_this_machine(
    processes: int, missing: Sequence[Cell], terms: BenchmarkConfig, work: Path, done: Done
) -> list[str]:
    """Spread the cells over processes; returns what went wrong, cell by cell."""
    compute = Compute(processes)
    try:
        _fill_caches(compute, processes, missing, terms, work)
        return _run_cells(compute, processes, missing, terms, work, done)
    finally:
        compute.close()


def _fill_caches(compute: Compute, processes: int, missing: Sequence[Cell], terms: BenchmarkConfig, work: Path) -> None:
    """Rollouts that all cells of a task share, first and in parallel."""
    jobs = []
    for task in dict.fromkeys(cell.task for cell in missing):
        blocks = [each(registry.task(task)) for each in (terms.filter.gate_block, terms.filter.home_block)]
        jobs += [(task, work, "behaviours", chunk) for chunk in _chunks(terms.pool)]
        unseen = [terms.unseen(seed) for seed in dict.fromkeys(cell.seed for cell in missing)]
        jobs += [(task, work, "reference", chunk) for part in (*unseen, *blocks) for chunk in _chunks(part)]
    _in_parallel(compute, processes, "shared rollouts", fill_shelf, jobs)


def fill_shelf(task: str, work: Path, what: str, scenarios: Sequence[int]) -> None:
    """Make what is missing of a stretch of shared rollouts."""
    rollout_cache = RolloutCache(task, work / "rollouts")
    if what == "behaviours":
        rollout_cache.behaviours(scenarios)
    else:
        rollout_cache.reference(scenarios)


def _run_cells(
    compute: Compute, processes: int, missing: Sequence[Cell], terms: BenchmarkConfig, work: Path, done: Done
) -> list[str]:
    return _in_parallel(
        compute, processes, "cells", benchmark_cell.run_cell, [(cell, terms, work) for cell in missing], done
    )


def _in_parallel(
    compute: Compute,
    processes: int,
    what: str,
    function: Any,
    jobs: Sequence[tuple[Any, ...]],
    done: Done | None = None,
) -> list[str]:
    """One job per free process; returns what went wrong, job by job, and goes on with the others."""
    failures = []
    # One waiting thread per process: Compute waits for all jobs of a call, and cells take from a second to an hour.
    with ThreadPoolExecutor(processes) as threads, tqdm(total=len(jobs), unit=what.split()[-1], desc=what) as bar:
        waiting: dict[Future[Any], tuple[Any, ...]] = {
            threads.submit(compute.run, Lane.LEARNING, _no_beat, function, *job): job for job in jobs
        }
        try:
            while waiting:
                for future in wait(waiting, return_when=FIRST_COMPLETED).done:
                    job = waiting.pop(future)
                    bar.update(1)
                    error = future.exception()
                    if error is not None:
                        failures.append(f"{job[0]}: {type(error).__name__}: {error}")
                if done is not None:
                    done()
        except BaseException:
            compute.close()
            threads.shutdown(wait=False, cancel_futures=True)
            raise
    return failures


def _no_beat() -> None:
    """Nobody watches this process."""


def _chunks(scenarios: range) -> list[range]:
    return [scenarios[first : first + SHELF_CHUNK] for first in range(0, len(scenarios), SHELF_CHUNK)]


# -- reporting ---------------------------------------------------------------------------------------------------------


def _report(terms: BenchmarkConfig, work: Path, output: Path, command: str) -> None:
    """All files, from the cells there are."""
    found = list(_finished(terms, work))
    tastes = {taste.name: taste for _, _, taste in found}
    runs = [_run(record, arrays, terms, tastes) for record, arrays, _ in found]
    cells = pooled(sorted(runs, key=_order))
    if not cells:
        return
    output.mkdir(parents=True, exist_ok=True)
    groups = _groups(list(tastes))
    for name, rows in tables(cells, groups, _users(tastes)).items():
        if rows:
            _replace(output / f"{name}.csv", to_csv(rows))
        else:
            (output / f"{name}.csv").unlink(missing_ok=True)
    made = _made(terms, cells, command, groups, Counter(record.get("code", "not recorded") for record, _, _ in found))
    _replace(output / "made.json", json.dumps(made, indent=2) + "\n")
    _replace(output / "table1.md", comparison_page.page(output))
    for name, picture in pareto.pictures(table_rows(cells), list(METHODS)):
        _replace(output / name, picture)


def _finished(terms: BenchmarkConfig, work: Path) -> Iterator[tuple[dict[str, Any], dict[str, Any], Taste]]:
    """Every cell under these terms that was run with the present policies."""
    present = {
        f"{task}-{policy_mark(task)}"
        for task in catalogue.names()
        if (checkpoint(task) / "policy.safetensors").exists()
    }
    for path in whole_files(terms.directory(work), "*/*/*.npz"):
        if path.parts[-3] not in present:
            continue
        with np.load(path, allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
        record = json.loads(str(arrays.pop("record")))
        taste = Taste(record["taste"]["name"], tuple(record["taste"]["omega"]), record["taste"]["per_signal"])
        yield record, arrays, taste


def _run(
    record: dict[str, Any], arrays: dict[str, Any], terms: BenchmarkConfig, tastes: dict[str, Taste]
) -> EvaluatedCell:
    """r^H is linear in the measured sums, so every user can judge every run."""
    task = registry.task(record["task"])
    true, at_stake = (
        {
            name: of(task, arrays["costs"], arrays["signals"], taste.omega, terms.form, taste.per_signal)
            for name, taste in tastes.items()
        }
        for of in (preference_rewards, stakes)
    )
    return EvaluatedCell(
        record["task"],
        record["taste"]["name"],
        record["method"],
        record["seed"],
        record["labels"],
        arrays["success"],
        arrays["learned"],
        true,
        at_stake,
        arrays["costs"],
        record["spent"],
        tuple(record["notes"]),
    )


def _order(run: EvaluatedCell) -> tuple[int, int, int, str]:
    users = [*PAPER_USERS, *OPPOSED_USERS, *INDIRECT_USERS]
    user = users.index(run.user) if run.user in users else len(users)
    return catalogue.names().index(run.task), user, list(METHODS).index(run.method), run.user


def _groups(users: Sequence[str]) -> list[list[str]]:
    """The paper's users among themselves, so those who truly differ, those no mode is made for, and all others."""
    known = [list(PAPER_USERS), list(OPPOSED_USERS), list(INDIRECT_USERS)]
    others = [user for user in users if not any(user in group for group in known)]
    return [*known, others]


def _made(
    terms: BenchmarkConfig, cells: Cells, command: str, groups: Sequence[Sequence[str]], states: Counter[str]
) -> dict[str, Any]:
    """How the tables were made. Cells do not run again when the code changes, so its states are counted."""
    return {
        "commands": [command],
        "cells": len(cells),
        "seeds": sorted({run.seed for cell in cells.values() for run in cell.runs}),
        "labels": terms.labels,
        "manner": _spoken(terms.manner),
        "pool_scenarios": len(terms.pool),
        "rule": terms.rule,
        "reward": terms.reward,
        "form": terms.form,
        "scenarios": terms.scenarios,
        "first_scenario": terms.unseen(0).start,
        "prefft_steps": terms.methods.fine_tuning.steps,
        "pbrl_hri_steps": terms.methods.from_scratch.steps,
        "printed_steps": terms.methods.printed_steps,
        "versions": f"Python {platform.python_version()}, NumPy {np.__version__}, torch {torch.__version__}",
        "policies": {task: policy_mark(task) for task in dict.fromkeys(task for task, _, _ in cells)},
        "code": dict(states.most_common()),
        "groups": groups,
    }


def _users(tastes: dict[str, Taste]) -> list[Row]:
    """What each scripted user minds: per item of r^H, and per unit of a further signal."""
    return [
        {"user": taste.name, "item": item, "weight": weight}
        for taste in tastes.values()
        for item, weight in [*zip(COSTS, taste.omega, strict=True), *taste.per_signal.items()]
    ]


def _spoken(manner: Manner) -> str:
    told = [f"{100 * manner.mistakes:g} % mistakes", f'{100 * manner.equal_share:g} % "equal"']
    if manner.rationality is not None:
        told.append(f"rationality {manner.rationality:g}")
    return ", ".join(told)


def _replace(path: Path, text: str) -> None:
    with written_whole(path) as draft:
        draft.write_text(text)
