"""Methods against each other: the rows of the paper's Table I and of the personalisation matrix, with intervals.

Every difference is to the reference policy in the same scenarios. Every seed has labels, trainings and scenarios of its
own, and where there are several all their episodes count alike. Intervals are 95 %, over scenarios only.
Success and its changes are shares (0.05 is five points), preference is the learned return, true preference the return
of r^H. Gains are changes of it as shares of what the judge minds and likes in the reference policy's episodes, taken
positively: for whoever only minds things, of the reference policy's own true return.
"""

from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from worker.analysis.filters.evaluation import mean_change, success_change
from worker.analysis.wilson import wilson_interval
from worker.domain.trajectory import COSTS
from worker.domain.type_aliases import FloatArray

Row = dict[str, Any]

REFERENCE = "reference"


@dataclass(frozen=True)
class EvaluatedCell:
    """One method fitted for one user with one seed, in N unseen scenarios."""

    task: str
    user: str
    method: str
    seed: int
    labels: int
    """that the user's reward model was trained on"""
    success: FloatArray
    """(N,) 0 or 1"""
    preference: FloatArray
    """(N,) returns of the user's learned reward"""
    true_returns: Mapping[str, FloatArray]
    """by user: (N,) returns of r^H, the true preference"""
    stakes: Mapping[str, FloatArray]
    """by user: (N,) what they mind and like in these episodes, taken positively (worker.sim.costs.stakes)"""
    costs: FloatArray
    """(N, 6) summed over the episode"""
    spent: Mapping[str, float]
    """labels, environment_steps, cpu_s and wall_s of this method"""
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Pooled:
    """The runs of one method for one user beside the reference policy's, seed by seed in ascending order."""

    runs: tuple[EvaluatedCell, ...]
    references: tuple[EvaluatedCell, ...]

    @property
    def seeds(self) -> set[int]:
        """Of labels, trainings and scenarios."""
        return {run.seed for run in self.runs}

    def of(self, seeds: Collection[int]) -> "Pooled":
        """The runs with these seeds only."""
        runs, references = (
            tuple(run for run in all_runs if run.seed in seeds) for all_runs in (self.runs, self.references)
        )
        return Pooled(runs, references)

    def both(self, what: str) -> tuple[FloatArray, FloatArray]:
        """The reference policy's and the method's values per episode, (seeds N,) or (seeds N, 6) each."""
        before, after = (np.concatenate([getattr(run, what) for run in runs]) for runs in (self.references, self.runs))
        return before, after

    def true_of(self, judge: str) -> tuple[FloatArray, FloatArray]:
        """The same for the true returns of somebody."""
        before, after = (
            np.concatenate([run.true_returns[judge] for run in runs]) for runs in (self.references, self.runs)
        )
        return before, after

    def stake_of(self, judge: str) -> float:
        """What somebody minds and likes in the reference policy's episodes, in the mean."""
        return float(np.mean([run.stakes[judge] for run in self.references]))


Cells = dict[tuple[str, str, str], Pooled]
"""by task, user and method, in the order in which they came"""


def pooled(runs: Iterable[EvaluatedCell]) -> Cells:
    """Cells that have a reference run for at least one of their seeds."""
    by_name: dict[tuple[str, str, str], dict[int, EvaluatedCell]] = {}
    for run in runs:
        by_name.setdefault((run.task, run.user, run.method), {})[run.seed] = run
    cells = {}
    for (task, user, method), seeds in by_name.items():
        references = by_name.get((task, user, REFERENCE), {})
        shared = sorted(set(seeds) & set(references))
        if shared:
            cells[task, user, method] = Pooled(
                tuple(seeds[seed] for seed in shared), tuple(references[seed] for seed in shared)
            )
    return cells


def one_by_one(cells: Cells) -> dict[int, Cells]:
    """The same for each seed alone."""
    seeds = sorted(set[int]().union(*(cell.seeds for cell in cells.values())))
    return {seed: {name: cell.of({seed}) for name, cell in cells.items() if seed in cell.seeds} for seed in seeds}


def table_rows(cells: Cells) -> list[Row]:
    """The columns of docs/results/all_methods/table1.csv."""
    return [_table_row(task, user, method, cell) for (task, user, method), cell in cells.items()]


def _table_row(task: str, user: str, method: str, cell: Pooled) -> Row:
    before, after = cell.both("success")
    row: Row = {"task": task, "user": user, "method": method, "labels": cell.runs[0].labels}
    row |= {"seeds": len(cell.runs), "scenarios": len(cell.runs[0].success)}
    low, high = wilson_interval(float(after.sum()), len(after))
    row |= _named("success", float(after.mean()), low, high)
    change = success_change(before, after)
    if method == REFERENCE:  # the very same rollouts: there is nothing to be unsure about
        change |= {"low": 0.0, "high": 0.0}
    row |= _named("success_delta", change["delta"], change["low"], change["high"])
    for name, (was, now) in (("preference", cell.both("preference")), ("true_preference", cell.true_of(user))):
        level, change = mean_change(np.zeros(len(now)), now), mean_change(was, now)
        row |= _named(name, level["delta"], level["low"], level["high"])
        row |= _named(f"{name}_delta", change["delta"], change["low"], change["high"])
    return row


def cost_rows(cells: Cells) -> list[Row]:
    """The six costs, summed over an episode, and their change."""
    rows = []
    for (task, user, method), cell in cells.items():
        row: Row = {"task": task, "user": user, "method": method}
        before, after = cell.both("costs")
        for column, name in enumerate(COSTS):
            change = mean_change(before[:, column], after[:, column])
            row[name] = change["filter"]
            row |= _named(f"{name}_delta", change["delta"], change["low"], change["high"])
        rows.append(row)
    return rows


def spent_rows(cells: Cells) -> list[Row]:
    """Labels, environment steps and seconds per task and method, means over users and seeds."""
    groups: dict[tuple[str, str], list[Mapping[str, float]]] = {}
    for (task, _, method), cell in cells.items():
        groups.setdefault((task, method), []).extend(run.spent for run in cell.runs)
    return [
        {"task": task, "method": method, "fits": len(spent)}
        | {name: float(np.mean([each[name] for each in spent])) for name in spent[0]}
        for (task, method), spent in groups.items()
    ]


def against(cells: Cells, method: str, baseline: str) -> list[Row]:
    """Per task and user: the method's preference minus the baseline's, learned and true, paired by scenario.

    Seeds that only one of them has been run with are left out.
    """
    rows = []
    for task, user, name in cells:
        if name != method or (task, user, baseline) not in cells:
            continue
        mine, other = cells[task, user, method], cells[task, user, baseline]
        shared = mine.seeds & other.seeds
        if not shared:
            continue
        mine, other = mine.of(shared), other.of(shared)
        row: Row = {"task": task, "user": user, "baseline": baseline}
        change = mean_change(other.both("preference")[1], mine.both("preference")[1])
        row |= _named("preference", change["delta"], change["low"], change["high"])
        change = mean_change(other.true_of(user)[1], mine.true_of(user)[1])
        row |= _named("true_preference", change["delta"], change["low"], change["high"])
        change = success_change(other.both("success")[1], mine.both("success")[1])
        rows.append(row | _named("success", change["delta"], change["low"], change["high"]))
    return rows


def personalisation_rows(cells: Cells, method: str, groups: Sequence[Sequence[str]]) -> list[Row]:
    """The columns of docs/results/all_methods/personalisation.csv: whose filter serves whom.

    ``groups``: users who are compared with each other. A user's own advantage is over the best filter of somebody else
    in the group, chosen on the very same scenarios, which favours the others, and in the seeds that all of them have.
    """
    rows = []
    for task in dict.fromkeys(task for task, _, _ in cells):
        of_task = {user: cell for (where, user, name), cell in cells.items() if (where, name) == (task, method)}
        for trained_for, cell in of_task.items():
            for judge in of_task:
                others = [of_task[user] for group in groups if judge in group for user in group if user in of_task]
                rows.append(_matrix_row(task, trained_for, judge, cell, [each for each in others if each is not cell]))
    return rows


def _matrix_row(task: str, trained_for: str, judge: str, cell: Pooled, others: Sequence[Pooled]) -> Row:
    before, after = cell.true_of(judge)
    unit = max(cell.stake_of(judge), 1e-9)
    gain = mean_change(before / unit, after / unit)
    row: Row = {"task": task, "trained_for": trained_for, "judged_by": judge, "labels": cell.runs[0].labels}
    row |= _named("gain", gain["delta"], gain["low"], gain["high"])
    row["success_delta"] = success_change(*cell.both("success"))["delta"]
    row |= dict.fromkeys(_names("own_advantage"), "")
    shared = cell.seeds.intersection(*(each.seeds for each in others))
    if trained_for == judge and others and shared:
        best = max((each.of(shared).true_of(judge)[1] for each in others), key=lambda returns: float(returns.mean()))
        advantage = mean_change(best / unit, cell.of(shared).true_of(judge)[1] / unit)
        row |= _named("own_advantage", advantage["delta"], advantage["low"], advantage["high"])
    return row


def seed_rows(cells: Cells, method: str, groups: Sequence[Sequence[str]]) -> list[Row]:
    """The diagonal of the personalisation matrix for each seed alone: other labels, trainings and scenarios."""
    kept = (*_names("gain"), *_names("own_advantage"), "success_delta")
    return [
        {"task": row["task"], "user": row["trained_for"], "seed": seed} | {name: row[name] for name in kept}
        for seed, of_seed in one_by_one(cells).items()
        for row in personalisation_rows(of_seed, method, groups)
        if row["trained_for"] == row["judged_by"]
    ]


def fit_rows(cells: Cells) -> list[Row]:
    """What every fit says about itself."""
    return [
        {"task": task, "user": user, "method": method, "seed": run.seed, "notes": " ".join(run.notes)}
        for (task, user, method), cell in cells.items()
        for run in cell.runs
        if run.notes
    ]


def compared(rows: Sequence[Row]) -> Sequence[Row]:
    """The rows of those users of a task for whom several methods were run; all when there is no such user.

    A single method beside the reference policy compares nothing.
    """
    counts = Counter((row["task"], row["user"]) for row in rows)
    return [row for row in rows if counts[row["task"], row["user"]] > 2] or rows


def _named(name: str, value: float, low: float, high: float) -> Row:
    return dict(zip(_names(name), (value, low, high), strict=True))


def _names(name: str) -> tuple[str, str, str]:
    return name, f"{name}_low", f"{name}_high"
