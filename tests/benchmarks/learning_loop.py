"""The learning loop on the real simulation of a task, for the paper's three users, without web or database.

    python -m tests.benchmarks.learning_loop --task feeding --labels 200 --seeds 3 --output loop.json

Per user and seed: scripted labels (5 % mistakes, 10 % "equal") on matched clips of the pool's behaviours, prequential
accuracy while the labels come in, the filter with its seconds per stage, and every filter on the same unseen scenarios
scored by every user's true costs (own-versus-other matrix). Rollouts are cached under --cache, keyed by what they need.
"""

import argparse
import hashlib
import json
import multiprocessing
import os
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any, get_args

import numpy as np
import numpy.typing as npt
import torch

from worker import laboratory
from worker.analysis.agreement import prequential
from worker.analysis.evaluation import evaluate
from worker.behaviours import Behaviour
from worker.exploration import surface_file
from worker.ml import acquisition, filter_problem, printed_filter, reward_training, studio_filter
from worker.ml.response_surface import ResponseSurface
from worker.ml.reward_training import SignalScale
from worker.ml.segments import SegmentPairs
from worker.ml.teachers import OMEGA, Manner, ScriptedTeacher, User
from worker.sim.catalogue import ENVIRONMENTS
from worker.sim.costs import CostForm, preference_rewards
from worker.sim.rollout import rollout
from worker.trajectory import Trajectory

POOL_FIRST, TEST_POOL_FIRST = 10_000_000, 10_500_000
TARGETS = {"left": 0.0, "right": 1.0, "equal": 0.5}
Floats = npt.NDArray[np.float64]


def main() -> None:
    """See the module."""
    options = _options()
    torch.set_num_threads(1)
    with ProcessPoolExecutor(options.processes, multiprocessing.get_context("spawn"), initializer=_settle) as pool:
        bench = Bench(pool, options)
        results = bench.run()
    text = json.dumps(results, indent=1) + "\n"
    if options.output:
        options.output.write_text(text)
    sys.stdout.write(text)


class Bench:
    """One measurement."""

    def __init__(self, pool: ProcessPoolExecutor, options: argparse.Namespace) -> None:
        self.pool, self.options = pool, options
        self.form: CostForm = options.form
        self.task = laboratory.task(options.task)
        self.policy = laboratory.reference_policy(self.task.name)
        self.surface = ResponseSurface.load(surface_file(self.task.name), self.task.modes)
        self.clips = self.behaviours(POOL_FIRST, options.pool_scenarios)
        self.test_clips = self.behaviours(TEST_POOL_FIRST, 60)
        self.normalising = self.collect(self.policy.mean, range(2_000_000_000, 2_000_000_040), 0.0, 0)
        config = filter_problem.FilterConfig()
        self.gate_reference = self.collect(
            self.policy.mean, filter_problem.scenarios_for("gate", config.gate_scenarios), 0.0, 0
        )
        self.unseen = filter_problem.scenarios_for("evaluation", options.evaluation)
        self.reference = self.collect(self.policy.mean, self.unseen, 0.0, 0)

    def run(self) -> dict[str, Any]:
        """Everything, as plain values."""
        results: dict[str, Any] = {"form": self.form, "labels": self.options.labels, "reference": self.describe()}
        results["pool"] = {
            "success": float(np.mean([each.success for each in self.clips])),
            "agreement": self.agreement(),
        }
        runs = [self.run_seed(seed) for seed in range(self.options.seeds)]
        results["runs"] = runs
        return results

    def describe(self) -> dict[str, Any]:
        """The reference policy on the unseen scenarios."""
        true = {user: float(self.true_returns(user, self.reference).mean()) for user in User}
        return {"success": float(np.mean([each.success for each in self.reference])), "true_return": true}

    def agreement(self) -> dict[str, float]:
        """Share of matched pairs of the pool on which two users prefer the same clip."""
        pairs = self.pairs(self.test_clips)
        sides = {user: self.pair_rewards(user, self.test_clips, pairs).sum(-1) for user in User}
        wants = {user: values[:, 1] > values[:, 0] for user, values in sides.items()}
        users = list(User)
        return {
            f"{first} {second}": float((wants[first] == wants[second]).mean())
            for index, first in enumerate(users)
            for second in users[index + 1 :]
        }

    def run_seed(self, seed: int) -> dict[str, Any]:
        """All users with one seed of labels and trainings."""
        filtered, outcome = {}, {}
        for user in User:
            outcome[user.value], filtered[user] = self.run_user(user, seed)
            sys.stderr.write(f"seed {seed} {user}: {json.dumps(outcome[user.value]['filter'])[:600]}\n")
        matrix = {row.value: {column.value: self.gain(column, filtered[row]) for column in User} for row in User}
        best = {user.value: self.own_minus_best_other(user, filtered) for user in User}
        sys.stderr.write(_table(matrix, best) + "\n")
        return {"users": outcome, "matrix_percent": matrix, "own_minus_best_other_percent": best}

    def run_user(self, user: User, seed: int) -> tuple[dict[str, Any], list[Trajectory]]:
        """Labels, reward model, filter, evaluation."""
        labelled, targets, curve = self.label(user, seed)
        started = time.perf_counter()
        kind: reward_training.Kind = "mlp" if self.options.method == "printed" else self.options.reward
        scale = SignalScale.of(SegmentPairs.cut(self.pairs_of(self.clips), 0, self.options.clip_steps))
        reward = reward_training.fit(labelled, targets, kind, seed, scale=scale, reference=self.normalising)
        problem = filter_problem.FilterProblem(self.task, self.policy, reward.model, seed, self.config())
        if self.options.method == "printed":
            draft = printed_filter.fit_printed(problem, self.reference)
        else:
            draft = studio_filter.fit_studio(problem, self.surface, self.clips, self.gate_reference, self.collect)
        act = filter_problem.act_of(self.task.modes, self.policy, draft.weights)
        fitted_s = time.perf_counter() - started
        filtered = self.collect(act, self.unseen, 0.0, 0)
        before, after = reward.model.returns(self.reference), reward.model.returns(filtered)
        evaluation = evaluate(self.reference, filtered, before, after)
        weights = draft.weights
        return {
            "accuracy": curve,
            "test_accuracy": self.accuracy(user, reward.model),
            "fit_seconds": reward.metrics["fit_seconds"],
            "filter": {
                "mode": {name: round(value, 2) for name, value in weights.mode.items()},
                "gate": weights.gate,
                "residual_share": weights.residual_share if weights.encoder else None,
                "trials": [vars(trial) for trial in draft.trials],
                "seconds": dict(draft.seconds),
                "seconds_in_all": round(fitted_s, 1),
            },
            "true_gain_percent": self.gain(user, filtered),
            "evaluation": evaluation,
        }, filtered

    def config(self) -> filter_problem.FilterConfig:
        """The default, with the residual left out when asked."""
        if self.options.no_residual:
            return filter_problem.FilterConfig(round_rollouts=())
        return filter_problem.FilterConfig(preference_weight=self.options.preference_weight)

    def label(self, user: User, seed: int) -> tuple[SegmentPairs, Floats, dict[str, Any]]:
        """Scripted labels with a model refitted every ten, predicting each label before it is given."""
        rng = np.random.default_rng([seed, 7])
        pairs = self.pairs(self.clips)
        rewards = self.pair_rewards(user, self.clips, pairs)
        teacher = ScriptedTeacher.calibrated(Manner(), rewards)
        choice = acquisition.choose(self.options.labels, len(pairs), rng)
        chosen = [
            pairs[row][::-1] if swap else pairs[row] for row, swap in zip(choice.indices, choice.swapped, strict=True)
        ]
        shown = SegmentPairs.cut(
            [(self.clips[left], self.clips[right]) for left, right in chosen], 0, self.options.clip_steps
        )
        sides = self.pair_rewards(user, self.clips, np.array(chosen))
        targets = np.array([TARGETS[teacher.answer(left, right, rng)] for left, right in sides])
        predicted = np.full(len(targets), np.nan)
        everything = SignalScale.of(SegmentPairs.cut(self.pairs_of(self.clips), 0, self.options.clip_steps))
        for seen in range(10, len(targets), 10):
            rows = np.arange(seen)
            model = reward_training.fit(shown.take(rows), targets[rows], "structured", seed, scale=everything).model
            following = np.arange(seen, min(seen + 10, len(targets)))
            predicted[following] = model.probability_right(shown.take(following))
        curve = {
            str(upto): prequential(predicted[:upto], targets[:upto])["overall"]["accuracy"]
            for upto in (20, 50, 100, 200)
            if upto <= len(targets)
        }
        curve["last 100"] = prequential(predicted[-100:], targets[-100:])["overall"]["accuracy"]
        return shown, targets, curve

    def accuracy(self, user: User, model: Any) -> dict[str, float]:
        """Against the user's true preference on pairs of other scenarios; all, and those on which users disagree."""
        pairs = self.pairs(self.test_clips)
        shown = SegmentPairs.cut(
            [(self.test_clips[left], self.test_clips[right]) for left, right in pairs], 0, self.options.clip_steps
        )
        wants = {each: np.diff(self.pair_rewards(each, self.test_clips, pairs).sum(-1))[:, 0] > 0 for each in User}
        right = (model.probability_right(shown) > 0.5) == wants[user]
        contested = np.any([wants[user] != wants[other] for other in User], axis=0)
        return {"all": float(right.mean()), "contested": float(right[contested].mean())}

    # -- rollouts

    def behaviours(self, first: int, scenarios: int) -> list[Trajectory]:
        """Four behaviours of every scenario, as the clip pool has them."""
        jobs = [
            (self.task.name, scenario, behaviour)
            for scenario in range(first, first + scenarios)
            for behaviour in laboratory.behaviours(self.task.name, scenario, 4)
        ]
        return self._cached(("behaviours", first, scenarios), lambda: list(self.pool.map(_behave, jobs, chunksize=8)))

    def collect(self, act: filter_problem.Act, scenarios: Sequence[int], noise: float, seed: int) -> list[Trajectory]:
        """See filter_problem.Collect."""
        job = partial(_roll, self.task.name, act, noise, seed)
        return list(self.pool.map(job, scenarios, chunksize=max(1, len(scenarios) // (4 * self.options.processes))))

    def _cached(self, key: tuple[Any, ...], make: Any) -> list[Trajectory]:
        policy = hashlib.sha256(b"".join(array.tobytes() for array in self.policy.weights.values())).hexdigest()
        name = hashlib.sha256(
            repr((self.task, key, policy, laboratory.behaviours(self.task.name, 1, 2))).encode()
        ).hexdigest()[:16]
        directory = self.options.cache / name
        if directory.exists():
            return [Trajectory.load(path) for path in sorted(directory.iterdir())]
        made: list[Trajectory] = make()
        partial_directory = directory.with_suffix(".partial")
        partial_directory.mkdir(parents=True, exist_ok=True)
        for number, trajectory in enumerate(made):
            trajectory.save(partial_directory / f"{number:05}.npz")
        partial_directory.rename(directory)
        return made

    # -- users

    def pairs(self, clips: list[Trajectory]) -> npt.NDArray[np.int64]:
        """(M, 2) rows of matched clips."""
        return acquisition.matched_pairs([each.scenario for each in clips])

    def pairs_of(self, clips: list[Trajectory]) -> list[tuple[Trajectory, Trajectory]]:
        """The same as trajectories."""
        return [(clips[left], clips[right]) for left, right in self.pairs(clips)]

    def pair_rewards(self, user: User, clips: list[Trajectory], pairs: npt.NDArray[np.int64]) -> Floats:
        """(M, 2, T) true preference rewards of what is shown."""
        steps = np.array([self.true_rewards(user, each)[: self.options.clip_steps] for each in clips])
        return steps[pairs]

    def true_rewards(self, user: User, trajectory: Trajectory) -> Floats:
        """(T,)"""
        return preference_rewards(self.task, trajectory.costs, trajectory.signals, OMEGA[user], self.form)

    def true_returns(self, user: User, trajectories: list[Trajectory]) -> Floats:
        """(N,)"""
        return np.array([self.true_rewards(user, each).sum() for each in trajectories])

    def gain(self, user: User, filtered: list[Trajectory]) -> tuple[float, float]:
        """Change of the true return in % of the reference's absolute mean, with the half width of its 95 % interval."""
        before = self.true_returns(user, self.reference)
        change = 100 * (self.true_returns(user, filtered) - before) / abs(before.mean())
        return round(float(change.mean()), 2), round(float(1.96 * change.std() / len(change) ** 0.5), 2)

    def own_minus_best_other(self, user: User, filtered: dict[User, list[Trajectory]]) -> tuple[float, float]:
        """The own filter's true return minus that of the best filter of somebody else, in the same unit."""
        unit = abs(self.true_returns(user, self.reference).mean()) / 100
        returns = {row: self.true_returns(user, each) / unit for row, each in filtered.items()}
        best = max((row for row in returns if row is not user), key=lambda row: float(returns[row].mean()))
        change = returns[user] - returns[best]
        return round(float(change.mean()), 2), round(float(1.96 * change.std() / len(change) ** 0.5), 2)


def _table(matrix: dict[str, Any], best: dict[str, Any]) -> str:
    rows = [
        f"{row:>10} " + "  ".join(f"{mean:+6.1f}+-{half:3.1f}" for mean, half in each.values())
        for row, each in matrix.items()
    ]
    return "\n".join([*rows, "own - best other " + str(best)])


def _behave(job: tuple[str, int, Behaviour]) -> Trajectory:
    task, scenario, behaviour = job
    act, reference = laboratory.act_as(task, behaviour), laboratory.reference_policy(task).mean
    return rollout(laboratory.environment(task), act, scenario, reference)


def _roll(task: str, act: filter_problem.Act, noise: float, seed: int, scenario: int) -> Trajectory:
    noisy = filter_problem.noisy(act, noise, seed, scenario)
    return rollout(laboratory.environment(task), noisy, scenario, laboratory.reference_policy(task).mean)


def _settle() -> None:
    os.nice(5)
    torch.set_num_threads(1)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--task", choices=ENVIRONMENTS, default="feeding")
    parser.add_argument("--clip-steps", type=int, default=60, help="control steps shown, from the start")
    parser.add_argument("--labels", type=int, default=200)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--evaluation", type=int, default=200, help="unseen scenarios")
    parser.add_argument("--pool-scenarios", type=int, default=36)
    parser.add_argument("--form", choices=["calibrated", "paper"], default="calibrated")
    parser.add_argument("--method", choices=["studio", "printed"], default="studio")
    parser.add_argument("--reward", choices=get_args(reward_training.Kind), default="structured")
    parser.add_argument("--no-residual", action="store_true")
    parser.add_argument("--preference-weight", type=float, default=0.3)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--cache", type=Path, default=Path("data/benchmark"))
    parser.add_argument("--output", type=Path)
    return parser.parse_args()


if __name__ == "__main__":
    main()
