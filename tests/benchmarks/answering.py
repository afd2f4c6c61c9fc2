"""Scripted users who answer pairs of a pool as large as a study's, done in several variants, and what each gains."""

import argparse
import csv
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from itertools import product
from math import ceil
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from scipy import stats
from tqdm import tqdm

from app.domain.study_settings import StudySettings
from app.installed_tasks import catalogue, hints, qualities
from tests.benchmarks import result_tables
from tests.benchmarks.chosen_modes import stake
from worker.analysis.comparison import result_pages
from worker.compute import simulation
from worker.compute.behaviours import DIFFERENT_ENOUGH
from worker.compute.population import prior_of
from worker.domain.responses import TARGETS
from worker.domain.scenarios import MADE_FROM
from worker.domain.type_aliases import Float32Array, FloatArray
from worker.experiments.benchmark_cell import CHOOSE_EVERY
from worker.jobs.clips import made_pairs
from worker.ml import acquisition
from worker.ml.filters.fitting.response_surface import ResponseSurface, best_mode
from worker.ml.filters.fitting.variations import variation
from worker.ml.rewards import reward_training
from worker.ml.rewards.hint_directions import direction
from worker.ml.rewards.reward_models import RewardModel
from worker.ml.rewards.segments import SegmentPairs
from worker.ml.rewards.signal_scale import SignalScale
from worker.ml.teachers import TASTES, Manner, ScriptedTeacher, Taste, random_taste, speaks_most, truest
from worker.sim.costs import preference_rewards, signal_weights
from worker.sim.rollout import rollout
from worker.tasks import registry

USUAL = StudySettings()
POOL_FIRST = 10_700_000
COUNTS = (25, 50, 100)
PEOPLE = ("neutral", "cautious", "impatient", "slow", "wide", *(f"person-{number}" for number in range(4)))
MEASURED = ("gain_percent", "best_percent", "success_points")
"""best_percent: what the mode of the user's true weights would gain"""
Row = dict[str, Any]


@dataclass(frozen=True)
class Variant:
    """What is done otherwise while somebody answers."""

    following_share: float = 0.0
    """of the pairs, from the tenth answer on: each is simulated for this user"""
    names: float | None = None
    """How often the quality that speaks most for the chosen clip is what is named; else any is. None: nobody asks."""
    hints: float | None = None
    """How often each of the hints that are given before the first pair is one of the truest; else any. None: none."""
    hint_weight: int = 1
    """As how many answers each hint is heard"""


@dataclass(frozen=True)
class Chain:
    """One user answering one pair after the other."""

    task: str
    user: str
    seed: int
    variant: str
    """what is done otherwise"""


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
    scenarios: acquisition.Indices


@dataclass(frozen=True)
class Fitted:
    """What N answers led to."""

    rows: acquisition.Indices
    """(N,) of the pool's pairs"""
    answers: FloatArray
    """(N,)"""
    model: RewardModel


class Bench:
    """The pool of one task, and what its users answer."""

    def __init__(self, name: str, directory: Path, variants: Mapping[str, Variant]) -> None:
        self.task, self.variants, self.qualities = registry.task(name), variants, qualities.of_task(name)
        self.surface = ResponseSurface.load(simulation.surface_file(name), self.task.modes)
        self.pool = self._usual_pool = _pool(name, directory)
        self.pairs = self._usual_pairs = acquisition.matched_pairs(self.pool.scenarios)
        self.scale = SignalScale.of(self.segments(self.pairs), self.pool.means)
        self.prior = prior_of(name, self.scale.spread)
        self._of_users = dict[str, tuple[FloatArray, float, float]]()

    def segments(self, rows: acquisition.Indices) -> SegmentPairs:
        """The pairs of clips in (N, 2) rows."""
        return SegmentPairs(self.pool.signals[rows], self.pool.observations[rows], self.pool.actions[rows])

    def measure(self, chain: Chain) -> Iterator[Row]:
        """Answer, fit, choose, and so on."""
        for fitted in self.answered(chain, sorted({*COUNTS, *range(CHOOSE_EVERY, COUNTS[-1], CHOOSE_EVERY)})):
            if (count := len(fitted.rows)) in COUNTS:
                mode = best_mode(self.surface, fitted.model.signal_weights(()), chain.seed)
                yield {**vars(chain), "labels": count, **self.gained(chain.user, mode)}

    def answered(self, chain: Chain, counts: Sequence[int]) -> Iterator[Fitted]:
        """What is known after so many answers each; by that the next pairs are chosen."""
        variant, taste, rng = self.variants[chain.variant], taste_of(chain.user), np.random.default_rng([chain.seed, 7])
        hinted = self._hinted(variant, taste, chain)
        saying = np.random.default_rng([chain.seed, 11])
        self.pool, self.pairs = self._usual_pool, self._usual_pairs
        teacher = ScriptedTeacher.calibrated(Manner(), self._rewards(taste))
        rows, answers, model = np.zeros(0, np.int64), np.zeros(0), None
        named = np.zeros((0, len(self.task.signals)), bool)
        for count in counts:
            added = self._choose(chain, variant.following_share, count - len(rows), rows, model, rng)
            said = [TARGETS[teacher.answer(left, right, rng)] for left, right in self._rewards(taste)[added]]
            rows, answers = np.concatenate([rows, added]), np.concatenate([answers, said])
            named = np.concatenate([named, self._named(variant, taste, added, said, saying)])
            asked = self.segments(self.pairs[rows])
            model = reward_training.fit(
                asked,
                answers,
                "structured",
                chain.seed,
                scale=self.scale,
                prior=self.prior,
                mattered=named,
                hints=hinted,
            ).model
            yield Fitted(rows, answers, model)

    def _rewards(self, taste: Taste) -> FloatArray:
        """(N, 2, T) of every pair."""
        return preference_rewards(
            self.task, self.pool.costs, self.pool.signals, taste.omega, "calibrated", taste.per_signal
        )[self.pairs]

    def _named(
        self,
        variant: Variant,
        taste: Taste,
        rows: acquisition.Indices,
        said: Sequence[float | None],
        rng: np.random.Generator,
    ) -> npt.NDArray[np.bool_]:
        """(N, S) the signals that are said to have mattered."""
        named = np.zeros((len(rows), len(self.task.signals)), bool)
        if variant.names is None:
            return named
        weights = signal_weights(self.task, taste.omega, taste.per_signal)
        offered = {name: [self.task.signals.index(each) for each in group] for name, group in self.qualities.items()}
        differences = self.segments(self.pairs[rows]).signal_differences() * weights
        for row, (difference, target) in enumerate(zip(differences, said, strict=True)):
            says, which = rng.random(), int(rng.integers(len(offered)))  # always two draws
            if target in (0.0, 1.0):
                most = speaks_most(difference if target == 1.0 else -difference, offered)
                named[row, offered[most if says < variant.names else [*offered][which]]] = True
        return named

    def _hinted(self, variant: Variant, taste: Taste, chain: Chain) -> FloatArray:
        """(H, S) the hints that are given before the first pair."""
        if variant.hints is None:
            return np.zeros((0, len(self.task.signals)))
        place = (catalogue.names().index(chain.task), PEOPLE.index(chain.user))
        rng = np.random.default_rng([chain.seed, 13, *place])
        offered = hints.of_task(chain.task)
        directions = {name: direction(self.task.signals, each) for name, each in offered.items()}
        weights = signal_weights(self.task, taste.omega, taste.per_signal) * self.scale.spread
        given = truest(directions, weights, hints.MOST)
        for row in range(len(given)):
            true, which = rng.random() < variant.hints, int(rng.integers(len(offered)))
            given[row] = given[row] if true else [*offered][which]
        return np.repeat([directions[name] for name in dict.fromkeys(given)], variant.hint_weight, axis=0)

    def _choose(
        self,
        chain: Chain,
        following_share: float,
        count: int,
        used: acquisition.Indices,
        model: Any,
        rng: np.random.Generator,
    ) -> acquisition.Indices:
        free = np.setdiff1d(np.arange(len(self._usual_pairs)), used)
        if model is None:
            return free[acquisition.choose(count, len(free), rng).indices]
        choice = acquisition.choose(
            count,
            len(free),
            rng,
            rule="entropy",
            scores=acquisition.entropy(model.member_probabilities(self.segments(self.pairs[free]))),
            made=ceil(following_share * count) if len(used) >= made_pairs.FROM_ANSWER else 0,
            following_share=following_share,
        )
        usual = free[choice.indices[~choice.following]]
        return np.append(usual, self._made(chain, model, int(choice.following.sum())))

    def _made(self, chain: Chain, model: Any, count: int) -> acquisition.Indices:
        """Rows of pairs that are made now: what the user's filter would do, and a variation of it."""
        wanted = best_mode(self.surface, model.signal_weights(()), chain.seed)
        return np.array([self._made_of(wanted, chain, model) for _ in range(count)], np.int64)

    def _made_of(self, wanted: FloatArray, chain: Chain, model: Any) -> int:
        name, rng = self.task.name, np.random.default_rng([chain.seed, 17, len(self.pairs)])
        shown = self._steps / self.task.episode_steps
        other = variation(self.surface, model, wanted, shown, DIFFERENT_ENOUGH, rng)
        scenario = POOL_FIRST + MADE_FROM + len(self.pairs) - len(self._usual_pairs)
        environment = simulation.environment(name)
        made = [rollout(environment, simulation.act_in_mode(name, mode), scenario) for mode in (wanted, other)]
        arrays = ("signals", "observations", "actions", "costs")
        more = {each: np.array([getattr(side, each)[: self._steps] for side in made]) for each in arrays}
        grown = {each: np.concatenate([getattr(self.pool, each), more[each]]) for each in arrays}
        self.pairs = np.append(self.pairs, [[len(self.pool.signals), len(self.pool.signals) + 1]], axis=0)
        self.pool = replace(self.pool, **grown)
        return len(self.pairs) - 1

    @property
    def _steps(self) -> int:
        return int(self._usual_pool.signals.shape[1])

    def gained(self, user: str, mode: FloatArray) -> Row:
        """What the response surface says the mode is worth to them."""
        weights, unit, best = self._wishes(user)
        change, success = self.surface.predict(mode)
        gain = float(change @ weights / unit)
        return {"gain_percent": gain, "best_percent": best / unit, "success_points": float(100 * success)}

    def _wishes(self, user: str) -> tuple[FloatArray, float, float]:
        """A user's true weights, a hundredth of their stake, and the best that a mode gains."""
        if user not in self._of_users:
            taste = taste_of(user)
            weights = signal_weights(self.task, taste.omega, taste.per_signal)
            best, _ = self.surface.predict(best_mode(self.surface, weights, 0))
            self._of_users[user] = weights, stake(self.task, taste) / 100, float(best @ weights)
        return self._of_users[user]


def taste_of(user: str) -> Taste:
    """person-7 is drawn from a population, always the same."""
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
        return Pool(**{part.name: stored[part.name] for part in fields(Pool)})


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
    steps = slice(registry.installed_task(name).description.usual_clip_steps)
    return Pool(
        np.stack([each.signals[steps] for each in made]),
        np.stack([each.observations[steps] for each in made]),
        np.stack([each.actions[steps] for each in made]),
        np.stack([each.costs[steps] for each in made]),
        np.array([each.signals.mean(axis=0, dtype=np.float64) for each in made]),
        np.array([scenario for scenario, _ in shown]),
    )


def parser(description: str | None, stem: str, seeds: int = 2) -> argparse.ArgumentParser:
    """What such a benchmark can be told. ``stem``: of the files of its results; ``seeds`` 0: it has its own."""
    told = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    if seeds:
        told.add_argument("--seeds", type=int, default=seeds)
    told.add_argument("--pools", type=Path, default=Path("data/answering"), help="where rollouts are kept")
    told.add_argument(
        "--output", type=result_tables.stem, default=Path("docs/results") / stem, help="stem of both files"
    )
    return told


def run(options: argparse.Namespace, title: str, column: str, variants: Mapping[str, Variant]) -> None:
    """Answer in every variant, the first of which the others are compared with. ``column``: what varies is called."""
    torch.set_num_threads(1)
    file, page = options.output.with_suffix(".csv"), options.output.with_suffix(".md")
    # Seed by seed, so that whoever stops early has everybody.
    planned = [
        Chain(task, user, seed, variant)
        for seed, task, user, variant in product(range(options.seeds), catalogue.names(), PEOPLE, variants)
    ]
    done, benches = _finished(file, column), dict[str, Bench]()
    for chain in tqdm(planned, unit="chain", mininterval=5):
        if chain not in done:
            if chain.task not in benches:
                benches[chain.task] = Bench(chain.task, options.pools, variants)
            done[chain] = list(benches[chain.task].measure(chain))
            _write(file, column, [row for each in planned for row in done.get(each, [])])
    usual, *others = variants
    found = [tables([row for each in planned for row in done[each]], usual, other, column) for other in others]
    page.write_text(result_pages.page(page, title, "\n\n".join(found)))


def _finished(file: Path, column: str) -> dict[Chain, list[Row]]:
    found: defaultdict[Chain, list[Row]] = defaultdict(list)
    for row in csv.DictReader(file.read_text().splitlines()) if file.exists() else []:
        row["variant"] = row.pop(column)
        found[Chain(row["task"], row["user"], int(row["seed"]), row["variant"])].append(row)
    return {chain: rows for chain, rows in found.items() if len(rows) == len(COUNTS)}


def _write(file: Path, column: str, rows: Sequence[Row]) -> None:
    """Replace the file at once, so that an interruption leaves it whole."""
    unfinished = file.with_suffix(".unfinished")
    with unfinished.open("w", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(["task", "user", "seed", column, "labels", *MEASURED])
        for row in rows:
            measured = [f"{float(row[name]):.3f}" for name in MEASURED]
            writer.writerow([row["task"], row["user"], row["seed"], row["variant"], row["labels"], *measured])
    unfinished.replace(file)


def tables(rows: Sequence[Row], usual: str, other: str, column: str) -> str:
    """What was gained as usual and in another variant, and by how much more; intervals by Student's t over users."""
    gains = {
        (row["task"], row["user"], int(row["seed"]), row["variant"], int(row["labels"])): float(row["gain_percent"])
        for row in rows
    }
    seeds = sorted({int(row["seed"]) for row in rows})
    lines = [
        f"| task | answers | gained with {column} {usual}, % | {other}, % | difference, points | seeds with more |",
        "|---|---|---|---|---|---|",
    ]
    for tasks, count in product([*((each,) for each in catalogue.names()), catalogue.names()], COUNTS):
        both = np.array(
            [
                [[gains[task, user, seed, variant, count] for variant in (usual, other)] for seed in seeds]
                for task, user in product(tasks, PEOPLE)
            ]
        )
        by_user = (both[..., 1] - both[..., 0]).mean(axis=1)
        half = float(stats.t.ppf(0.975, len(by_user) - 1) * by_user.std(ddof=1) / np.sqrt(len(by_user)))
        more, middle = both[..., 1] > both[..., 0], float(by_user.mean())
        title = tasks[0].capitalize() if len(tasks) == 1 else "all"
        before, after = both.mean(axis=(0, 1))
        lines.append(
            f"| {title} | {count} | {before:.1f} | {after:.1f} "
            f"| {middle:+.1f} [{middle - half:+.1f}, {middle + half:+.1f}] | {more.sum()} of {more.size} |"
        )
    return "\n".join(lines)
