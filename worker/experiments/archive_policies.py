"""Refines policies once for everybody, from which refinements begin: ``python -m worker archive-policies --task NAME``.

Each is for somebody who minds one signal especially, and begins as the best that was found for anybody. What is
finished is archived at once, and the last training goes on from its checkpoint, so an interrupted run goes on where it
was; with another work directory everybody is refined once more, from the best that is archived by then.
"""

import json
import platform
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

from app.installed_tasks.by_name import usual_clip_steps
from worker.compute import learning, shared_reward, simulation
from worker.domain.scenarios import POLICY_TEST, POOL, RESPONSE_SURFACE, first_of
from worker.domain.trajectory import Trajectory
from worker.domain.type_aliases import Act, Float32Array
from worker.experiments.fit_response_surface import BLOCK, Block, compare_block, joined, random_modes
from worker.experiments.rollout_cache import RolloutCache
from worker.ml.acquisition import matched_pairs
from worker.ml.filters.fitting.filter_problem import FilterConfig, FilterProblem
from worker.ml.filters.fitting.gate import successes
from worker.ml.filters.fitting.mode_search import find_mode
from worker.ml.filters.fitting.response_surface import ResponseSurface
from worker.ml.policies.checkpoint import Checkpoint
from worker.ml.policies.gaussian import GaussianPolicy
from worker.ml.reinforcement.archived_policy import ArchivedPolicy, best_archived
from worker.ml.reinforcement.preference_rl import PolicyAct
from worker.ml.reinforcement.refinement import Beginning, Refinement, refine
from worker.ml.reinforcement.refinement_gate import begin_as, gate_refined
from worker.ml.rewards.loading import load_reward_model
from worker.ml.rewards.reward_models import RewardModel
from worker.ml.rewards.segments import SegmentPairs
from worker.ml.rewards.signal_scale import SignalScale
from worker.sim.costs import signal_weights
from worker.tasks import registry
from worker.whole_files import whole_files, written_whole

POOL_SCENARIOS = 48
"""each in six behaviours, as in a study: what the replays begin with"""
TEST_SCENARIOS = 500
LARGEST_LOSS = 0.005
"""of success in these: half of what somebody's own may lose in fewer, as what is archived is there for everybody"""
SCENARIOS_AROUND = 150
"""each in twelve modes around an archived policy"""
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
    Archetype("close", "lateral_offset_m"),
    Archetype("wide", "lateral_offset_m", 1.0),
    Archetype("slow", "speed_squared_m2_s2"),
)


def archive_policies(
    task: str,
    work_directory: Path,
    archetypes: Sequence[Archetype] = ARCHETYPES,
    config: Refinement | None = None,
    gates: FilterConfig | None = None,
) -> dict[str, Any]:
    """Refine policies for people who mind one signal each, from which everybody's refinement may begin, and record it.

    Six to twenty minutes for each of them, one after the other: every one begins as the best of all that are archived,
    and is archived beside that person's earlier ones if it ends better than it began: what serves them better may serve
    others worse. Who is finished in the work directory is not refined again.
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
    return making.record()


def explored_around(task: str, policy: str, work: Path) -> ResponseSurface:
    """What modes change around an archived policy, beside that policy itself, as it is kept with it.

    It is explored and fitted where it is not there yet, which takes minutes; blocks finished in the work directory are
    kept.
    """
    if (known := simulation.surface_around(task, policy)) is not None:
        return known
    file, folder = simulation.surface_around_file(task, policy), work / f"{policy}-around"
    described = registry.task(task)
    folder.mkdir(parents=True, exist_ok=True)
    firsts = first_of(RESPONSE_SURFACE, SCENARIOS_AROUND)[::BLOCK]
    blocks = [Block(task, each, random_modes(described, each), folder / f"{each}.npz", policy) for each in firsts]
    for block in tqdm(blocks, unit="block", desc=f"modes around {policy}"):
        if not block.is_there():
            compare_block(block)
    file.parent.mkdir(exist_ok=True)
    surface = joined(blocks).fit(described)
    with written_whole(file) as draft:
        surface.save(draft)
    shutil.rmtree(folder)
    return surface


class _Making:
    """The archive of one task in the making."""

    def __init__(self, task: str, work: Path, config: Refinement, gates: FilterConfig) -> None:
        self.name, self.task, self.work, self.config, self.gates = task, registry.task(task), work, config, gates
        self.rollouts = RolloutCache(task, work / "rollouts")
        self.pool = self.rollouts.pool(first_of(POOL, POOL_SCENARIOS))
        self.pairs, self.scale = self._shown()
        self.folder = simulation.archive_folder(task)
        self.folder.mkdir(parents=True, exist_ok=True)
        self.archived = {file.stem: self._explored(file.stem) for file in whole_files(self.folder, "*.safetensors")}
        known = json.loads(self._record_file.read_text())["archetypes"] if self._record_file.exists() else []
        self.entries: dict[str, dict[str, Any]] = {each["name"]: each for each in known}

    def refine(self, archetype: Archetype, seed: int) -> None:
        """Refine a policy for somebody, unless that is done, and archive it if it is better than where it began."""
        done = self.work / f"{archetype.name}-done"
        if done.exists() and archetype.name in self.entries:
            return
        name = self._new_name(archetype)
        policy, reward = simulation.reference_policy(self.name), self._reward(archetype)
        problem = FilterProblem(self.task, policy, reward, seed, self.gates)
        refined, trials = self._refined(problem, self.work / f"{archetype.name}-training")
        loss = self._loss(GaussianPolicy(dict(refined))) if refined else None
        if loss is not None and loss <= LARGEST_LOSS:
            with written_whole(self.folder / f"{name}.safetensors") as draft:
                GaussianPolicy(dict(refined)).save(draft)
            self.archived[name] = self._explored(name)
        policy_of = asdict(replace(archetype, name=name))
        self.entries[name] = {**policy_of, "trials": trials, "loss": loss, "kept": name in self.archived}
        with written_whole(self._record_file) as draft:
            draft.write_text(json.dumps(self.record(), indent=2) + "\n")
        done.touch()

    def _new_name(self, archetype: Archetype) -> str:
        """Of the next policy for somebody: "level", then "level_2"."""
        is_of = [(each["signal"], each["sign"]) == (archetype.signal, archetype.sign) for each in self.entries.values()]
        return f"{archetype.name}_{1 + sum(is_of)}" if any(is_of) else archetype.name

    def record(self) -> dict[str, Any]:
        """How the archive came to be, training by training."""
        return {
            "command": f"python -m worker archive-policies --task {self.name}",
            "steps": self.config.steps,
            "archetypes": list(self.entries.values()),
            "versions": {"python": platform.python_version(), "numpy": np.__version__, "torch": torch.__version__},
        }

    @property
    def _record_file(self) -> Path:
        return self.folder / "archive.json"

    def _explored(self, name: str) -> ArchivedPolicy:
        """A policy that is archived, with what modes change around it."""
        simulation.archived_policies.cache_clear()
        policy, gate = simulation.archived_policies(self.name)[name], self.gates.gate_block(self.task)
        around = explored_around(self.name, name, self.work)
        return ArchivedPolicy(policy, self._collect(PolicyAct(policy), gate, 0.0, 0), around)

    def _loss(self, policy: GaussianPolicy) -> float:
        """Of success, as a share of scenarios in which nothing was tried before."""
        test = first_of(POLICY_TEST, TEST_SCENARIOS)
        changes = successes(self._collect(PolicyAct(policy), test, 0.0, 0)) - successes(self.rollouts.reference(test))
        return -float(changes.mean())

    def _refined(self, problem: FilterProblem, folder: Path) -> tuple[Mapping[str, Float32Array], list[dict[str, Any]]]:
        """The policy's weights, none where it began as well as it ended, and what was tried."""
        config, reference = problem.config, self.rollouts.reference
        gate, watched = reference(config.gate_block(self.task)), reference(config.watch_block(self.task))
        surface = ResponseSurface.load(simulation.surface_file(self.name), self.task.modes, self.task.signals)
        mode = find_mode(problem, surface, self.pool, gate, self._collect)
        known, policies = self.pool.rollouts, list(self.archived.values())
        archived = best_archived(problem, mode, policies, known, gate, self._collect)
        start = begin_as(mode, archived)
        folder.mkdir(exist_ok=True)
        make_env = registry.environment_class(self.name)
        beginning = Beginning(make_env, self.pool.rollouts, gate, watched, self._collect, start.driven)
        drafts = refine(problem, start.draft, beginning, self.config, Checkpoint(folder))
        check = partial(reference, config.check_block(self.task))
        gated = gate_refined(problem, mode, archived, drafts, gate, check, self._collect)
        shutil.rmtree(folder)
        weights = gated.weights
        is_new = weights.gate == 1.0 and any(weights.refined is each.weights.refined for each in drafts)
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
