"""Rollouts of the behaviours that a study's pool would show, made once and kept under data/ as plain arrays.

    python -m tests.benchmarks.pool_rollouts --task feeding --first 10800000 --scenarios 170

A block of scenarios is one file, so that an interrupted run goes on where it stopped.
"""

import argparse
import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np
import numpy.typing as npt
from tqdm import tqdm

from app.installed_tasks import catalogue
from worker.compute import simulation
from worker.domain.type_aliases import Float32Array
from worker.ml.acquisition import matched_pairs
from worker.ml.rewards.segments import SegmentPairs
from worker.sim.rollout import rollout
from worker.tasks import registry

Indices = npt.NDArray[np.int64]

PER_SCENARIO = 4
BLOCK = 10
DIRECTORY = Path("data/pool_rollouts")


@dataclass(frozen=True)
class Pool:
    """C clips of T steps, four behaviours of each scenario."""

    signals: Float32Array
    """(C, T, S)"""
    observations: Float32Array
    """(C, T, D)"""
    actions: Float32Array
    """(C, T, 7)"""
    costs: Float32Array
    """(C, T, 6)"""
    scenarios: Indices
    """(C,)"""

    def pairs(self) -> Indices:
        """(M, 2) rows of the clips of every matched pair."""
        return matched_pairs(self.scenarios)

    def segments(self, rows: Indices) -> SegmentPairs:
        """The pairs of clips in (N, 2) rows."""
        return SegmentPairs(self.signals[rows], self.observations[rows], self.actions[rows])

    @classmethod
    def joined(cls, parts: "list[Pool]") -> Self:
        """One after the other."""
        names = ("signals", "observations", "actions", "costs", "scenarios")
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


def pool_rollouts(task: str, first: int, scenarios: int, steps: int, directory: Path = DIRECTORY) -> Pool:
    """The first ``steps`` of four behaviours of ``scenarios`` consecutive scenarios; made when not yet there."""
    starts = range(first, first + scenarios, BLOCK)
    blocks = [
        _block(task, start, min(BLOCK, first + scenarios - start), directory)
        for start in tqdm(starts, desc=f"{task} pool", unit="block", mininterval=5)
    ]
    whole = Pool.joined(blocks)
    return Pool(
        whole.signals[:, :steps],
        whole.observations[:, :steps],
        whole.actions[:, :steps],
        whole.costs[:, :steps],
        whole.scenarios,
    )


def _block(task: str, first: int, scenarios: int, directory: Path) -> Pool:
    path = directory / f"{task}-{_fingerprint(task)}" / f"{first}-{scenarios}.npz"
    if not path.exists():
        made = _roll(task, first, scenarios)
        path.parent.mkdir(parents=True, exist_ok=True)
        unfinished = path.with_suffix(".partial.npz")
        np.savez(unfinished, allow_pickle=False, **vars(made))
        unfinished.rename(path)
    with np.load(path, allow_pickle=False) as stored:
        return Pool(**{name: stored[name] for name in stored.files})


def _roll(task: str, first: int, scenarios: int) -> Pool:
    made = [
        rollout(simulation.environment(task), simulation.act_as(task, behaviour), scenario)
        for scenario in range(first, first + scenarios)
        for behaviour in simulation.behaviours(task, scenario, PER_SCENARIO)
    ]
    return Pool(
        np.stack([each.signals for each in made]),
        np.stack([each.observations[: len(each)] for each in made]),
        np.stack([each.actions for each in made]),
        np.stack([each.costs for each in made]),
        np.array([each.scenario for each in made]),
    )


def _fingerprint(task: str) -> str:
    """Changes with the policy and with the modes that are drawn; a change of the physics needs an empty folder."""
    weights = simulation.reference_policy(task).weights
    policy = b"".join(np.ascontiguousarray(weights[name]).tobytes() for name in sorted(weights))
    drawn = repr([simulation.behaviours(task, scenario, PER_SCENARIO) for scenario in range(3)])
    return hashlib.sha256(policy + drawn.encode()).hexdigest()[:12]


def main() -> None:
    """Make rollouts ahead of time."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--task", choices=catalogue.names(), default="feeding")
    parser.add_argument("--first", type=int, required=True)
    parser.add_argument("--scenarios", type=int, required=True)
    parser.add_argument("--directory", type=Path, default=DIRECTORY, help="where they are kept")
    options = parser.parse_args()
    steps = registry.task(options.task).episode_steps
    pool_rollouts(options.task, options.first, options.scenarios, steps, options.directory)


if __name__ == "__main__":
    main()
