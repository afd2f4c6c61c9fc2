"""Refines policies once for everybody, from which refinements begin: ``python -m worker archive-policies --task NAME``.

Each is for somebody who minds one signal especially, and begins as the best that was found for those before. What is
finished is kept, and the last training goes on from its checkpoint, so an interrupted run goes on where it was.
"""

import json
import platform
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

from app.installed_tasks.by_name import usual_clip_steps
from worker.compute import learning, shared_reward, simulation
from worker.domain.scenarios import POOL, first_of
from worker.domain.trajectory import Trajectory
from worker.domain.type_aliases import Act, Float32Array
from worker.experiments.rollout_cache import RolloutCache
from worker.ml.acquisition import matched_pairs
from worker.ml.filters.fitting.filter_problem import FilterConfig, FilterProblem
from worker.ml.filters.fitting.mode_search import find_mode
from worker.ml.filters.fitting.response_surface import ResponseSurface
from worker.ml.policies.checkpoint import Checkpoint
from worker.ml.policies.gaussian import GaussianPolicy
from worker.ml.reinforcement.archived_policy import ArchivedPolicy, best_beginning
from worker.ml.reinforcement.preference_rl import PolicyAct
from worker.ml.reinforcement.refinement import Beginning, Refinement, refine
from worker.ml.reinforcement.refinement_gate import gate_refined
from worker.ml.rewards.loading import load_reward_model
from worker.ml.rewards.reward_models import RewardModel
from worker.ml.rewards.segments import SegmentPairs
from worker.ml.rewards.signal_scale import SignalScale
from worker.sim.costs import signal_weights
from worker.tasks import registry

POOL_SCENARIOS = 48
"""each in six behaviours, as in a study: what the replays begin with"""
ESPECIALLY = 2.0
"""times as much what is minded especially differs in a pair as everything else does, by the weights"""


class NothingToRefine(ValueError):
    """No policy can be refined for this task."""


@dataclass(frozen=True)
class Archetype:
    """Neutral but for one signal."""

    name: str
    signal: str = ""
    sign: float = -1.0
    """above 0: wants more of it"""


ARCHETYPES = (
    Archetype("even"),
    Archetype("turns_little", "turn_speed_squared_rad2_s2"),
    Archetype("level", "tilt_rad"),
    Archetype("soon", "undelivered"),
    Archetype("smooth", "acceleration_squared_m2_s4"),
    Archetype("slow_near", "near_speed_squared_m2_s2"),
    Archetype("clean", "spilled"),
    Archetype("fast_near", "near_speed_squared_m2_s2", 1.0),
)


def archive_policies(
    task: str,
    work_directory: Path,
    archetypes: Sequence[Archetype] = ARCHETYPES,
    config: Refinement | None = None,
    gates: FilterConfig | None = None,
) -> dict[str, Any]:
    """Refine policies for people who mind one signal each, from which everybody's refinement may begin, and record it.

    Six to ten minutes for each of them, one after the other: every one begins as the best of those before.
    Raises NothingToRefine for a laboratory's task, and for one without a response surface.
    """
    if registry.task(task).is_a_labs:
        raise NothingToRefine(f"{task} is a laboratory's task, whose filters are not refined.")
    if not simulation.surface_file(task).exists():
        raise NothingToRefine(f"There is no response surface; `python -m worker explore --task {task}` fits one.")
    torch.set_num_threads(1)
    work_directory.mkdir(parents=True, exist_ok=True)
    making = _Making(task, work_directory, config or Refinement(), gates or FilterConfig())
    for number, archetype in enumerate(tqdm(archetypes, unit="policy")):
        making.refine(archetype, number)
    target = simulation.archive_folder(task)
    shutil.rmtree(target, ignore_errors=True)
    target.mkdir(parents=True)
    for each in making.found:
        if each["kept"]:
            shutil.copy(making.policy_file(each["name"]), target)
    record = {
        "command": f"python -m worker archive-policies --task {task}",
        "steps": making.config.steps,
        "archetypes": making.found,
        "versions": {"python": platform.python_version(), "numpy": np.__version__, "torch": torch.__version__},
    }
    (target / "archive.json").write_text(json.dumps(record, indent=2) + "\n")
    return record


class _Making:
    """The archive of one task in the making."""

    def __init__(self, task: str, work: Path, config: Refinement, gates: FilterConfig) -> None:
        self.name, self.task, self.work, self.config, self.gates = task, registry.task(task), work, config, gates
        self.rollouts = RolloutCache(task, work / "rollouts")
        self.pool = self.rollouts.pool(first_of(POOL, POOL_SCENARIOS))
        self.pairs, self.scale = self._shown()
        self.archived: list[ArchivedPolicy] = []
        self.found: list[dict[str, Any]] = []

    def refine(self, archetype: Archetype, seed: int) -> None:
        """Refine a policy for somebody, unless that is done; what is no better than where it began is not kept."""
        record, file = self.work / f"{archetype.name}.json", self.policy_file(archetype.name)
        if not record.exists():
            policy, reward = simulation.reference_policy(self.name), self._reward(archetype)
            problem = FilterProblem(self.task, policy, reward, seed, self.gates)
            refined, trials = self._refined(problem, self.work / f"{archetype.name}-training")
            if refined:
                GaussianPolicy(dict(refined)).save(file)
            record.write_text(json.dumps({**asdict(archetype), "kept": bool(refined), "trials": trials}))
        self.found.append(json.loads(record.read_text()))
        if file.exists():
            policy, gate = GaussianPolicy.load(file), self.gates.gate_block(self.task)
            self.archived.append(ArchivedPolicy(policy, self._collect(PolicyAct(policy), gate, 0.0, 0)))

    def policy_file(self, name: str) -> Path:
        """Where somebody's policy is kept."""
        return self.work / f"{name}.safetensors"

    def _refined(self, problem: FilterProblem, folder: Path) -> tuple[Mapping[str, Float32Array], list[dict[str, Any]]]:
        """The policy's weights, none where it began as well as it ended, and what was tried."""
        config, reference = problem.config, self.rollouts.reference
        gate, watched = reference(config.gate_block(self.task)), reference(config.watch_block(self.task))
        surface = ResponseSurface.load(simulation.surface_file(self.name), self.task.modes, self.task.signals)
        mode = find_mode(problem, surface, self.pool, gate, self._collect)
        start, archived = best_beginning(problem, mode, self.archived, gate)
        folder.mkdir(exist_ok=True)
        make_env = registry.environment_class(self.name)
        beginning = Beginning(make_env, self.pool.rollouts, gate, watched, self._collect, archived)
        drafts = refine(problem, start, beginning, self.config, Checkpoint(folder))
        check = partial(reference, config.check_block(self.task))
        gated = gate_refined(problem, start, drafts, gate, check, self._collect)
        shutil.rmtree(folder)
        weights = gated.weights
        is_new = weights.gate == 1.0 and weights.refined is not start.weights.refined
        return weights.refined if is_new else {}, [asdict(trial) for trial in gated.trials]

    def _collect(self, act: Act, scenarios: Sequence[int], noise: float, seed: int) -> list[Trajectory]:
        return learning.run_scenarios(self.name, act, scenarios, noise, seed)

    def _shown(self) -> tuple[SegmentPairs, SignalScale]:
        rollouts, steps = self.pool.rollouts, usual_clip_steps(self.name)
        rows = matched_pairs([each.scenario for each in rollouts])
        pairs = SegmentPairs.cut([(rollouts[left], rollouts[right]) for left, right in rows], 0, steps)
        return pairs, SignalScale.of(pairs, [each.signals.mean(axis=0, dtype=np.float64) for each in rollouts])

    def _reward(self, archetype: Archetype) -> RewardModel:
        """What somebody wants, as it would be learned from answers without number."""
        wants = signal_weights(self.task)
        if archetype.signal:
            column = self.task.signals.index(archetype.signal)
            usual = float((self.pairs.signal_differences() @ wants).std())
            wants[column] += archetype.sign * ESPECIALLY * usual / self.scale.spread[column]
        return load_reward_model(shared_reward.reward_of(self.name, wants[None], self.scale))
