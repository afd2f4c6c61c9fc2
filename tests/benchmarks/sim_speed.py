"""How fast the Feeding simulation is on one core, with the shipped policy.

Run: python -m tests.benchmarks.sim_speed    (about five seconds)
"""

import sys
import time
from collections.abc import Callable
from pathlib import Path

import worker
from worker.ml.policies import GaussianPolicy
from worker.sim.feeding import EPISODE_STEPS, FeedingEnv

EPISODES = 20
RESETS = 200
POLICY = Path(worker.__file__).parent / "checkpoints" / "feeding" / "policy.safetensors"


def main() -> None:
    """Print steps per second of CPU time, milliseconds per reset, and the share of the engine's own stepping."""
    policy = GaussianPolicy.load(POLICY)
    start = time.process_time()
    env = FeedingEnv()
    env.reset(seed=0)
    constructing = time.process_time() - start
    resetting = _seconds(lambda: [env.reset(seed=scenario) for scenario in range(RESETS)]) / RESETS
    engine = _Stopwatch(env._world.step)
    env._world.step = engine  # type: ignore[method-assign]
    stepping = 0.0
    for scenario in range(EPISODES):
        observation, _ = env.reset(seed=scenario)
        start = time.process_time()
        for _ in range(EPISODE_STEPS):
            observation, *_ = env.step(policy.mean(observation))
        stepping += time.process_time() - start
    acting = _seconds(lambda: [policy.mean(observation) for _ in range(1000)]) / 1000
    steps = EPISODES * EPISODE_STEPS
    lines = (
        f"first construction and reset  {1e3 * constructing:8.1f} ms",
        f"reset                         {1e3 * resetting:8.2f} ms",
        f"environment and policy        {steps / stepping:8.0f} steps/s",
        f"of that the physics engine    {100 * engine.seconds / stepping:8.0f} %",
        f"of that the policy            {100 * acting * steps / stepping:8.1f} %",
    )
    sys.stdout.write("\n".join(lines) + "\n")
    env.close()


class _Stopwatch:
    def __init__(self, act: Callable[[], None]) -> None:
        self._act = act
        self.seconds = 0.0

    def __call__(self) -> None:
        start = time.process_time()
        self._act()
        self.seconds += time.process_time() - start


def _seconds(act: Callable[[], object]) -> float:
    start = time.process_time()
    act()
    return time.process_time() - start


if __name__ == "__main__":
    main()
