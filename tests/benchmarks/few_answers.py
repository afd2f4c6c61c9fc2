"""What 25 and 50 answers lead to, for people like those that the prior expects and for others.

    python -m tests.benchmarks.few_answers

Scripted users (5 % mistakes, 10 % "equal") answer pairs of a pool as large as a study's, chosen by entropy, 30 % at
random, a model every ten answers, every twenty from 100 on. "before" is what was done until decision 135: nobody is
known, and a mode's return counts less by the deviation of the model's members. "now, but for one thing": the prior of
decision 135, without people to whom one thing matters. "pooled": twelve earlier people of the population are known as
well; before, they were the whole prior. The search picks the user's mode without trials; its gain of the true
preference, in % of what the user minds and likes under the reference policy, is what the response surface predicts.
Where refinements are usual, their gate keeps a policy that was refined beforehand instead, if the model says clearly
that it is better: what these change is driven, no refinement is trained. Models are posteriors without the
temperature of their probabilities, which hardly matters to what is asked. Every finished chain is kept in --output:
repeat the command to go on.
"""

import csv
import time
from collections.abc import Iterator, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from tqdm import tqdm

from app.installed_tasks import catalogue
from app.services.answers import stopping_advice
from tests.benchmarks import answering, few_answers_report
from tests.benchmarks.answering import Bench, Variant
from tests.benchmarks.chosen_modes import stake
from tests.benchmarks.few_answers_report import GROUPS, TITLE, VARIANTS, WITHOUT, Row
from worker.analysis.comparison import result_pages
from worker.domain.responses import TARGETS
from worker.domain.scenarios import EVALUATION, first_of
from worker.domain.trajectory import SIGNALS
from worker.domain.type_aliases import FloatArray
from worker.experiments.rollout_cache import RolloutCache
from worker.ml import acquisition
from worker.ml.filters.fitting.gate import chance_of_gain, signal_changes
from worker.ml.filters.fitting.mode_worth import price_of_failures
from worker.ml.filters.fitting.response_surface import CAUTION, ResponseSurface, best_mode
from worker.ml.reinforcement.refinement_gate import LEAST_LIFT, SURE
from worker.ml.rewards.bradley_terry import probability_right
from worker.ml.rewards.prior import ONE_MATTERS, Population, Prior
from worker.ml.rewards.reward_models import NEVER_WANTED
from worker.ml.rewards.reward_training import antithetic, posterior
from worker.ml.stopping import relative_regret
from worker.ml.teachers import TASTES, Manner, ScriptedTeacher, Taste
from worker.sim.costs import preference_rewards, signal_weights

CHOOSE_AT = (*range(10, 101, 10), 25, *range(120, 201, 20))
EARLIER = range(900, 912)
FIRST = 500
"""of the numbers of people whom no choice was made by"""
COSTS = [column for column, name in enumerate(SIGNALS) if name in NEVER_WANTED]
DRIVEN = 200
"""scenarios that the archived policies are driven through"""
WORTHWHILE = (3.0, 60.0)
"""% of the stake that the best mode gains. Others outside the population are drawn again"""


Chain = tuple[str, str, str, int, str]


class Wish(NamedTuple):
    """What a user truly wants."""

    weights: FloatArray
    """(S,)"""
    unit: float
    """a hundredth of the stake"""
    best: float
    """% of the stake that the best mode gains"""

    def gain(self, surface: ResponseSurface, mode: FloatArray) -> float:
        """% of the stake that a mode gains."""
        return self.worth(surface.predict(mode)[0])

    def worth(self, changes: FloatArray) -> float:
        """% of the stake that (S,) changes of signals are worth."""
        return float(changes @ self.weights / self.unit)


class FewAnswers(Bench):
    """One task, its people, and what they end up with."""

    def __init__(self, name: str, pools: Path, people: int) -> None:
        super().__init__(name, pools, {"": Variant()})
        self._known_wishes = dict[str, Wish]()
        self.features = self.segments(self.pairs).signal_differences() / self.scale.spread
        self.tastes: dict[str, dict[str, Taste]] = {
            "named": dict(TASTES),
            "drawn": {f"person-{each}": answering.taste_of(f"person-{each}") for each in range(FIRST, FIRST + people)},
            "outside": {taste.name: taste for taste in (self._outsider(FIRST + each) for each in range(people))},
        }
        self.priors = self._priors()
        self.archived = archived_changes(name, pools)

    def rows(self, chain: Chain) -> Iterator[Row]:
        """Answer, learn, choose, and so on."""
        _, group, user, seed, variant = chain
        taste, rng = self.tastes[group][user], np.random.default_rng([seed, 7])
        wish, rewards = self.wish(taste), self._rewards(taste)
        teacher = ScriptedTeacher.calibrated(Manner(), rewards)
        search = cautious_mode if variant.startswith("before") else best_mode
        asked, answers, members = np.zeros(0, np.int64), np.zeros(0), None
        regrets, told_after, told_gain = list[tuple[int, float]](), 0, 0.0
        for count in sorted(each for each in CHOOSE_AT if each <= VARIANTS[variant][-1]):
            added = self._ask(count - len(asked), asked, members, rng)
            said = [TARGETS[teacher.answer(left, right, rng)] for left, right in rewards[added]]
            asked, answers = np.concatenate([asked, added]), np.concatenate([answers, said])
            found = posterior(self.features[asked], answers, self.priors[variant], COSTS)
            members = antithetic(found.mean, found.covariance, np.random.default_rng(seed))
            wanted = members / self.scale.spread
            if variant == "now" and count % 10 == 0 and not told_after:
                regrets.append((count, relative_regret(self.surface, wanted)))
                if stopping_advice.enough_since(regrets):
                    told_after, told_gain = count, wish.gain(self.surface, search(self.surface, wanted, seed))
            if count in VARIANTS[variant]:
                mode = search(self.surface, wanted, seed)
                nobody = float(found.shares[0]) if variant.startswith("now") else 1.0
                success = 100 * float(self.surface.predict(mode)[1])
                yield Row(
                    *chain,
                    labels=count,
                    gain_percent=round(wish.gain(self.surface, mode), 3),
                    kept_percent=round(wish.worth(self._kept(mode, wanted)), 3),
                    best_percent=round(wish.best, 3),
                    success_points=round(success, 3),
                    like_nobody_known=round(nobody, 3),
                    told_after=told_after,
                    told_gain=round(told_gain, 3),
                    mode=" ".join(f"{each:.3f}" for each in mode),
                )

    def _kept(self, mode: FloatArray, wanted: FloatArray) -> FloatArray:
        """(S,) what changes with what the gate of a refinement keeps where learning finds nothing better.

        The archived policy that the model likes best, where that is better enough than the mode and surely so; else
        the mode. ``wanted``: (E, S), members.
        """
        alone = self.surface.predict(mode)[0]
        least = LEAST_LIFT * max(0.0, float(alone @ wanted.mean(axis=0)))
        best = max(self.archived, key=lambda changes: float(changes @ wanted.mean(axis=0)), default=alone)
        gains = best @ wanted.T
        return best if gains.mean() > least and chance_of_gain(gains) >= SURE else alone

    def _ask(
        self, count: int, asked: acquisition.Indices, members: FloatArray | None, rng: np.random.Generator
    ) -> acquisition.Indices:
        free = np.setdiff1d(np.arange(len(self.pairs)), asked)
        if members is None:
            return free[acquisition.choose(count, len(free), rng).indices]
        scores = acquisition.entropy(probability_right(members @ self.features[free].T))
        return free[acquisition.choose(count, len(free), rng, rule="entropy", scores=scores).indices]

    def wish(self, taste: Taste) -> Wish:
        """See Wish; the search for the best mode takes a second."""
        if taste.name not in self._known_wishes:
            self._known_wishes[taste.name] = self._wish(taste)
        return self._known_wishes[taste.name]

    def _wish(self, taste: Taste) -> Wish:
        wish = Wish(signal_weights(self.task, taste.omega, taste.per_signal), stake(self.task, taste) / 100, 0.0)
        return wish._replace(best=wish.gain(self.surface, best_mode(self.surface, wish.weights, 0)))

    def _rewards(self, taste: Taste) -> FloatArray:
        """(M, 2, T) true preference rewards of all pairs."""
        pool = self.pool
        return preference_rewards(self.task, pool.costs, pool.signals, taste.omega, "calibrated", taste.per_signal)[
            self.pairs
        ]

    def _priors(self) -> Mapping[str, Prior]:
        nobody = Prior.standard(len(SIGNALS))
        earlier = [self._earlier(number, nobody) for number in EARLIER]
        known = [self._earlier(number, self.prior) for number in EARLIER]
        return {
            "before": nobody,
            "now": self.prior,
            WITHOUT: Prior(tuple(each for each in self.prior.populations if each.name != ONE_MATTERS)),
            "before, pooled": Prior((Population.of("earlier", np.array(earlier)),)),
            "now, pooled": self.prior.or_like("earlier", known),
        }

    def _earlier(self, number: int, prior: Prior) -> FloatArray:
        """(S,) what 200 answers to random pairs taught about somebody of the population."""
        rng, taste = np.random.default_rng([number, 9]), answering.taste_of(f"person-{number}")
        rewards = self._rewards(taste)
        teacher = ScriptedTeacher.calibrated(Manner(), rewards)
        asked = rng.choice(len(self.pairs), 200, replace=False)
        said = np.array([TARGETS[teacher.answer(left, right, rng)] for left, right in rewards[asked]])
        return posterior(self.features[asked], said, prior, COSTS).mean

    def _outsider(self, number: int) -> Taste:
        """Somebody whom the population does not have, and for whom something is to be gained."""
        drawn = (self._drawn_outside(number, np.random.default_rng([number, attempt, 77])) for attempt in range(1000))
        return next(each for each in drawn if WORTHWHILE[0] <= self._wish(each).best <= WORTHWHILE[1])

    def _drawn_outside(self, number: int, rng: np.random.Generator) -> Taste:
        """By turns: two signals minded instead of liked or the reverse, each as much as all else together where nobody
        minds it; one signal and hardly anything else; weights that differ 625-fold with three more likes."""
        spread = self.scale.spread
        varies = [name for name, size in zip(SIGNALS, np.abs(self.features).max(axis=0), strict=True) if size > 0.0]
        free = [name for name in varies if name not in NEVER_WANTED and name != "distance_m"]
        usual = float(np.linalg.norm(signal_weights(self.task) * spread))
        size = dict(zip(SIGNALS, spread, strict=True))
        kind = ("opposite", "single", "extreme")[number % 3]
        if kind == "single":
            name = str(rng.choice(free if rng.random() < 0.8 else [each for each in varies if each in NEVER_WANTED]))
            sign = 1.0 if name in NEVER_WANTED else float(rng.choice([-1.0, 1.0]))
            return Taste(f"single-{number}", (0.1,) * 6, {name: 3 * sign * usual / size[name]})
        if kind == "extreme":
            omega = tuple(float(each) for each in 25.0 ** rng.uniform(-1.0, 1.0, 6))
            much = {
                str(name): float(rng.choice([-1, 1]) * 5.0 ** rng.uniform(-1, 1))
                for name in rng.choice(free, 3, replace=False)
            }
            return Taste(f"extreme-{number}", omega, {name: each * usual / size[name] for name, each in much.items()})
        omega = tuple(float(each) for each in 5.0 ** rng.uniform(-1.0, 1.0, 6))
        wants = dict(zip(SIGNALS, signal_weights(self.task, omega), strict=True))
        total = float(np.linalg.norm(np.array(list(wants.values())) * spread))
        turned = [str(each) for each in rng.choice(free, 2, replace=False)]
        return Taste(
            f"opposite-{number}",
            omega,
            {name: 2 * wants[name] or float(rng.choice([-1, 1]) * total / size[name]) for name in turned},
        )


def archived_changes(name: str, directory: Path) -> FloatArray:
    """(P, S) by how much an episode's signals change with each policy that was refined beforehand."""
    cached, unseen = RolloutCache(name, directory / "rollouts"), first_of(EVALUATION, DRIVEN)
    archived = [each.driven for each in cached.archived(unseen)]
    if not archived:
        return np.zeros((0, len(SIGNALS)))
    reference = cached.reference(unseen)
    return np.array([signal_changes(reference, driven).mean(axis=0) for driven in archived])


def cautious_mode(surface: ResponseSurface, members: FloatArray, seed: int) -> FloatArray:
    """What best_mode() was until decision 135: the members' deviation is subtracted from a mode's return."""
    rng, width = np.random.default_rng(seed), surface.high - surface.low
    reference = np.zeros((1, len(width)))
    modes = np.concatenate([reference, rng.uniform(surface.low, surface.high, (20_000, len(width)))])
    unit = max(float((surface.predict(modes)[0] @ members.mean(axis=0)).std()), 1e-9)

    def worth(modes: FloatArray) -> FloatArray:
        signals, success = surface.predict(modes, CAUTION)
        returns = signals @ members.T / unit
        lost = price_of_failures(success)
        value: FloatArray = returns.mean(axis=-1) - returns.std(axis=-1) - lost
        return value

    for spread in (0.2, 0.05):
        best = modes[np.argsort(worth(modes))[-40:]]
        around = np.repeat(best, 100, axis=0) + spread * width * rng.standard_normal((4000, len(width)))
        modes = np.concatenate([reference, best, np.clip(around, surface.low, surface.high)])
    winner: FloatArray = modes[np.argmax(worth(modes))]
    return winner


def main() -> None:
    """See the module."""
    told = answering.parser(__doc__, "few_answers", seeds=1)
    told.add_argument("--people", type=int, default=12, help="drawn, and as many outside")
    told.add_argument("--minutes", type=float, default=1e6, help="then write the page from what is finished")
    options = told.parse_args()
    torch.set_num_threads(1)
    file, page = options.output.with_suffix(".csv"), options.output.with_suffix(".md")
    benches = {name: FewAnswers(name, options.pools, options.people) for name in catalogue.names()}
    planned = [
        (task, group, user, seed, variant)
        for task, bench in benches.items()
        for group, tastes in bench.tastes.items()
        for user, seed in product(tastes, range(options.seeds))
        for variant in VARIANTS
    ]
    places = {
        user: place for bench in benches.values() for group in GROUPS for place, user in enumerate(bench.tastes[group])
    }
    planned.sort(key=lambda chain: (chain[3], places[chain[2]]))  # who stops early has all tasks and groups
    done = finished(file)
    with file.open("a", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        if not done:
            writer.writerow(Row._fields)
        until = time.monotonic() + 60 * options.minutes
        for chain in tqdm(planned, unit="chain", mininterval=5):
            if chain not in done and time.monotonic() < until:
                done[chain] = list(benches[chain[0]].rows(chain))
                writer.writerows(done[chain])
                stream.flush()
    whole = [chain for chain in planned if all((*chain[:4], variant) in done for variant in VARIANTS)]
    rows = [row for chain in whole for row in done[chain]]
    page.write_text(
        result_pages.page(
            page,
            TITLE,
            few_answers_report.page(rows, lambda task, some: advantages(benches[task], some)),
        )
    )


def finished(file: Path) -> dict[Chain, list[Row]]:
    """The chains of a file that are whole."""
    found: dict[Chain, list[Row]] = {}
    for row in csv.DictReader(file.read_text().splitlines()) if file.exists() else []:
        who = row["task"], row["group"], row["user"], int(row["seed"]), row["variant"]
        known = Row(
            *who,
            labels=int(row["labels"]),
            gain_percent=float(row["gain_percent"]),
            kept_percent=float(row["kept_percent"]),
            best_percent=float(row["best_percent"]),
            success_points=float(row["success_points"]),
            like_nobody_known=float(row["like_nobody_known"]),
            told_after=int(row["told_after"]),
            told_gain=float(row["told_gain"]),
            mode=row["mode"],
        )
        found.setdefault(who, []).append(known)
    return {chain: rows for chain, rows in found.items() if len(rows) == len(VARIANTS[chain[4]])}


def advantages(bench: FewAnswers, rows: Sequence[Row]) -> FloatArray:
    """(U,) by how much everybody's own mode is better for them than the better of two others', in threes."""
    found = []
    for first in range(0, len(rows) - 2, 3):
        three = rows[first : first + 3]
        changes = bench.surface.predict(np.array([[float(each) for each in row.mode.split()] for row in three]))[0]
        for place, row in enumerate(three):
            wish = bench.wish(bench.tastes[row.group][row.user])
            gains = changes @ wish.weights / wish.unit
            found.append(float(gains[place] - np.delete(gains, place).max()))
    return np.array(found)


if __name__ == "__main__":
    main()
