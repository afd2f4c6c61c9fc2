"""Is the promise about harm kept, and what do promise and shield cost? Filters of random people in fresh scenarios.

    python -m tests.benchmarks.promises --output docs/results/promises

Per task and person: 200 answers, a filter as a worker makes the third of a study of as many (strengths tested until
the promise is earned), then drives of it and of the same filter without shield and promise, beside the reference
policy, through scenarios that nothing else uses. On one core; every hundred scenarios a row is added to the table and
the page is written anew. Interrupted, it goes on where it was; other --people and --scenarios add to what is there.
"""

import argparse
import os
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

from app.domain.study_settings import PAPER_PROTOCOL
from app.installed_tasks import catalogue
from tests.benchmarks import result_tables
from tests.worker.at_hand import AtHand
from worker.analysis.comparison import result_pages
from worker.analysis.filters.promise import HARMS, Promise, harms, outcome_of
from worker.compute import learning, simulation
from worker.compute.filter_fitting import FilterFit
from worker.domain.scenarios import PROMISE_TEST, first_of
from worker.domain.trajectory import Trajectory
from worker.domain.type_aliases import FloatArray
from worker.experiments.benchmark_cell import BenchmarkConfig, BenchmarkUser, Cell
from worker.experiments.rollout_cache import RolloutCache
from worker.ml.filters.exported import filter_act
from worker.ml.filters.exported.filter_module import FilterWeights
from worker.ml.filters.fitting.filter_draft import FilterDraft
from worker.ml.filters.fitting.filter_problem import FilterConfig
from worker.ml.teachers import random_taste
from worker.whole_files import written_whole

TITLE = "# Is the promise about harm kept?"
GOAL = (200, 2000)
"""People of all tasks together, and scenarios each."""
BATCH = 100
SEED = 19
VARIANTS = ("bare", "shielded", "promised")
Row = Mapping[str, Any]


def main() -> None:
    """Measure what is missing, person by person."""
    options = _options()
    torch.set_num_threads(1)
    table = options.output.with_suffix(".csv")
    rows: list[Row] = list(result_tables.read(table))
    for number in tqdm(range(options.people), unit="person"):
        for task in options.tasks:
            done = [row for row in rows if (row["task"], int(row["person"])) == (task, number)]
            if sum(int(row["scenarios"]) for row in done if row["variant"] == "promised") >= options.scenarios:
                continue
            for row in _measured(task, number, done, options):
                rows.append({name: str(value) for name, value in row.items()})
                _write(rows, options)
    _write(rows, options)


def _measured(task: str, number: int, done: Sequence[Row], options: argparse.Namespace) -> Iterator[Row]:
    taste = random_taste(f"person-{number}", np.random.default_rng([number, SEED]))
    work = options.work_directory
    bench = BenchmarkUser(
        Cell(task, taste, "pbarl", number), BenchmarkConfig(), RolloutCache(task, work / "rollouts"), work
    )
    draft = _draft(task, number, bench, work / "promises" / f"{task}-{number}.npz")
    variants = _variants(draft)
    for first in range(0, options.scenarios, BATCH):
        scenarios = first_of(PROMISE_TEST, BATCH, skip=first)
        missing = [name for name in variants if (name, str(first)) not in {(r["variant"], r["first"]) for r in done}]
        reference = bench.rollout_cache.reference(scenarios) if missing else []
        for name in missing:
            act = filter_act.act_of(bench.task.modes, simulation.reference_policy(task), variants[name])
            same = variants[name].moves_nothing
            driven = reference if same else learning.run_scenarios(task, act, scenarios, 0.0, 0)
            yield _row(bench, number, name, first, draft, reference, driven)


def _draft(task: str, number: int, bench: BenchmarkUser, kept: Path) -> FilterDraft:
    """The finished filter, as a study's worker makes it; fitted once."""
    if kept.exists():
        return FilterDraft.from_bytes(kept.read_bytes())
    fit = FilterFit(
        task=task,
        compute=AtHand(),
        beat=lambda: None,
        reward=bench.reward.to_bytes(),
        seed=number,
        config=FilterConfig(),
        progress=lambda stage, share: None,
        references=_references(task),
        study_seed=number,
        version=len(PAPER_PROTOCOL.milestones),
    )
    for ahead in (fit._gate_reference, fit._check_reference):
        ahead()  # as a worker does while people answer
    fit._home_reference(fit.progress)
    fit._archived(fit.progress)
    started = time.process_time()
    pool = bench.setting().pool
    draft = fit.gate_residual(fit.train_residual(fit.find_mode(pool)))
    draft = fit.choose_archived(draft, pool)
    fitted = time.process_time()
    bare = draft.weights
    draft = fit.keep_promise(draft)
    seconds = {"fit_cpu": fitted - started, "promise_cpu": time.process_time() - fitted}
    draft = replace(draft, weights=bare.changed(shield=draft.tested), seconds=seconds)
    kept.parent.mkdir(parents=True, exist_ok=True)
    with written_whole(kept) as path:
        path.write_bytes(draft.to_bytes())
    return FilterDraft.from_bytes(kept.read_bytes())


@cache
def _references(task: str) -> dict[tuple[str, range], list[Trajectory]]:
    """What is the same for everybody."""
    return {}


def _variants(draft: FilterDraft) -> dict[str, FilterWeights]:
    """The filter without shield, with it, and at the strength of which the promise could be made."""
    whole, strength = draft.weights, _strength(draft)
    weakened = whole.changed(gate=whole.gate * strength) if strength else FilterWeights(gate=0.0)
    found = {"bare": whole.changed(shield={}), "shielded": whole, "promised": weakened}
    return {name: weights for name, weights in found.items() if name != "shielded" or strength < 1.0}


def _strength(draft: FilterDraft) -> float:
    tests = draft.promise["tests"]
    if not tests:
        return 1.0
    return float(tests[-1]["strength"]) if tests[-1]["earned"] else 0.0


def _row(
    bench: BenchmarkUser,
    number: int,
    variant: str,
    first: int,
    draft: FilterDraft,
    reference: Sequence[Trajectory],
    driven: Sequence[Trajectory],
) -> Row:
    before, after = ([outcome_of(each, bench.task) for each in some] for some in (reference, driven))
    found = [harms(Promise(), *pair) for pair in zip(before, after, strict=True)]
    true = [np.array([bench._true_rewards(each).sum() for each in some]) for some in (reference, driven)]
    returns: list[FloatArray] = [bench.reward.returns(some) for some in (reference, driven)]
    return {
        "task": bench.task.name,
        "person": number,
        "variant": variant,
        "strength": _strength(draft) if variant == "promised" else 1.0,
        "tested": sum(test["scenarios"] for test in draft.promise["tests"]),
        "fit_cpu_s": round(draft.seconds["fit_cpu"], 1),
        "promise_cpu_s": round(draft.seconds["promise_cpu"], 1),
        "first": first,
        "scenarios": len(driven),
        "harmed": sum(bool(each) for each in found),
        **{name: sum(name in each for each in found) for name in HARMS},
        "worst_force_n": round(max(each.largest_force_n for each in after), 2),
        "worst_force_reference_n": round(max(each.largest_force_n for each in before), 2),
        "most_spilled": round(max(each.spilled for each in after), 3),
        "most_spilled_reference": round(max(each.spilled for each in before), 3),
        "successes": sum(each.success for each in after),
        "successes_reference": sum(each.success for each in before),
        "true_preference": round(float(true[1].mean()), 5),
        "true_preference_reference": round(float(true[0].mean()), 5),
        "learned_gain_sd": round(float((returns[1] - returns[0]).mean() / max(returns[0].std(), 1e-9)), 4),
    }


def _write(rows: Sequence[Row], options: argparse.Namespace) -> None:
    if not rows:
        return
    result_tables.write(options.output.with_suffix(".csv"), rows)
    page = options.output.with_suffix(".md")
    page.write_text(result_pages.page(page, TITLE, _tables(rows)))


def _tables(rows: Sequence[Row]) -> str:
    people = sorted({(row["task"], int(row["person"])) for row in rows})
    drives = sum(int(row["scenarios"]) for row in rows if row["variant"] == "promised")
    lines = [
        f"{len(people)} of {GOAL[0]} filters and {drives} of {GOAL[0] * GOAL[1]} scenarios of promised filters so far.",
        "",
        "| task | variant | filters | scenarios | harmed | filters harming more than promised | force | spills |"
        " failure | worst force, N | of the reference | most spilled | of the reference | success | of the reference |"
        " true gain | learned gain, sd |",
        "|---" * 17 + "|",
    ]
    for task in sorted({task for task, _ in people}):
        lines += [_summary(task, name, rows) for name in VARIANTS]
    lines += ["", *_filters(rows, people)]
    return "\n".join(lines) + "\n"


def _summary(task: str, variant: str, rows: Sequence[Row]) -> str:
    """``shielded``: of filters that kept their strength the promised one is the shielded one."""
    names = (variant, "promised") if variant == "shielded" else (variant,)
    of_task = [row for row in rows if row["task"] == task and row["variant"] in names]
    weakened = {row["person"] for row in of_task if row["variant"] == "shielded"}
    some = [row for row in of_task if row["variant"] == variant or row["person"] not in weakened]
    if not some:
        return f"| {task} | {variant} | 0 " + "| - " * 14 + "|"
    total = {name: sum(float(row[name]) for row in some) for name in ("scenarios", "harmed", *HARMS)}
    worst = {
        name: max(float(row[name]) for row in some)
        for name in ("worst_force_n", "worst_force_reference_n", "most_spilled", "most_spilled_reference")
    }
    successes = (sum(int(row[name]) for row in some) for name in ("successes", "successes_reference"))
    success, of_reference = (each / total["scenarios"] for each in successes)
    persons = sorted({row["person"] for row in some})
    broken = sum(_harmed_share([row for row in some if row["person"] == each]) > Promise().share for each in persons)
    counts = " | ".join(f"{total[name]:.0f}" for name in HARMS)
    return (
        f"| {task} | {variant} | {len(persons)} | {total['scenarios']:.0f} | {total['harmed'] / total['scenarios']:.1%}"
        f" | {broken} | {counts} | {worst['worst_force_n']:.1f} | {worst['worst_force_reference_n']:.1f}"
        f" | {worst['most_spilled']:.2f} | {worst['most_spilled_reference']:.2f} | {success:.1%}"
        f" | {of_reference:.1%} | {_true_gain(some):+.1f} % | {_mean(some, 'learned_gain_sd'):+.2f} |"
    )


def _harmed_share(rows: Sequence[Row]) -> float:
    return sum(int(row["harmed"]) for row in rows) / sum(int(row["scenarios"]) for row in rows)


def _mean(rows: Sequence[Row], name: str) -> float:
    return float(np.mean([float(row[name]) for row in rows]))


def _true_gain(rows: Sequence[Row]) -> float:
    """Mean over people of the change of r^H, in percent of the reference policy's size."""
    gains = []
    for person in {row["person"] for row in rows}:
        theirs = [row for row in rows if row["person"] == person]
        before, after = _mean(theirs, "true_preference_reference"), _mean(theirs, "true_preference")
        gains.append(100 * (after - before) / abs(before))
    return float(np.mean(gains))


def _filters(rows: Sequence[Row], people: Sequence[tuple[str, int]]) -> list[str]:
    promised = [row for row in rows if row["variant"] == "promised" and int(row["first"]) == 0]
    lines = [
        "| task | filters | whole | weakened | reference policy | scenarios tested, mean | fit, s of one core |"
        " promise, s of one core |",
        "|---" * 8 + "|",
    ]
    for task in sorted({task for task, _ in people}):
        some = [row for row in promised if row["task"] == task]
        if not some:
            continue
        strengths = [float(row["strength"]) for row in some]
        kinds = (sum(each == 1 for each in strengths), sum(0 < each < 1 for each in strengths), strengths.count(0.0))
        costs = " | ".join(f"{_mean(some, name):.0f}" for name in ("tested", "fit_cpu_s", "promise_cpu_s"))
        lines.append(f"| {task} | {len(some)} | {kinds[0]} | {kinds[1]} | {kinds[2]} | {costs} |")
    return lines


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", choices=catalogue.names(), default=catalogue.names())
    parser.add_argument("--people", type=int, default=67, help="per task")
    parser.add_argument("--scenarios", type=int, default=GOAL[1], help="per filter, in whole hundreds")
    parser.add_argument(
        "--work-directory", type=Path, default=Path("data/benchmark"), help="of rollouts and finished filters"
    )
    parser.add_argument(
        "--output", type=result_tables.stem, required=True, help="path without ending of the page and the table"
    )
    return parser.parse_args()


if __name__ == "__main__":
    os.nice(19 - os.nice(0))
    main()
