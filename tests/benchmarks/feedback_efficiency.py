"""How much each reward model and each way of choosing pairs makes of a number of answers.

    python -m tests.benchmarks.feedback_efficiency --task feeding

Scripted users answer (5 % mistakes, 10 % "equal") matched pairs of real rollouts of a pool's behaviours. Measured on
pairs of other scenarios: how often the model prefers what the user truly prefers, on all of them and on contested ones
(where at least one of the paper's three users prefers the other clip), and the expected calibration error against
answers like those it learned from. And what the person gets: the execution mode that a study's search would pick for
this reward model, with its change of the true preference and of success as the response surface has them; for some
numbers of labels the mode is also driven through unseen scenarios. Rollouts are kept under data/, finished chains in
--output: repeat the command to go on from what is there, and with more --minutes to do more. A pool of 170 scenarios
has 1020 pairs.
"""

import argparse
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from tqdm import tqdm

from app.installed_tasks import catalogue
from tests.benchmarks import feedback_report, result_tables
from tests.benchmarks.chosen_modes import stake
from tests.benchmarks.feedback_report import LINEAR, NAMED, Row
from tests.benchmarks.pool_rollouts import Pool, pool_rollouts
from worker.compute import learning, simulation
from worker.compute.population import prior_of
from worker.compute.simulation import surface_file
from worker.domain.responses import TARGETS
from worker.domain.scenarios import EVALUATION, first_of
from worker.domain.trajectory import Trajectory
from worker.domain.type_aliases import Float32Array, FloatArray
from worker.ml import acquisition
from worker.ml.filters.fitting.gate import signal_changes, successes
from worker.ml.filters.fitting.response_surface import ResponseSurface, best_mode
from worker.ml.rewards import calibration, reward_training
from worker.ml.rewards.prior import Prior
from worker.ml.rewards.reward_models import RewardModel
from worker.ml.rewards.signal_scale import SignalScale
from worker.ml.teachers import TASTES, Manner, ScriptedTeacher, Taste, User, random_taste
from worker.sim.costs import preference_rewards, signal_weights
from worker.tasks import registry

Indices = npt.NDArray[np.int64]

POOL_FIRST, UNSEEN_FIRST = 10_800_000, 10_950_000
UNSEEN_SCENARIOS = 60
COUNTS = (10, 25, 50, 100, 200, 1000, 5000)
RETRAIN_EVERY = 10
"""labels, as in a study; network ensembles, which take seconds, choose anew at every one of COUNTS only"""
PEOPLE = tuple(f"person-{number}" for number in range(6))
EARLIER_PEOPLE = range(100, 112)
"""Numbers of people from the same population who came before those who are measured."""
RULES: tuple[acquisition.Strategy, ...] = ("uniform", "disagreement", "entropy", "information_gain", "contested")
AS_IN_A_STUDY: tuple[acquisition.Strategy, ...] = ("uniform", "entropy")
"""rules that are also run with the pooled prior and with foreseen signals: random ones, and the studio's default"""
DRIVEN = {
    ("structured", "entropy", 50),
    ("structured", "entropy", 200),
    ("mlp", "uniform", 200),
    ("mlp", "uniform", 5000),
}
"""What named users' modes are driven for: model, rule, labels."""
DRIVEN_SCENARIOS = 100
CLIPS_BEHIND_WISHES = 400
"""whose returns say what a network wants of the signals"""


@dataclass(frozen=True)
class Chain:
    """One user answering one pair after the other."""

    user: str
    model: reward_training.RewardKind
    rule: acquisition.Strategy = "uniform"
    pooled: bool = False
    seed: int = 0


@dataclass(frozen=True)
class Measured:
    """One row of the results."""

    task: str
    user: str
    model: str
    strategy: str
    pooled_prior: bool
    seed: int
    labels: int
    accuracy: float
    contested_accuracy: float | None
    gain_percent: float
    """of the true preference by the mode this model leads to, in % of what the user minds and likes under the reference
    policy; from the response surface"""
    success_points: float
    """change of success by that mode, likewise"""
    driven_gain_percent: float | None
    driven_success_points: float | None
    """the same in DRIVEN_SCENARIOS unseen scenarios"""
    calibration_error: float
    calibration_error_uncalibrated: float
    temperature: float
    fit_seconds: float


class Bench:
    """Pools and users of one task."""

    def __init__(self, task: str, pool_scenarios: int, most_labels: int) -> None:
        self.task, self.most_labels = registry.task(task), most_labels
        steps = 100 if task == "drinking" else 60
        self.pool = pool_rollouts(task, POOL_FIRST, pool_scenarios, steps)
        self.unseen = pool_rollouts(task, UNSEEN_FIRST, UNSEEN_SCENARIOS, steps)
        self.pairs, self.unseen_pairs = self.pool.pairs(), self.unseen.pairs()
        self.unseen_segments = self.unseen.segments(self.unseen_pairs)
        self.scale = SignalScale.of(self.pool.segments(self.pairs))
        self.surface = ResponseSurface.load(surface_file(task), self.task.modes)
        few = slice(CLIPS_BEHIND_WISHES)
        parts = zip(self.pool.signals[few], self.pool.observations[few], self.pool.actions[few], strict=True)
        self.wish_clips = [_Clip(*arrays) for arrays in parts]

    def measure(self, chain: Chain) -> Iterator[Measured]:
        """Answer, fit, choose, and so on."""
        rng = np.random.default_rng([chain.seed, 7])
        rewards = self.rewards(chain.user, self.pool)[self.pairs]
        teacher = ScriptedTeacher.calibrated(Manner(), rewards)
        rows, answers = np.zeros(0, np.int64), np.zeros(0)
        model: RewardModel | None = None
        stops = self.stops(chain)
        every = [*range(RETRAIN_EVERY, stops[-1], RETRAIN_EVERY)] if chain.model in LINEAR else []
        for count in sorted({*stops, *every} if chain.rule != "uniform" else stops):
            added = self._choose(chain, count - len(rows), rows, model, rng)
            said = [TARGETS[teacher.answer(left, right, rng)] for left, right in rewards[added]]
            rows, answers = np.concatenate([rows, added]), np.concatenate([answers, said])
            fitted = self._fit(chain, rows, answers)
            model = fitted.model
            if count in stops:
                yield self._row(chain, count, fitted)

    def stops(self, chain: Chain) -> list[int]:
        """The numbers of labels at which a chain is measured."""
        most = self.most_labels if chain.rule == "uniform" and not chain.pooled else min(200, self.most_labels)
        return [count for count in COUNTS if count <= min(most, len(self.pairs))]

    def _choose(
        self, chain: Chain, count: int, used: Indices, model: RewardModel | None, rng: np.random.Generator
    ) -> Indices:
        free = np.setdiff1d(np.arange(len(self.pairs)), used)
        scores = self._scores(chain, free, model)
        rule = "uniform" if scores is None else chain.rule
        choice = acquisition.choose(count, len(free), rng, rule=rule, scores=scores)
        return free[choice.indices]

    def _scores(self, chain: Chain, free: Indices, model: RewardModel | None) -> FloatArray | None:
        if chain.rule == "uniform":
            return None
        members = model.member_probabilities(self.pool.segments(self.pairs[free])) if model else None
        if chain.rule == "contested":
            others = [user for user in User if user.value != chain.user]
            returns = np.array([self.rewards(user.value, self.pool).sum(-1) for user in others])
            differences = returns[:, self.pairs[:, 1]] - returns[:, self.pairs[:, 0]]
            return acquisition.contested(acquisition.expected_answers(differences)[:, free], members)
        return None if members is None else acquisition.score(chain.rule, members)

    def _fit(self, chain: Chain, rows: Indices, answers: FloatArray) -> reward_training.FitResult:
        prior = self.pooled_prior if chain.pooled else self.prior
        pairs = self.pool.segments(self.pairs[rows])
        return reward_training.fit(
            pairs,
            answers,
            chain.model,
            chain.seed,
            scale=self.scale,
            prior=prior,
            predictor=simulation.signal_predictor(self.task.name) if chain.model == "predicted" else None,
        )

    def _row(self, chain: Chain, count: int, fitted: reward_training.FitResult) -> Measured:
        sides = self.rewards(chain.user, self.unseen)[self.unseen_pairs]
        wants = self._wants(chain.user)
        contested = np.any([self._wants(user.value) != wants for user in User], axis=0)
        predicted = fitted.model.probability_right(self.unseen_segments)
        right = (predicted > 0.5) == wants
        teacher, rng = ScriptedTeacher.calibrated(Manner(), sides), np.random.default_rng([chain.seed, 8])
        said = np.array([TARGETS[teacher.answer(left, right, rng)] for left, right in sides])
        plain = replace(fitted.model, temperature=1.0).probability_right(self.unseen_segments)
        mode = best_mode(self.surface, fitted.model.signal_weights(self.wish_clips), chain.seed)
        gain, success = self._promised(chain.user, mode)
        driven = chain.user in NAMED and (chain.model, chain.rule, count) in DRIVEN and not chain.pooled
        driven_gain, driven_success = self._driven(chain.user, mode) if driven else (None, None)
        return Measured(
            task=self.task.name,
            user=chain.user,
            model=chain.model,
            strategy=chain.rule,
            pooled_prior=chain.pooled,
            seed=chain.seed,
            labels=count,
            accuracy=float(right.mean()),
            contested_accuracy=float(right[contested].mean()) if contested.any() else None,
            gain_percent=gain,
            success_points=success,
            driven_gain_percent=driven_gain,
            driven_success_points=driven_success,
            calibration_error=calibration.expected_calibration_error(predicted, said),
            calibration_error_uncalibrated=calibration.expected_calibration_error(plain, said),
            temperature=fitted.model.temperature,
            fit_seconds=fitted.metrics["fit_seconds"],
        )

    def _promised(self, user: str, mode: FloatArray) -> tuple[float, float]:
        """Gain in % and change of success in points by the response surface."""
        changes, success = self.surface.predict(mode)
        return self._percent(user, float(changes @ self._true_weights(user))), 100 * float(success)

    def _driven(self, user: str, mode: FloatArray) -> tuple[float, float]:
        """The same in unseen scenarios."""
        name, reference = self.task.name, self.driven_reference
        scenarios = [each.scenario for each in reference]
        filtered = learning.run_scenarios(name, simulation.act_in_mode(name, mode), scenarios, 0.0, 0)
        change = signal_changes(reference, filtered).mean(axis=0) @ self._true_weights(user)
        return self._percent(user, float(change)), 100 * float((successes(filtered) - successes(reference)).mean())

    @cached_property
    def driven_reference(self) -> list[Trajectory]:
        """The reference policy in the scenarios in which modes are driven."""
        policy = simulation.reference_policy(self.task.name)
        scenarios = first_of(EVALUATION, DRIVEN_SCENARIOS)
        return learning.run_scenarios(self.task.name, policy.mean, scenarios, 0.0, 0)

    def _percent(self, user: str, change: float) -> float:
        return 100 * change / stake(self.task, _taste(user))

    def _true_weights(self, user: str) -> FloatArray:
        taste = _taste(user)
        return signal_weights(self.task, taste.omega, taste.per_signal)

    @cached_property
    def prior(self) -> Prior:
        """What the studio expects of anybody."""
        return prior_of(self.task.name, self.scale.spread)

    @cached_property
    def pooled_prior(self) -> Prior:
        """The same, and earlier people of the population, each with 200 answers."""
        weights = []
        for number in EARLIER_PEOPLE:
            rng = np.random.default_rng([number, 9])
            rewards = self.rewards(f"person-{number}", self.pool)[self.pairs]
            teacher = ScriptedTeacher.calibrated(Manner(), rewards)
            rows = rng.choice(len(self.pairs), 200, replace=False)
            said = np.array([TARGETS[teacher.answer(left, right, rng)] for left, right in rewards[rows]])
            features = self.pool.segments(self.pairs[rows]).signal_differences() / self.scale.spread
            weights.append(reward_training.posterior(features, said, self.prior).mean)
        return self.prior.or_like("earlier", weights)

    def rewards(self, user: str, pool: Pool) -> FloatArray:
        """True preference rewards, (C, T)."""
        taste = _taste(user)
        return preference_rewards(self.task, pool.costs, pool.signals, taste.omega, "calibrated", taste.per_signal)

    def _wants(self, user: str) -> npt.NDArray[np.bool_]:
        """Whether the user truly prefers the right clip of every unseen pair."""
        returns = self.rewards(user, self.unseen).sum(-1)
        wants: npt.NDArray[np.bool_] = returns[self.unseen_pairs[:, 1]] > returns[self.unseen_pairs[:, 0]]
        return wants


@dataclass(frozen=True)
class _Clip:
    """What a reward model reads of a clip."""

    signals: Float32Array
    observations: Float32Array
    actions: Float32Array
    success: bool = False

    def __len__(self) -> int:
        return len(self.actions)


def _taste(user: str) -> Taste:
    if user in TASTES:
        return TASTES[user]
    return random_taste(user, np.random.default_rng([int(user.removeprefix("person-")), 10]))


def chains(seeds: int) -> list[Chain]:
    """What matters most first: when time is up, the rest is left out."""
    networks: tuple[reward_training.RewardKind, ...] = ("mlp", "preference_transformer")
    first, *others = [_linear_chains(seed) for seed in range(seeds)]
    slow = [Chain(user, kind) for user in NAMED for kind in networks]
    slow += [Chain(user, "mlp") for user in PEOPLE]
    rest = [Chain(user, kind, rule) for user in NAMED for rule in RULES[1:] for kind in networks]
    return [*first, *slow, *(chain for more in others for chain in more), *rest]


def _linear_chains(seed: int) -> list[Chain]:
    everybody = (*NAMED, *PEOPLE)
    found = [Chain(user, "structured", rule, seed=seed) for user in everybody for rule in RULES]
    found += [Chain(user, "structured", rule, pooled=True, seed=seed) for user in everybody for rule in AS_IN_A_STUDY]
    return [*found, *(Chain(user, "predicted", rule, seed=seed) for user in NAMED for rule in AS_IN_A_STUDY)]


def main() -> None:
    """See the module."""
    options = _options()
    torch.set_num_threads(1)
    bench = Bench(options.task, options.pool_scenarios, options.most_labels)
    options.output.mkdir(parents=True, exist_ok=True)
    file = options.output / f"feedback_efficiency-{options.task}.csv"
    done, planned, until = _finished(bench, file), chains(options.seeds), time.monotonic() + 60 * options.minutes
    for chain in tqdm(planned, unit="chain", mininterval=5):
        if chain not in done and time.monotonic() < until:
            done[chain] = [asdict(row) for row in bench.measure(chain)]
            _write(file, [row for each in planned for row in done.get(each, [])])
    feedback_report.write(options.output)


def _finished(bench: Bench, file: Path) -> dict[Chain, list[Row]]:
    """Rows of the chains that an earlier call has measured as often as this one would."""
    found: defaultdict[Chain, list[Row]] = defaultdict(list)
    for row in feedback_report.read(file) if file.exists() else []:
        found[Chain(row["user"], row["model"], row["strategy"], row["pooled_prior"], row["seed"])].append(row)
    return {chain: rows for chain, rows in found.items() if [row["labels"] for row in rows] == bench.stops(chain)}


def _write(file: Path, rows: Sequence[Row]) -> None:
    rounded = [{name: round(v, 4) if isinstance(v, float) else v for name, v in row.items()} for row in rows]
    result_tables.write(file, rounded)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", choices=catalogue.names(), default="feeding")
    parser.add_argument("--seeds", type=int, default=2, help="of the quick chains; those of networks have one")
    parser.add_argument("--pool-scenarios", type=int, default=850)
    parser.add_argument("--most-labels", type=int, choices=COUNTS, default=5000)
    parser.add_argument("--minutes", type=float, default=30.0, help="no chain is begun after that")
    parser.add_argument("--output", type=Path, default=Path("docs/results"), help="folder of the .csv and the tables")
    return parser.parse_args()


if __name__ == "__main__":
    main()
