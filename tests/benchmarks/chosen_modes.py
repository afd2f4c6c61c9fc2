"""How good a mode the labels lead to, and what the choices behind it are worth.

    python -m tests.benchmarks.chosen_modes --output docs/results/chosen_modes

Scripted users label a pool as a study asks them to, and the search picks their mode; no filter is trained. The regret
is what the response surface predicts the best mode of somebody's true weights to gain beyond the picked one, in % of
what they mind and like under the reference policy. One choice at a time is changed: the prior's deviation, the share of
lapses that the likelihood allows for, the rule that picks pairs. Label seeds from 100 on, which the tables of the
benchmark do not use. Finished rows are kept under data/; repeat the command to go on.
"""

import argparse
import csv
import json
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

from app.installed_tasks import catalogue
from tests.benchmarks import result_tables
from worker.analysis.comparison import result_pages
from worker.compute import simulation
from worker.compute.pools import Compute, Lane
from worker.compute.simulation import surface_file
from worker.domain.task import Task
from worker.experiments.benchmark_cell import BenchmarkConfig, BenchmarkUser, Cell
from worker.experiments.rollout_cache import RolloutCache
from worker.ml import acquisition
from worker.ml.filters.fitting.response_surface import ResponseSurface, best_mode
from worker.ml.rewards import bradley_terry, prior
from worker.ml.rewards.reward_models import RewardModel
from worker.ml.teachers import TASTES, Manner, Taste, User
from worker.sim.costs import signal_weights, stakes
from worker.tasks import registry

FIRST_SEED = 100
USERS = tuple(user.value for user in User)
HARDLY_ANY = 0.001
"""Share of lapses. With none at all a sure model finds a slip impossible, and its likelihood has no logarithm."""
COLUMNS = (
    *("task", "labels", "hesitant", "deviation", "lapses", "rule", "seed", "user"),
    *("regret_percent", "own_advantage_percent", "success_points"),
)
HESITANT = Manner(rationality=3.0)
"""Of a pair that differs as much as pairs usually do they name the better clip in 95 % (and 5 % mistakes on top)."""


@dataclass(frozen=True)
class Choice:
    """What is chosen for everybody."""

    deviation: float = prior.DEVIATION
    lapses: float = bradley_terry.LAPSES
    rule: acquisition.Strategy = BenchmarkConfig.rule

    @property
    def name(self) -> str:
        """What differs from the shipped choice."""
        shipped = asdict(Choice())
        changed = {key: value for key, value in asdict(self).items() if value != shipped[key]}
        return ", ".join(f"{key} {value}" for key, value in changed.items()) or "**as shipped**"


CHOICES = (
    Choice(),
    Choice(deviation=1.0, lapses=HARDLY_ANY),
    Choice(deviation=1.0),
    Choice(deviation=2.0),
    Choice(deviation=6.0),
    Choice(lapses=HARDLY_ANY),
    Choice(rule="uniform"),
    Choice(rule="disagreement"),
    Choice(rule="information_gain"),
)


@dataclass(frozen=True)
class Question:
    """One row of the results: all users of a task with one seed."""

    task: str
    labels: int
    hesitant: bool
    choice: Choice
    seed: int


class UnkeptBench(BenchmarkUser):
    """A user's labels and a reward model of this very moment: none that is kept from another choice."""

    def _kept_reward(self, path: Path) -> RewardModel:
        return self._fit(self.terms.reward)


def answer(question: Question, work: Path) -> dict[str, Any]:
    """Regrets (U,) in %, by how much the own mode beats the best of the others' for each user, predicted success."""
    torch.set_num_threads(1)
    prior.DEVIATION, bradley_terry.LAPSES = question.choice.deviation, question.choice.lapses
    task = registry.task(question.task)
    surface = ResponseSurface.load(surface_file(task.name), task.modes)
    wishes = np.array([signal_weights(task, TASTES[user].omega, TASTES[user].per_signal) for user in USERS])
    unit = np.array([stake(task, TASTES[user]) for user in USERS]) / 100
    terms = BenchmarkConfig(labels=question.labels, rule=question.choice.rule)
    if question.hesitant:
        terms = replace(terms, manner=HESITANT)
    gains, lost, regrets = [], [], []
    for row, user in enumerate(USERS):
        bench = UnkeptBench(
            Cell(task.name, TASTES[user], "pbarl", question.seed), terms, RolloutCache(task.name, work), work
        )
        learned = bench.reward.signal_weights([])
        mode = best_mode(surface, learned, question.seed)
        change, success = surface.predict(mode)
        gains.append(wishes @ change / unit)
        lost.append(100 * float(success))
        best = surface.predict(best_mode(surface, wishes[row], 0))[0]
        regrets.append(float(wishes[row] @ best / unit[row] - gains[-1][row]))
    matrix = np.array(gains)
    advantages = [float(matrix[j, j] - np.delete(matrix[:, j], j).max()) for j in range(len(USERS))]
    return {"regrets": regrets, "advantages": advantages, "success": lost}


def stake(task: Task, taste: Taste) -> float:
    """What somebody minds and likes in an episode of the reference policy, in the mean."""
    reference = simulation.reference_rollouts(task.name)
    costs, signals = (
        np.mean([getattr(each, what).sum(axis=0) for each in reference], axis=0) for what in ("costs", "signals")
    )
    return float(stakes(task, costs, signals, taste.omega, per_signal=taste.per_signal))


def questions(seeds: int) -> list[Question]:
    """What matters most first."""
    return [
        Question(task, labels, hesitant, choice, FIRST_SEED + seed)
        for seed, (labels, hesitant), choice, task in product(
            range(seeds), [(200, False), (60, False), (200, True), (30, False)], CHOICES, catalogue.names()
        )
    ]


TITLE = "# How good a mode the labels lead to, and what the choices behind it are worth"


def main() -> None:
    """See the module."""
    options = _options()
    options.journal.touch()
    done = {line["question"]: line["row"] for line in map(json.loads, options.journal.read_text().splitlines())}
    asked = questions(options.seeds)
    missing = [question for question in asked if _key(question) not in done]
    compute = Compute(options.processes)

    def ask(question: Question) -> dict[str, Any]:
        return compute.run(Lane.LEARNING, lambda: None, answer, question, options.work_directory)

    with closing(compute), ThreadPoolExecutor(options.processes) as threads, options.journal.open("a") as stream:
        rows = tqdm(threads.map(ask, missing), total=len(missing), unit="row")
        for question, row in zip(missing, rows, strict=True):
            done[_key(question)] = row
            stream.write(json.dumps({"question": _key(question), "row": row}) + "\n")
            stream.flush()
    found = [(question, done[_key(question)]) for question in asked]
    sys.stdout.write(_markdown(found, options.seeds))
    if options.output:
        page = options.output.with_suffix(".md")
        page.write_text(result_pages.page(page, TITLE, _markdown(found, options.seeds)))
        with options.output.with_suffix(".csv").open("w", newline="") as stream:
            writer = csv.writer(stream, lineterminator="\n")
            writer.writerow(COLUMNS)
            writer.writerows(_lines(found))


def _key(question: Question) -> str:
    return json.dumps(asdict(question))


def _lines(found: Sequence[tuple[Question, dict[str, Any]]]) -> Iterator[list[Any]]:
    for question, row in found:
        where = [question.task, question.labels, question.hesitant, *asdict(question.choice).values(), question.seed]
        for user, *values in zip(USERS, row["regrets"], row["advantages"], row["success"], strict=True):
            yield [*where, user, *(f"{value:.3f}" for value in values)]


def _markdown(found: Sequence[tuple[Question, dict[str, Any]]], seeds: int) -> str:
    lines = [
        f"Means over three users and {seeds} label seed(s); own best: users whom their own mode serves best.",
        "`hesitant`: the users name the better clip with probability sigmoid(3 difference / spread).",
        "Every row: [chosen_modes.csv](chosen_modes.csv).",
    ]
    for labels, hesitant in dict.fromkeys((question.labels, question.hesitant) for question, _ in found):
        lines += ["", f"## {labels} labels{', hesitant users' if hesitant else ''}", ""]
        lines += [
            "| choice | " + " | ".join(f"{task}: regret, %" for task in catalogue.names()) + " | worst | own best |"
        ]
        lines += ["|---" * (3 + len(catalogue.names())) + "|"]
        for choice in CHOICES:
            rows = [
                (question.task, row)
                for question, row in found
                if (question.labels, question.hesitant, question.choice) == (labels, hesitant, choice)
            ]
            means = [
                float(np.mean([row["regrets"] for where, row in rows if where == task])) for task in catalogue.names()
            ]
            worst = max(max(row["regrets"]) for _, row in rows)
            advantages = np.array([row["advantages"] for _, row in rows])
            won = f"{int((advantages > 0).sum())} of {advantages.size}"
            cells = [*(f"{mean:.2f}" for mean in means), f"{worst:.1f}", won]
            lines.append(f"| {choice.name} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--work-directory", type=Path, default=Path("data/benchmark/rollouts"))
    parser.add_argument("--journal", type=Path, default=Path("data/chosen_modes.jsonl"))
    parser.add_argument("--output", type=result_tables.stem, help="stem of the .md and the .csv")
    return parser.parse_args()


if __name__ == "__main__":
    main()
