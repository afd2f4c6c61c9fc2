"""What it gains people that archived policies are executed in modes of their own, and what it costs them.

    python -m tests.benchmarks.policies_in_modes

People are those of tests.benchmarks.few_answers. What each truly wants is the reward model, so nothing is learned from
answers and nothing refined: a mode is sought and tried as in a study, then what a refinement would begin as, with the
response surfaces around archived policies and without them. Both are driven through 200 unseen scenarios. Everybody who
is finished is kept in --output: repeat the command to go on.
"""

import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

from app.installed_tasks import catalogue
from tests.benchmarks import answering, result_tables
from tests.benchmarks.few_answers import DRIVEN, FewAnswers, Wish
from tests.benchmarks.few_answers_report import GROUPS
from worker.analysis.comparison import result_pages
from worker.analysis.study.statistics import mean_interval
from worker.compute import learning, simulation
from worker.domain.scenarios import EVALUATION, first_of
from worker.domain.trajectory import Trajectory
from worker.domain.type_aliases import Act, FloatArray
from worker.experiments.rollout_cache import RolloutCache
from worker.ml.filters.exported.filter_act import act_of
from worker.ml.filters.exported.filter_module import FilterWeights
from worker.ml.filters.fitting.filter_draft import FilterDraft
from worker.ml.filters.fitting.filter_problem import FilterConfig, FilterProblem
from worker.ml.filters.fitting.gate import largest_forces, signal_changes, successes
from worker.ml.filters.fitting.mode_search import find_mode
from worker.ml.filters.fitting.pool import Pool
from worker.ml.reinforcement.archived_policy import ArchivedPolicy, best_archived
from worker.ml.reinforcement.refinement_gate import begin_as
from worker.ml.rewards.reward_models import StructuredReward
from worker.tasks import registry

TITLE = "# Archived policies in modes of people's own"
Row = dict[str, Any]


def main() -> None:
    """See the module."""
    told = answering.parser(__doc__, "policies_in_modes", seeds=0)
    told.add_argument("--people", type=int, default=12, help="drawn, and as many outside")
    told.add_argument("--tasks", nargs="*", choices=catalogue.names(), default=list(catalogue.names()))
    options = told.parse_args()
    torch.set_num_threads(1)
    table, page = options.output.with_suffix(".csv"), options.output.with_suffix(".md")
    rows: list[Row] = [dict(row) for row in result_tables.read(table)]
    done = {(row["task"], row["user"]) for row in rows}
    for name in options.tasks:
        if not simulation.archived_policies(name):
            continue
        bench = InModes(name, options.pools, options.people)
        people = [(group, user) for group, tastes in bench.people.tastes.items() for user in tastes]
        for group, user in tqdm(people, unit="person", mininterval=5, desc=name):
            if (name, user) not in done:
                rows.append(bench.row(group, user))
                result_tables.write(table, rows)
    page.write_text(result_pages.page(page, TITLE, tables(rows)))


class InModes:
    """One task, its people, and what each would begin as."""

    def __init__(self, task: str, directory: Path, people: int) -> None:
        self.task, self.people = task, FewAnswers(task, directory, people)
        self.unseen, cached = first_of(EVALUATION, DRIVEN), RolloutCache(task, directory / "rollouts")
        gate = FilterConfig().gate_block(registry.task(task))
        self.reference, self.gate_reference = cached.reference(self.unseen), cached.reference(gate)
        self.archived = cached.archived(gate)
        self.drives = 0

    def row(self, group: str, user: str) -> Row:
        """What somebody gains by either beginning, in scenarios that were not tried."""
        wish = self.people.wish(self.people.tastes[group][user])
        reward = StructuredReward(wish.weights[None])
        problem = FilterProblem(registry.task(self.task), simulation.reference_policy(self.task), reward, 0)
        mode = find_mode(problem, self.people.surface, Pool(), self.gate_reference, self._collect)
        alone = [replace(each, around=None) for each in self.archived]
        start = self._begun_as(problem, mode, alone)
        self.drives, began = 0, time.perf_counter()
        in_mode = self._begun_as(problem, mode, self.archived)
        took, drives = time.perf_counter() - began, self.drives
        is_same = not in_mode.weights.refined_mode  # else both begin as the best of the same
        before = self._driven(start.weights, wish)
        after = before if is_same else self._driven(in_mode.weights, wish)
        return {
            "task": self.task,
            "group": group,
            "user": user,
            **{f"{key}_alone": value for key, value in before.items()},
            **{f"{key}_in_modes": value for key, value in after.items()},
            "changed": int(not is_same),
            "mode": " ".join(f"{key}={value:.3f}" for key, value in in_mode.weights.refined_mode.items()),
            "drives": drives,
            "seconds": round(took, 1),
        }

    def _begun_as(self, problem: FilterProblem, mode: FilterDraft, archived: Sequence[ArchivedPolicy]) -> FilterDraft:
        best = best_archived(problem, mode, archived, [], self.gate_reference, self._collect)
        return begin_as(mode, best).draft

    def _driven(self, weights: FilterWeights, wish: Wish) -> Row:
        act = act_of(registry.task(self.task).modes, simulation.reference_policy(self.task), weights)
        driven = self._collect(act, self.unseen, 0.0, 0)
        succeeded = successes(driven) - successes(self.reference)
        pressed = largest_forces(driven) - largest_forces(self.reference) > FilterConfig.pressed_n
        return {
            "gain_percent": round(wish.worth(signal_changes(self.reference, driven).mean(axis=0)), 3),
            "success_points": round(100 * float(succeeded.mean()), 2),
            "pressed_percent": round(100 * float(pressed.mean()), 2),
        }

    def _collect(self, act: Act, scenarios: Sequence[int], noise: float, seed: int) -> list[Trajectory]:
        self.drives += 1
        return learning.run_scenarios(self.task, act, scenarios, noise, seed)


def tables(rows: Sequence[Row]) -> str:
    """All below the mark."""
    return "\n".join([*_HEAD, *_lines(rows)])


_HEAD = (
    "## What they gain",
    "",
    f"Gain of true preference in {DRIVEN} unseen scenarios, in % of the stake: the mean with its 95 % interval over",
    "people (Student's t), of what a refinement would begin as. *Lost*: the lowest success beside the reference",
    f"policy's in points, and the largest share of scenarios in which somebody is pressed {FilterConfig.pressed_n:g} N",
    "harder. *Drives*: through the gate's scenarios, which somebody waits for.",
    "",
    "| task | people | without modes | in modes | difference | changed for | lost without | lost in modes | drives |",
    "|---|---|---|---|---|---|---|---|---|",
)


def _lines(rows: Sequence[Row]) -> Iterator[str]:
    names, groups = list(catalogue.names()), list(GROUPS)
    in_order = sorted(rows, key=lambda row: (names.index(row["task"]), groups.index(row["group"])))
    for (task, group), grouped in groupby(in_order, lambda row: (row["task"], row["group"])):
        some = list(grouped)
        alone, in_modes = _column(some, "gain_percent_alone"), _column(some, "gain_percent_in_modes")
        yield (
            f"| {task} | {group}, {len(some)} | {_mean(alone)} | {_mean(in_modes)} | {_mean(in_modes - alone)} "
            f"| {_column(some, 'changed').sum():.0f} | {_lost(some, 'alone')} | {_lost(some, 'in_modes')} "
            f"| {_column(some, 'drives').mean():.1f} |"
        )


def _column(rows: Sequence[Row], name: str) -> FloatArray:
    return np.array([float(row[name]) for row in rows])


def _lost(rows: Sequence[Row], which: str) -> str:
    success, pressed = _column(rows, f"success_points_{which}"), _column(rows, f"pressed_percent_{which}")
    return f"{success.min():+.1f}, {pressed.max():.1f} %"


def _mean(gains: FloatArray) -> str:
    low, high = mean_interval(gains)
    interval = "" if low is None else f" [{low:+.1f}, {high:+.1f}]"
    return f"{gains.mean():+.1f}{interval}"


if __name__ == "__main__":
    main()
