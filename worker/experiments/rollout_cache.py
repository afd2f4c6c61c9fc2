"""Rollouts that many fits need, kept on disk: one file per rollout, complete or absent, made by whoever comes first."""

import hashlib
from collections.abc import Callable, Sequence
from functools import cache, lru_cache
from pathlib import Path

from worker.compute import simulation
from worker.compute.archived import Archived, everything_archived
from worker.compute.behaviours import Behaviour
from worker.domain.trajectory import Trajectory
from worker.domain.type_aliases import Act
from worker.ml.filters.fitting.filter_problem import FilterConfig
from worker.ml.filters.fitting.pool import Pool
from worker.ml.policies.reference import ReferencePolicy
from worker.ml.reinforcement.archived_policy import ArchivedPolicy
from worker.tasks import registry
from worker.whole_files import written_whole

BEHAVIOURS_PER_SCENARIO = 6
"""As in a study (StudySettings.behaviours_per_scenario)."""


class RolloutCache:
    """The rollouts of one task and one frozen policy."""

    def __init__(self, task: str, directory: Path) -> None:
        self.task = task
        self.directory = directory / f"{task}-{policy_mark(task)}"
        self.directory.mkdir(parents=True, exist_ok=True)

    def reference(self, scenarios: Sequence[int]) -> list[Trajectory]:
        """The frozen policy's deterministic action in these scenarios."""
        return [self._reference(scenario) for scenario in scenarios]

    def behaviours(self, scenarios: Sequence[int]) -> list[Trajectory]:
        """Several behaviours of each scenario, as a pool of clips has them."""
        return [each for scenario in scenarios for each in self._behaviours(scenario)]

    def pool(self, scenarios: Sequence[int]) -> Pool:
        """These behaviours, and how each was done."""
        drawn = [simulation.behaviours(self.task, each, BEHAVIOURS_PER_SCENARIO) for each in scenarios]
        return Pool(self.behaviours(scenarios), [each.described() for some in drawn for each in some])

    def archived(self, scenarios: Sequence[int]) -> list[ArchivedPolicy]:
        """The task's policies that were refined beforehand, as they are and in archived modes, in these scenarios."""
        return [self._archived(each, scenarios) for each in everything_archived(self.task)]

    def _archived(self, found: Archived, scenarios: Sequence[int]) -> ArchivedPolicy:
        kept_as = f"archived-{weights_mark(found.policy, repr(found.mode).encode() if found.mode else b'')}"
        gate = FilterConfig().gate_block(registry.task(self.task))
        exported = cache(lambda: found.exported(self.reference(gate)))
        driven = [self._driven(exported, f"{kept_as}-{each}", each) for each in scenarios]
        return ArchivedPolicy(found.policy, driven, found.around, found.mode)

    def _reference(self, scenario: int) -> Trajectory:
        return self._driven(lambda: simulation.reference_policy(self.task).mean, f"reference-{scenario}", scenario)

    def _behaviours(self, scenario: int) -> list[Trajectory]:
        drawn = simulation.behaviours(self.task, scenario, BEHAVIOURS_PER_SCENARIO)
        return [self._behaviour(scenario, index, behaviour) for index, behaviour in enumerate(drawn)]

    def _behaviour(self, scenario: int, index: int, behaviour: Behaviour) -> Trajectory:
        return self._driven(lambda: simulation.act_as(self.task, behaviour), f"behaviour-{scenario}-{index}", scenario)

    def _driven(self, act: Callable[[], Act], kept_as: str, scenario: int) -> Trajectory:
        path = self.directory / f"{kept_as}.npz"
        if not path.exists():
            driven = simulation.run_episode(self.task, act(), scenario)
            with written_whole(path) as draft:
                driven.save(draft)
        return _load(path)


def policy_mark(task: str) -> str:
    """Eight characters that change with the task's frozen policy and with anything its description says."""
    description = repr(registry.task(task)).encode()
    return weights_mark(simulation.reference_policy(task), description)


def weights_mark(policy: ReferencePolicy, before: bytes = b"") -> str:
    mark = hashlib.sha256(before)
    for name, array in sorted(policy.weights.items()):
        mark.update(name.encode() + array.tobytes())
    return mark.hexdigest()[:8]


@lru_cache(maxsize=2_000)
def _load(path: Path) -> Trajectory:
    return Trajectory.load(path)
