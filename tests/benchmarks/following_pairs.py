"""Whether pairs that follow the person pay: the true preference that their mode gains, with and without such pairs.

    python -m tests.benchmarks.following_pairs

Scripted users (5 % mistakes, 10 % "equal") answer pairs of a pool as large as a study's, chosen by entropy with the
usual random share. Beside it the same with 30 % of the pairs following, from the tenth answer on. After 25, 50 and 100
answers the search of modes picks the user's mode; its gain of the true preference, in % of what the user minds and
likes under the reference policy, is what the response surface predicts. The pool is kept under data/, every finished
chain in --output: repeat the command to go on.
"""

import argparse
import csv
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy import stats
from tqdm import tqdm

from app.domain.study_settings import StudySettings
from app.installed_tasks import catalogue
from tests.benchmarks.chosen_modes import stake
from worker.analysis.comparison import result_pages
from worker.compute import simulation
from worker.domain.responses import TARGETS
from worker.domain.type_aliases import Float32Array, FloatArray
from worker.experiments.benchmark_cell import CHOOSE_EVERY
from worker.jobs.learning import following
from worker.ml import acquisition
from worker.ml.filters.response_surface import ResponseSurface, best_mode
from worker.ml.rewards import reward_training
from worker.ml.rewards.segments import SegmentPairs
from worker.ml.rewards.signal_scale import SignalScale
from worker.ml.teachers import TASTES, Manner, ScriptedTeacher, Taste, random_taste
from worker.sim.costs import preference_rewards, signal_weights
from worker.sim.rollout import rollout
from worker.tasks import registry

TITLE = "# Whether pairs that follow the person pay"
USUAL = StudySettings()
POOL_FIRST = 10_700_000
COUNTS = (25, 50, 100)
SHARES = (0.0, 0.3)
PEOPLE = ("neutral", "cautious", "impatient", "slow", "wide", *(f"person-{number}" for number in range(4)))
MEASURED = ("gain_percent", "best_percent", "success_points")
COLUMNS = ("task", "user", "seed", "share", "labels", *MEASURED)
"""best_percent: what the mode of the user's true weights would gain"""
Row = dict[str, Any]


@dataclass(frozen=True)
class Chain:
    """One user answering one pair after the other."""

    task: str
    user: str
    seed: int
    share: float


@dataclass(frozen=True)
class Pool:
    """C clips of T steps."""

    signals: Float32Array
    """(C, T, S)"""
    observations: Float32Array
    actions: Float32Array
    costs: Float32Array
    means: FloatArray
    """(C, S) signals of the whole episodes"""
    modes: FloatArray
    """(C, A); nan: something else than the mode was different, too"""
    scenarios: acquisition.Indices


class Bench:
    """The pool of one task, and what its users answer."""

    def __init__(self, name: str, directory: Path) -> None:
        self.task = registry.task(name)
        self.surface = ResponseSurface.load(simulation.surface_file(name), self.task.modes)
        self.pool = _pool(name, directory)
        self.pairs = acquisition.matched_pairs(self.pool.scenarios)
        self.scale = SignalScale.of(self.segments(self.pairs), self.pool.means)

    def segments(self, rows: acquisition.Indices) -> SegmentPairs:
        """The pairs of clips in (N, 2) rows."""
        return SegmentPairs(self.pool.signals[rows], self.pool.observations[rows], self.pool.actions[rows])

    def measure(self, chain: Chain) -> Iterator[Row]:
        """Answer, fit, choose, and so on."""
        taste, rng = _taste(chain.user), np.random.default_rng([chain.seed, 7])
        rewards = preference_rewards(
            self.task, self.pool.costs, self.pool.signals, taste.omega, "calibrated", taste.per_signal
        )[self.pairs]
        teacher = ScriptedTeacher.calibrated(Manner(), rewards)
        rows, answers, model = np.zeros(0, np.int64), np.zeros(0), None
        for count in sorted({*COUNTS, *range(CHOOSE_EVERY, COUNTS[-1], CHOOSE_EVERY)}):
            added = self._choose(chain, count - len(rows), rows, model, rng)
            said = [TARGETS[teacher.answer(left, right, rng)] for left, right in rewards[added]]
            rows, answers = np.concatenate([rows, added]), np.concatenate([answers, said])
            asked = self.segments(self.pairs[rows])
            model = reward_training.fit(asked, answers, "structured", chain.seed, scale=self.scale).model
            if count in COUNTS:
                mode = best_mode(self.surface, model.signal_weights(()), chain.seed)
                yield {**vars(chain), "labels": count, **self._gained(chain.user, mode)}

    def _choose(
        self, chain: Chain, count: int, used: acquisition.Indices, model: Any, rng: np.random.Generator
    ) -> acquisition.Indices:
        free = np.setdiff1d(np.arange(len(self.pairs)), used)
        if model is None:
            return free[acquisition.choose(count, len(free), rng).indices]
        near = None
        if chain.share and len(used) >= following.FROM_ANSWER:
            wanted = best_mode(self.surface, model.signal_weights(()), chain.seed)
            near = acquisition.nearness(self.pool.modes, self.pairs[free], wanted, self.surface.high - self.surface.low)
        choice = acquisition.choose(
            count,
            len(free),
            rng,
            rule="entropy",
            scores=acquisition.entropy(model.member_probabilities(self.segments(self.pairs[free]))),
            following_scores=near,
            following_share=chain.share,
        )
        return free[choice.indices]

    def _gained(self, user: str, mode: FloatArray) -> Row:
        taste = _taste(user)
        weights = signal_weights(self.task, taste.omega, taste.per_signal)
        unit = stake(self.task, taste) / 100
        change, success = self.surface.predict(mode)
        best, _ = self.surface.predict(best_mode(self.surface, weights, 0))
        gains = {"gain_percent": change @ weights / unit, "best_percent": best @ weights / unit}
        return {name: float(each) for name, each in {**gains, "success_points": 100 * success}.items()}


def _taste(user: str) -> Taste:
    if user in TASTES:
        return TASTES[user]
    return random_taste(user, np.random.default_rng([int(user.removeprefix("person-")), 10]))


def _pool(name: str, directory: Path) -> Pool:
    path = directory / f"{name}.npz"
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        unfinished = path.with_suffix(".partial.npz")
        np.savez(unfinished, allow_pickle=False, **vars(_rolled(name)))
        unfinished.rename(path)
    with np.load(path, allow_pickle=False) as stored:
        return Pool(**{part: stored[part] for part in stored.files})


def _rolled(name: str) -> Pool:
    scenarios = range(POOL_FIRST, POOL_FIRST + USUAL.pool_scenarios)
    shown = [
        (scenario, each)
        for scenario in scenarios
        for each in simulation.behaviours(name, scenario, USUAL.behaviours_per_scenario)
    ]
    made = [
        rollout(simulation.environment(name), simulation.act_as(name, each), scenario)
        for scenario, each in tqdm(shown, desc=f"{name} pool", unit="rollout", mininterval=5)
    ]
    steps, family = slice(registry.installed_task(name).description.usual_clip_steps), registry.task(name).modes
    return Pool(
        np.stack([each.signals[steps] for each in made]),
        np.stack([each.observations[steps] for each in made]),
        np.stack([each.actions[steps] for each in made]),
        np.stack([each.costs[steps] for each in made]),
        np.array([each.signals.mean(axis=0, dtype=np.float64) for each in made]),
        np.array([following.mode_of(family, each.described()) for _, each in shown]),
        np.array([scenario for scenario, _ in shown]),
    )


def chains(seeds: int) -> list[Chain]:
    """Seed by seed, so that whoever stops early has everybody."""
    return [
        Chain(task, user, seed, share)
        for seed, task, user, share in product(range(seeds), catalogue.names(), PEOPLE, SHARES)
    ]


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--pools", type=Path, default=Path("data/following_pairs"), help="where rollouts are kept")
    parser.add_argument("--output", type=Path, default=Path("docs/results/following_pairs"), help="stem of both files")
    options = parser.parse_args()
    torch.set_num_threads(1)
    file, planned = options.output.with_suffix(".csv"), chains(options.seeds)
    done, benches = _finished(file), dict[str, Bench]()
    for chain in tqdm(planned, unit="chain", mininterval=5):
        if chain not in done:
            if chain.task not in benches:
                benches[chain.task] = Bench(chain.task, options.pools)
            done[chain] = list(benches[chain.task].measure(chain))
            _write(file, [row for each in planned for row in done.get(each, [])])
    page = options.output.with_suffix(".md")
    page.write_text(result_pages.page(page, TITLE, tables([row for each in planned for row in done[each]])))


def _finished(file: Path) -> dict[Chain, list[Row]]:
    found: defaultdict[Chain, list[Row]] = defaultdict(list)
    for row in csv.DictReader(file.read_text().splitlines()) if file.exists() else []:
        found[Chain(row["task"], row["user"], int(row["seed"]), float(row["share"]))].append(row)
    return {chain: rows for chain, rows in found.items() if len(rows) == len(COUNTS)}


def _write(file: Path, rows: Sequence[Row]) -> None:
    """Replace the file at once, so that an interruption leaves it whole."""
    unfinished = file.with_suffix(".unfinished")
    with unfinished.open("w", newline="") as stream:
        writer = csv.DictWriter(stream, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows({name: f"{v:.3f}" if name in MEASURED else v for name, v in row.items()} for row in rows)
    unfinished.replace(file)


def tables(rows: Sequence[Row]) -> str:
    """What was gained, and by how much more with pairs that follow."""
    gains = {
        (row["task"], row["user"], int(row["seed"]), float(row["share"]), int(row["labels"])): float(
            row["gain_percent"]
        )
        for row in rows
    }
    seeds = sorted({int(row["seed"]) for row in rows})
    lines = [
        "| task | answers | gained without, % | with, % | with minus without, points | seeds with more |",
        "|---|---|---|---|---|---|",
    ]
    for tasks, count in product([*((each,) for each in catalogue.names()), catalogue.names()], COUNTS):
        both = np.array(
            [
                [[gains[task, user, seed, share, count] for share in SHARES] for seed in seeds]
                for task, user in product(tasks, PEOPLE)
            ]
        )
        by_user = (both[..., 1] - both[..., 0]).mean(axis=1)
        half = float(stats.t.ppf(0.975, len(by_user) - 1) * by_user.std(ddof=1) / np.sqrt(len(by_user)))
        more, middle = both[..., 1] > both[..., 0], float(by_user.mean())
        title = tasks[0].capitalize() if len(tasks) == 1 else "all"
        without, with_them = both.mean(axis=(0, 1))
        lines.append(
            f"| {title} | {count} | {without:.1f} | {with_them:.1f} "
            f"| {middle:+.1f} [{middle - half:+.1f}, {middle + half:+.1f}] | {more.sum()} of {more.size} |"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    main()
