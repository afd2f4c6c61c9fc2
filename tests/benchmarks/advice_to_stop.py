"""Whether the advice to stop asking can be trusted: the expected regret beside the true one, by number of answers.

    python -m tests.benchmarks.advice_to_stop

The paper's users answer with one label seed that no table uses. Expected: worker.ml.stopping, in standard deviations of
predicted return over all modes. True: how much less than the best mode the picked one gains on the response surface,
in % of what the user minds and likes under the reference policy. Minutes.
"""

import argparse
import sys
from pathlib import Path

import torch

from app.installed_tasks import catalogue
from tests.benchmarks.chosen_modes import FIRST_SEED, UnkeptBench, stake
from worker.compute.simulation import surface_file
from worker.experiments.benchmark_cell import PAPER_USERS, BenchmarkConfig, Cell
from worker.experiments.rollout_cache import RolloutCache
from worker.ml.filters.response_surface import ResponseSurface, best_mode
from worker.ml.stopping import expected_regret
from worker.ml.teachers import Taste
from worker.sim.costs import signal_weights
from worker.tasks import registry

COUNTS = (20, 40, 60, 80, 100, 120, 150, 200)
WORK = Path("data/benchmark/rollouts")


def main() -> None:
    """Print one Markdown row per task and user."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.parse_args()
    torch.set_num_threads(1)
    sys.stdout.write("| task, user | " + " | ".join(map(str, COUNTS)) + " |\n" + "|---" * (1 + len(COUNTS)) + "|\n")
    for task in catalogue.names():
        for taste in PAPER_USERS.values():
            sys.stdout.write(f"| {task}, {taste.name} | " + " | ".join(_regrets(task, taste)) + " |\n")
            sys.stdout.flush()


def _regrets(name: str, taste: Taste) -> list[str]:
    """Expected / true, for each number of answers."""
    task = registry.task(name)
    surface = ResponseSurface.load(surface_file(name), task.modes)
    wish, unit = signal_weights(task, taste.omega, taste.per_signal), stake(task, taste) / 100
    most = float(surface.predict(best_mode(surface, wish, 0))[0] @ wish)
    found = []
    for count in COUNTS:
        bench = UnkeptBench(
            Cell(name, taste, "pbarl", FIRST_SEED), BenchmarkConfig(labels=count), RolloutCache(name, WORK), WORK
        )
        members = bench.reward.signal_weights([])
        gained = float(surface.predict(best_mode(surface, members, FIRST_SEED))[0] @ wish)
        found.append(f"{expected_regret(surface, members):.2f} / {(most - gained) / unit:.1f} %")
    return found


if __name__ == "__main__":
    main()
