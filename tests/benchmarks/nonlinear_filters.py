"""What filters give people who are not linear, how many are noticed, and whose filter serves whom.

    python -m tests.benchmarks.nonlinear_filters

First, in minutes: in how many people of each kind something richer explains the answers so well that the reward model
follows it, and what is foreseen of their wishes by that (tests/benchmarks/doubt.py). Then per task and person of
tests/benchmarks/nonlinear_people.py, the paper's three types among them: 200 answers, the reward model of a study, the
filter of mode and residual and, where policies were refined beforehand, the default's, driven through unseen scenarios
beside the reference policy and judged by what everybody truly wants. On one core at the lowest priority; what has a row
is never run again.
"""

import argparse
import os
from collections.abc import Mapping, Sequence
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

from app.services.answers.accuracy import ENOUGH_EVIDENCE
from tests.benchmarks import doubt, result_tables
from tests.benchmarks.answered_pool import Answered, AnsweredPool
from tests.benchmarks.doubt import ANSWERS
from tests.benchmarks.nonlinear_people import EVERYBODY, ON_TIME_S, Person
from tests.benchmarks.rivals_report import gains_of, gains_text, successes_of, successes_text
from worker.analysis.comparison import result_pages
from worker.compute import learning, simulation
from worker.domain.scenarios import EVALUATION, first_of
from worker.domain.task import Task
from worker.domain.trajectory import Trajectory
from worker.domain.type_aliases import FloatArray
from worker.experiments.benchmark_person import BenchmarkPerson
from worker.experiments.rollout_cache import RolloutCache
from worker.ml.filters.fitting.filter_problem import FilterProblem
from worker.ml.filters.fitting.response_surface import ResponseSurface
from worker.ml.methods import registry as methods
from worker.ml.methods.people import Labels
from worker.ml.methods.registry import Setting
from worker.ml.rewards.beyond_sums import misfit
from worker.ml.teachers import TASTES
from worker.tasks import registry

TITLE = "# What filters give people who are not linear"
METHODS = SEARCHED, ARCHIVED = "pbarl", "pbarl_archived"
Row = Mapping[str, Any]
Name = tuple[int, str, str, str]
"""seed, task, person, method"""


def main() -> None:
    """Fit and drive what has no row."""
    options = _options()
    os.nice(19 - os.nice(0))
    torch.set_num_threads(1)
    table = options.output.with_suffix(".csv")
    rows = _rows(table)
    planned = [
        (seed, task, person, method)
        for seed, task, person, method in product(range(options.seeds), options.tasks, options.people, options.methods)
        if method == SEARCHED or simulation.archived_policies(task)
    ]
    missing = [each for each in planned if each not in {_name_of(row) for row in rows}]
    counted = options.output.with_name(f"{options.output.name}_doubt.csv")
    for task in options.tasks:
        bench = Bench(task, options.work_directory / "rollouts")
        if not _rows(counted, task):
            _append(counted, doubt.counted(bench.pool, doubt.kinds(options.linear, options.of_a_kind)))
        for seed, _, name, method in tqdm([each for each in missing if each[1] == task], unit="filter"):
            _append(table, [bench.row(EVERYBODY[name], seed, method, options.scenarios)])
            _report(options.output, counted)
    _report(options.output, counted)


class Bench:
    """One task, its pool and its reference policy's rollouts."""

    def __init__(self, task: str, rollouts: Path) -> None:
        self.pool = AnsweredPool(task, rollouts)
        self.cache = RolloutCache(task, rollouts)

    def row(self, person: Person, seed: int, method: str, scenarios: int) -> Row:
        """Answer, learn, fit, drive, judge."""
        task = self.pool.task
        answered = self.pool.answered(person, ANSWERS, seed)
        ratios = self.pool.ratios(answered, ANSWERS)
        fitted = methods.fit(method, self._setting(person, answered, seed))
        unseen = first_of(EVALUATION, scenarios, skip=seed * scenarios)
        reference, driven = self.cache.reference(unseen), learning.run_scenarios(task.name, fitted.act, unseen, 0.0, 0)
        evidence = misfit.evidence(ratios)
        return {
            "seed": seed,
            "task": task.name,
            "person": person.name,
            "method": method,
            "does_not_fit": max(ratios, key=lambda each: ratios[each]) if evidence >= ENOUGH_EVIDENCE else "",
            "cpu_s": round(fitted.cpu_s),
            **{f"gains_{name}": gains_text(_gains(each, task, reference, driven)) for name, each in EVERYBODY.items()},
            "successes": successes_text([each.success for each in driven]),
            "successes_reference": successes_text([each.success for each in reference]),
            "worst_force_n": _worst(driven),
            "worst_force_reference_n": _worst(reference),
            "notes": " ".join(fitted.notes),
        }

    def _setting(self, person: Person, answered: Answered, seed: int) -> Setting:
        pool, task = self.pool, self.pool.task
        labels = Labels(pool.segments.take(answered.rows), answered.answers)
        learn = partial(doubt.learned, pool, seed=seed)
        asked = BenchmarkPerson(
            TASTES["neutral"],  # nobody asks for it: what is wanted is said by the function
            labels,
            pool.scale,
            person.manner,
            pool.clips,
            pool.clip_pairs,
            pool.clip_steps,
            lambda _, episode: person.wishes(task, episode),
            learn,
        )
        reward = learn(labels)
        return Setting(
            problem=FilterProblem(task, simulation.reference_policy(task.name), reward, seed),
            labels=ANSWERS,
            pool=pool.episodes,
            surface=lambda: ResponseSurface.load(simulation.surface_file(task.name), task.modes),
            action_reward=lambda: reward,
            reference=self.cache.reference,
            collect=lambda *drive: learning.run_scenarios(task.name, *drive),
            make_env=registry.environment_class(task.name),
            archived=self.cache.archived,
            person=asked,
        )


def _gains(person: Person, task: Task, reference: Sequence[Trajectory], driven: Sequence[Trajectory]) -> FloatArray:
    """(N,) of what the person truly wants, in shares of its size under the reference policy."""
    before, after = (np.array([person.wishes(task, each).sum() for each in some]) for some in (reference, driven))
    shares: FloatArray = (after - before) / np.abs(before.mean())
    return shares


def _worst(episodes: Sequence[Trajectory]) -> float:
    return round(max(float(each.contact_force_n.max()) for each in episodes), 1)


def _name_of(row: Row) -> Name:
    return int(row["seed"]), row["task"], row["person"], row["method"]


def _rows(table: Path, task: str = "") -> list[Row]:
    return [row for row in result_tables.read(table) if not task or row["task"] == task]


def _append(table: Path, more: Sequence[Row]) -> None:
    rows = [*_rows(table), *more]
    result_tables.write(table, rows)


def _report(output: Path, counted: Path) -> None:
    page = output.with_suffix(".md")
    rows = {_name_of(row): row for row in _rows(output.with_suffix(".csv"))}
    tables = [doubt.table(_rows(counted)), _of_filters(rows), *(who_serves_whom(rows, each) for each in METHODS)]
    page.write_text(result_pages.page(page, TITLE, "\n".join(tables)))


def _of_filters(rows: Mapping[Name, Row]) -> str:
    lines = [
        f"| task | person | seed | model does not fit | `{SEARCHED}`: gain, % | success, points | worst force, N"
        f" | `{ARCHIVED}`: gain, % | success, points | worst force, N | of the reference | gains more, points |",
        "|---" * 12 + "|",
    ]
    for seed, task, person in dict.fromkeys(name[:3] for name in rows):
        searched, archived = (rows.get((seed, task, person, method)) for method in METHODS)
        some = searched or archived
        more = "-" if searched is None or archived is None else _interval(_own(archived) - _own(searched))
        lines.append(
            f"| {task} | {person} | {seed} | {some['does_not_fit'] or '-' if some else '-'} | {_said(searched)}"
            f" | {_said(archived)} | {some['worst_force_reference_n'] if some else '-'} | {more} |"
        )
    return "\n".join(lines) + "\n"


def who_serves_whom(rows: Mapping[Name, Row], method: str) -> str:
    """Everybody's own filter beside the best of the others', which is chosen in hindsight; by the person's wishes."""
    lines = [
        f"| task | seed | person | own gain, `{method}`, % | most by another's | whose | own gains more, points |",
        "|---" * 7 + "|",
    ]
    for seed, task, person, _ in (name for name in rows if name[3] == method):
        column = f"gains_{person}"
        driven = {name[2]: row for name, row in rows.items() if (*name[:2], name[3]) == (seed, task, method)}
        gains = {name: 100 * gains_of(row, column) for name, row in driven.items() if row[column]}
        own = gains.pop(person, None)
        if own is None or not gains:
            continue
        best = max(gains, key=lambda name: float(gains[name].mean()))
        lines.append(
            f"| {task} | {seed} | {person} | {own.mean():+.1f} | {gains[best].mean():+.1f} | {best}"
            f" | {_interval(own - gains[best])} |"
        )
    return "\n".join(lines) + "\n"


def _own(row: Row) -> FloatArray:
    """(N,) in %"""
    return 100 * gains_of(row, f"gains_{row['person']}")


def _said(row: Row | None) -> str:
    if row is None:
        return "- | - | -"
    success = 100 * (successes_of(row) - successes_of(row, "successes_reference")).mean()
    return f"{_interval(_own(row))} | {success:+.1f} | {row['worst_force_n']}"


def _interval(values: FloatArray) -> str:
    """Mean with its 95 % interval over scenarios."""
    mean, half = float(values.mean()), 1.96 * float(values.std(ddof=1)) / np.sqrt(len(values))
    return f"{mean:+.1f} [{mean - half:+.1f}, {mean + half:+.1f}]"


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", choices=[*ON_TIME_S], default=[*ON_TIME_S])
    parser.add_argument("--people", nargs="+", choices=[*EVERYBODY], default=[*EVERYBODY])
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=METHODS)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--scenarios", type=int, default=200)
    parser.add_argument("--of-a-kind", type=int, default=15, help="people whose evidence is counted")
    parser.add_argument("--linear", type=int, default=100, help="linear people whose evidence is counted")
    parser.add_argument("--work-directory", type=Path, default=Path("data/benchmark"), help="of rollouts")
    parser.add_argument(
        "--output", type=result_tables.stem, default=Path("docs/results/nonlinear_filters"), help="stem of both files"
    )
    return parser.parse_args()


if __name__ == "__main__":
    main()
