"""How fast the simulations are on one core, beside the benchmark's (Assistive Gym v1.0) figures.

    python -m tests.benchmarks.sim_speed --resets 10000

prints in a minute what docs/results/simulation.md shows:

CPU seconds of this process, with random actions as in the benchmark's measurement and with the shipped policy's. Steps
are timed without resets. The physics share is the time inside the engine's own stepping, the floor that no Python can
beat.
"""

import argparse
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from app.installed_tasks import catalogue
from worker.ml.policies.gaussian import GaussianPolicy
from worker.sim.assistive import AssistiveEnv
from worker.tasks.drinking.environment import DrinkingEnv
from worker.tasks.registry import checkpoint, environment_class

BENCHMARK_STEPS_PER_S = {"feeding": 160.0, "drinking": 21.0, "scratching": 268.0}
"""Medians measured on a comparable core (facts sheet of Assistive Gym v1.0); Drinking with 64 pellets."""
WANTED_RATIO = {"feeding": 10, "drinking": 20, "scratching": 12}
PELLETS = (16, 32, 64)

RESETS = 300


def main() -> None:
    """Print one row per task and number of pellets, then how memory grows over many resets."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--resets", type=int, default=10_000, help="resets over which memory must not grow")
    parser.add_argument("--episodes", type=int, default=20, help="whose steps are timed")
    options = parser.parse_args()
    sys.stdout.write("| task | random steps/s | x benchmark (wanted) | physics share | policy steps/s | reset ms |\n")
    sys.stdout.write("|---|---|---|---|---|---|\n")
    for name, kind in ((name, environment_class(name)) for name in catalogue.names()):
        if name == "drinking":
            for pellets in PELLETS:
                _row(f"{name}, {pellets} pellets", name, partial(DrinkingEnv, pellets=pellets), options.episodes)
        else:
            _row(name, name, kind, options.episodes)
    for name, kind in ((name, environment_class(name)) for name in catalogue.names()):
        sys.stdout.write(f"{name}: {_growth_kib(kind(), options.resets):+d} KiB over {options.resets} resets\n")


def _row(label: str, name: str, make: Callable[[], AssistiveEnv], episodes: int) -> None:
    env, rng = make(), np.random.default_rng(0)
    policy = GaussianPolicy.load(checkpoint(name) / "policy.safetensors")
    env.reset(seed=0)
    reset_s = _cpu_s(lambda: [env.reset(seed=scenario) for scenario in range(RESETS)]) / RESETS
    acting_s, physics_share = _stepping(env, lambda _: rng.uniform(-1, 1, 7).astype(np.float32), episodes)
    policy_s, _ = _stepping(env, policy.mean, episodes)
    ratio = 1 / acting_s / BENCHMARK_STEPS_PER_S[name]
    sys.stdout.write(
        f"| {label} | {1 / acting_s:.0f} | {ratio:.1f} ({WANTED_RATIO[name]}) | {100 * physics_share:.0f} % "
        f"| {1 / policy_s:.0f} | {1e3 * reset_s:.2f} |\n"
    )
    sys.stdout.flush()
    env.close()


def _stepping(env: AssistiveEnv, act: Callable[[np.ndarray], np.ndarray], episodes: int) -> tuple[float, float]:
    """CPU seconds per environment step, and the share of it inside the engine's stepping."""
    engine = _Stopwatch(env._world.step)
    env._world.step = engine  # type: ignore[method-assign]
    spent, steps = 0.0, env.task.episode_steps
    for scenario in range(episodes):
        observation, _ = env.reset(seed=scenario)
        actions_s = 0.0
        start = time.process_time()
        for _ in range(steps):
            before = time.process_time()
            action = act(observation)
            actions_s += time.process_time() - before
            observation, *_ = env.step(action)
        spent += time.process_time() - start - actions_s
    del env._world.step  # the class' own method again
    return spent / (episodes * steps), engine.seconds / spent


def _growth_kib(env: AssistiveEnv, resets: int) -> int:
    for scenario in range(500):
        env.reset(seed=scenario)
    before = _resident_kib()
    for scenario in range(resets):
        env.reset(seed=scenario)
    grown = _resident_kib() - before
    env.close()
    return grown


def _resident_kib() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4


class _Stopwatch:
    def __init__(self, act: Callable[[], None]) -> None:
        self._act = act
        self.seconds = 0.0

    def __call__(self) -> None:
        start = time.process_time()
        self._act()
        self.seconds += time.process_time() - start


def _cpu_s(act: Callable[[], object]) -> float:
    start = time.process_time()
    act()
    return time.process_time() - start


if __name__ == "__main__":
    main()
