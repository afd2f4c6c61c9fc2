"""What becomes of the task under each reading of what the paper's PbARL leaves open, one choice changed at a time.

    python -m tests.benchmarks.printed_readings --output docs/results/printed_readings

A scripted user with 200 labels, the list ranked by a network on states and actions, nothing gated. Every filter is
driven through unseen scenarios; changes are against the frozen policy in the same ones. Finished rows are kept in the
work directory: the same command goes on.
"""

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

from app.installed_tasks import catalogue
from tests.benchmarks import result_tables
from worker.analysis.comparison import result_pages
from worker.analysis.comparison.comparison_rows import Row
from worker.analysis.comparison.table_files import to_csv
from worker.analysis.filters.evaluation import success_change
from worker.compute import learning
from worker.domain.scenarios import EVALUATION, RESIDUAL, first_of
from worker.domain.trajectory import Trajectory
from worker.experiments.benchmark_cell import PAPER_USERS, BenchmarkConfig, BenchmarkUser, Cell
from worker.experiments.rollout_cache import RolloutCache
from worker.ml.filters.encoders.pbarl_printed import PrintedConfig
from worker.ml.filters.exported.filter_act import act_of
from worker.ml.filters.fitting.gate import successes
from worker.ml.filters.fitting.printed_filter import fit_printed
from worker.sim.costs import preference_rewards, stakes
from worker.tasks import registry

TITLE = "# PbARL as printed, reading by reading"
LOSSES = ("rec", "pref", "kl", "dyn")


@dataclass(frozen=True)
class Reading:
    """One way to understand the paper."""

    changes: Mapping[str, Any]
    """fields of PrintedConfig"""
    weights: Mapping[str, float]
    """factors on the paper's beta of a loss"""

    def config(self, task: str, steps: int) -> PrintedConfig:
        """For a task."""
        betas = registry.task(task).printed_betas
        rec, pref, kl, dyn = (beta * self.weights.get(loss, 1.0) for loss, beta in zip(LOSSES, betas, strict=True))
        return replace(PrintedConfig(betas=(rec, pref, kl, dyn), steps=steps), **self.changes)


NEAR = {"epsilon": 0.01}
APART = {"dynamics_to_encoder": False}
READINGS = {
    "as the text reads": Reading({}, {}),
    "the re-ranked list is a constant": Reading({"stop_gradient": True}, {}),
    "L_dyn on states x 0.1": Reading({"dynamics_scale": 0.1}, {}),
    "L_dyn does not reach the encoder": Reading(APART, {}),
    "eps = 0.01": Reading(NEAR, {}),
    "eps = 0.01, L_dyn apart": Reading(NEAR | APART, {}),
    "eps = 0.01, L_dyn apart, KL x 0.01": Reading(NEAR | APART, {"kl": 0.01}),
    "eps = 0.01, L_dyn apart, KL x 0.01, without L_pref": Reading(NEAR | APART, {"kl": 0.01, "pref": 0.0}),
}


def main() -> None:
    """Measure what was asked for, as far as it is not there yet."""
    options = _options()
    torch.set_num_threads(1)
    options.work_directory.mkdir(parents=True, exist_ok=True)
    journal = options.work_directory / "printed_readings.jsonl"
    stored = [json.loads(line) for line in journal.read_text().splitlines()] if journal.exists() else []
    wanted = [(task, name) for task in options.tasks for name in READINGS]
    known = {(row["task"], row["reading"], row["user"], row["steps"], row["scenarios"]): row for row in stored}
    found = []
    for task, name in tqdm(wanted, unit="reading"):
        key = (task, name, options.user, options.steps, options.scenarios)
        if key not in known:
            known[key] = _measured(task, name, options)
            with journal.open("a") as stream:
                stream.write(json.dumps(known[key]) + "\n")
        found.append(known[key])
    rows = [_row(each) for each in found]
    sys.stdout.write(tables(rows) + "\n")
    if options.output:
        page = options.output.with_suffix(".md")
        page.write_text(result_pages.page(page, TITLE, tables(rows)))
        options.output.with_suffix(".csv").write_text(to_csv(rows))


def _measured(task: str, name: str, options: argparse.Namespace) -> dict[str, Any]:
    rollout_cache = RolloutCache(task, options.work_directory / "rollouts")
    cell = Cell(task, PAPER_USERS[options.user], "pbarl_printed", 0)
    bench = BenchmarkUser(cell, BenchmarkConfig(), rollout_cache, options.work_directory)
    setting = bench.setting()
    problem = replace(setting.problem, reward=setting.action_reward())
    config = READINGS[name].config(task, options.steps)
    draft = fit_printed(problem, rollout_cache.reference(first_of(RESIDUAL, setting.config.printed_rollouts)), config)
    act = act_of(problem.task.modes, problem.policy, draft.weights)
    scenarios = first_of(EVALUATION, options.scenarios)
    before, after = rollout_cache.reference(scenarios), learning.run_scenarios(task, act, scenarios, 0.0, 0)
    success = success_change(successes(before), successes(after))
    return {
        "task": task,
        "reading": name,
        "user": options.user,
        "steps": options.steps,
        "scenarios": options.scenarios,
        "config": asdict(config),
        "success": float(successes(after).mean()),
        "success_delta": [success[name] for name in ("delta", "low", "high")],
        "true_change": _true_change(bench, before, after),
        "moved": float(np.mean([np.abs(each.actions - each.reference_actions).mean() for each in after])),
        "losses": draft.notes[-1],
    }


def _true_change(bench: BenchmarkUser, before: Sequence[Trajectory], after: Sequence[Trajectory]) -> float:
    """Of r^H, as a share of what the user minds and likes under the frozen policy."""
    task, omega = bench.task, bench.cell.taste.omega
    unit = np.mean([stakes(task, each.costs, each.signals, omega).sum() for each in before])
    was, is_now = (
        np.mean([preference_rewards(task, each.costs, each.signals, omega).sum() for each in driven])
        for driven in (before, after)
    )
    return float((is_now - was) / unit)


def _row(measured: dict[str, Any]) -> Row:
    """A line of printed_readings.csv; success and changes are shares."""
    named = {name: measured[name] for name in ("task", "reading", "user", "steps", "scenarios", "success")}
    delta, low, high = measured["success_delta"]
    changes = {"success_delta": delta, "success_delta_low": low, "success_delta_high": high}
    losses = measured["losses"].removeprefix("Last losses: ").rstrip(".")
    more = {"true_change": measured["true_change"], "moved": measured["moved"], "last_losses": losses}
    return named | changes | more


def tables(rows: Sequence[Row]) -> str:
    """The page's table."""
    lines = [
        "| task | reading | success, % | change, points | true r^H, % | moved |",
        "|---|---|---|---|---|---|",
    ]
    for row in rows:
        delta, low, high = (100 * float(row[f"success_delta{end}"]) for end in ("", "_low", "_high"))
        lines.append(
            f"| {row['task']} | {row['reading']} | {100 * float(row['success']):.1f} |"
            f" {delta:+.1f} [{low:+.1f}, {high:+.1f}] | {100 * float(row['true_change']):+.0f} |"
            f" {float(row['moved']):.3f} |"
        )
    return "\n".join(lines)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", choices=catalogue.names(), default=catalogue.names())
    parser.add_argument("--user", choices=PAPER_USERS, default="neutral")
    parser.add_argument("--steps", type=int, default=3000)
    parser.add_argument("--scenarios", type=int, default=200)
    parser.add_argument("--work-directory", type=Path, default=Path("data/benchmark"))
    parser.add_argument("--output", type=result_tables.stem, help="stem of the .md and the .csv")
    return parser.parse_args()


if __name__ == "__main__":
    main()
