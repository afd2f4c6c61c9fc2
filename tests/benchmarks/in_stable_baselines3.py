"""Is our SAC as good a learner as Stable-Baselines3's? Both on one cell: the same environment, reward, sizes and steps.

    python -m tests.benchmarks.in_stable_baselines3 --output docs/results/sac

A residual of at most 0.5 around Feeding's frozen policy, as in residual_rl but with plain exploration, on the neutral
user's learned reward of single steps less the cost of undone ones (whole episodes, as ours rewards them otherwise, are
nothing that Stable-Baselines3 can be told). Each learner and seed is a row; finished ones are kept.
"""

import argparse
import os
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from stable_baselines3 import SAC
from stable_baselines3.common.vec_env import DummyVecEnv
from tqdm import tqdm

from tests.benchmarks import result_tables
from worker.analysis.comparison import result_pages
from worker.compute import learning
from worker.domain.scenarios import EVALUATION, first_of
from worker.domain.trajectory import SIGNALS
from worker.domain.type_aliases import Act, Float32Array
from worker.experiments.benchmark_cell import PAPER_USERS, BenchmarkConfig, BenchmarkUser, Cell
from worker.experiments.rollout_cache import RolloutCache
from worker.ml.methods import steered_rl
from worker.ml.methods.residual_rl import Corrected
from worker.ml.methods.steered_rl import Steering
from worker.ml.policies.gaussian import GaussianPolicy
from worker.ml.reinforcement.preference_rl import TRAINING_SCENARIOS, EpisodeReward
from worker.ml.rewards.reward_models import UNDONE, RewardModel
from worker.tasks import registry

TITLE = "# Our SAC beside Stable-Baselines3's"
TASK, USER = "feeding", "neutral"
CHECKED = 100
"""unseen scenarios of the evaluation"""
SKIP = 30_000


def main() -> None:
    """Train what has no row yet."""
    options = _options()
    torch.set_num_threads(1)
    table = options.output.with_suffix(".csv")
    rows: list[Mapping[str, Any]] = list(result_tables.read(table))
    known = {(row["learner"], int(row["seed"])) for row in rows}
    work = options.work_directory
    cell = Cell(TASK, PAPER_USERS[USER], "residual_rl", 0)
    bench = BenchmarkUser(cell, BenchmarkConfig(), RolloutCache(TASK, work / "rollouts"), work)
    runs = [(name, seed) for seed in options.seeds for name in LEARNERS if (name, seed) not in known]
    for name, seed in tqdm(runs, unit="training"):
        started = time.process_time()
        act = LEARNERS[name](bench, Steering(steps=options.steps), seed)
        row = {"learner": name, "seed": seed, "steps": options.steps, "cpu_s": round(time.process_time() - started)}
        rows.append({**row, **_measured(act, bench)})
        _write(rows, options.output)
    _write(rows, options.output)


def _ours(bench: BenchmarkUser, config: Steering, seed: int) -> Act:
    problem = bench.setting().problem
    decoder = Corrected(_policy(bench), config.residual_bound)

    def as_said(said: Float32Array, steps: int, rng: np.random.Generator) -> Float32Array:
        return said

    def anywhere(shape: tuple[int, int], rng: np.random.Generator) -> Float32Array:
        return rng.uniform(-1, 1, shape).astype(np.float32)

    make_env = registry.environment_class(TASK)
    reward = _of_steps(problem.reward)
    return steered_rl.steer(
        make_env, decoder, anywhere, as_said, reward, _policy(bench), problem.task.observation, config, seed
    )


def _theirs(bench: BenchmarkUser, config: Steering, seed: int) -> Act:
    policy = _policy(bench)
    decoder = Corrected(policy, config.residual_bound)
    reward = _of_steps(bench.setting().problem.reward)
    drawn = np.random.default_rng([seed, 6])

    def make_env() -> gymnasium.Env[Any, Any]:
        return _Paid(registry.environment_class(TASK)(), policy, decoder, reward, config.undone_cost, drawn)

    usual = steered_rl._settings(bench.task.observation, config, seed)
    model = SAC(
        "MlpPolicy",
        DummyVecEnv([make_env] * config.environments),
        learning_rate=config.learning_rate,
        buffer_size=config.steps,
        learning_starts=config.warm_up_steps,
        batch_size=usual.batch,
        tau=usual.target_rate,
        gamma=config.discount,
        train_freq=1,
        gradient_steps=round(usual.updates_per_step * config.environments),
        ent_coef=f"auto_{usual.initial_temperature}",
        target_entropy=usual.target_entropy,
        policy_kwargs={"net_arch": [config.hidden, config.hidden]},
        seed=seed,
        device="cpu",
    )
    model.learn(config.steps)

    def act(observation: Float32Array) -> Float32Array:
        said, _ = model.predict(_scaled(observation, policy), deterministic=True)
        return decoder(observation, np.asarray(said, np.float32))

    return act


LEARNERS = {"ours": _ours, "Stable-Baselines3": _theirs}


class _Paid(gymnasium.Wrapper[Any, Any, Any, Any]):
    """The environment as ours is trained in it: standardised observations, the decoder's input, the learned reward."""

    def __init__(
        self,
        env: gymnasium.Env[Any, Any],
        policy: GaussianPolicy,
        decoder: Corrected,
        reward: EpisodeReward,
        undone_cost: float,
        drawn: np.random.Generator,
    ) -> None:
        super().__init__(env)
        self._policy, self._decoder, self._reward = policy, decoder, reward
        self._undone_cost, self._drawn = undone_cost, drawn
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (len(policy.offset),), np.float32)
        self._seen: Float32Array = np.zeros(0, np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """A random scenario of those of trainings."""
        self._seen, info = self.env.reset(seed=int(self._drawn.integers(TRAINING_SCENARIOS)))
        return _scaled(self._seen, self._policy), info

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """See gymnasium.Env."""
        executed = self._decoder(self._seen, np.asarray(action, np.float32))
        before = self._seen
        self._seen, _, ended, cut, info = self.env.step(executed)
        signals = np.array([[info["signals"][name] for name in SIGNALS]], np.float32)
        paid = float(self._reward(signals, before[None], executed[None])[0])
        paid -= self._undone_cost * float(signals[0, SIGNALS.index(UNDONE)] > 0.0)
        return _scaled(self._seen, self._policy), paid, ended, cut, info


def _policy(bench: BenchmarkUser) -> GaussianPolicy:
    policy = bench.setting().problem.policy
    assert isinstance(policy, GaussianPolicy)
    return policy


def _of_steps(reward: RewardModel) -> EpisodeReward:
    """The mean over the members of what single steps are worth."""
    return lambda signals, observations, actions: reward.step_rewards(signals, observations, actions).mean(axis=0)


def _scaled(observation: Float32Array, policy: GaussianPolicy) -> Float32Array:
    return np.asarray((observation - policy.offset) * policy.scale, np.float32)


def _measured(act: Act, bench: BenchmarkUser) -> Mapping[str, Any]:
    """What the trained actor's mean earns beyond the frozen policy, per episode, in units of a step's deviation."""
    scenarios = first_of(EVALUATION, CHECKED, skip=SKIP)
    reference = bench.rollout_cache.reference(scenarios)
    driven = learning.run_scenarios(TASK, act, scenarios, 0.0, 0)
    reward = _of_steps(bench.reward)
    undone, cost = SIGNALS.index(UNDONE), Steering().undone_cost
    earned = [
        np.array(
            [
                float(np.sum(reward(t.signals, t.observations[:-1], t.actions) - cost * (t.signals[:, undone] > 0.0)))
                for t in some
            ]
        )
        for some in (reference, driven)
    ]
    gain = earned[1] - earned[0]
    return {
        "gain": f"{gain.mean():.2f}",
        "gain_error": f"{gain.std(ddof=1) / len(gain) ** 0.5:.3f}",
        "successes": sum(each.success for each in driven),
        "successes_reference": sum(each.success for each in reference),
    }


def _write(rows: Sequence[Mapping[str, Any]], output: Path) -> None:
    if not rows:
        return
    result_tables.write(output.with_suffix(".csv"), rows)
    lines = [
        "| learner | seed | steps | gain per episode | success | of the frozen policy | processor s |",
        "|---" * 7 + "|",
    ]
    for row in sorted(rows, key=lambda each: (each["learner"], int(each["seed"]))):
        mean, half = float(row["gain"]), 1.96 * float(row["gain_error"])
        lines.append(
            f"| {row['learner']} | {row['seed']} | {row['steps']}"
            f" | {mean:+.1f} [{mean - half:+.1f}, {mean + half:+.1f}]"
            f" | {row['successes']} | {row['successes_reference']} | {row['cpu_s']} |"
        )
    page = output.with_suffix(".md")
    page.write_text(result_pages.page(page, TITLE, "\n".join(lines)))


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=60_000)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1])
    parser.add_argument("--work-directory", type=Path, default=Path("data/benchmark"))
    parser.add_argument(
        "--output", type=result_tables.stem, required=True, help="path without ending of the page and the table"
    )
    return parser.parse_args()


if __name__ == "__main__":
    os.nice(19 - os.nice(0))
    main()
