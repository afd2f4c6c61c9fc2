"""One cell of the benchmark: one method, fitted for one scripted user with one seed, driven through unseen scenarios.

Everything is done in the process that calls run_cell(), on one core, so that seconds of processor time mean something.
"""

import hashlib
import json
import platform
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

import worker
from worker.compute import learning, simulation
from worker.compute.population import prior_of
from worker.compute.simulation import surface_file
from worker.domain.responses import TARGETS
from worker.domain.scenarios import EVALUATION, POOL, first_of
from worker.domain.trajectory import Trajectory
from worker.domain.type_aliases import Act, FloatArray
from worker.experiments.benchmark_person import BenchmarkPerson
from worker.experiments.rollout_cache import BEHAVIOURS_PER_SCENARIO, RolloutCache, policy_mark
from worker.ml import acquisition
from worker.ml.filters.fitting.filter_problem import FilterConfig, FilterProblem
from worker.ml.filters.fitting.response_surface import ResponseSurface
from worker.ml.methods import registry as methods
from worker.ml.methods.people import Labels
from worker.ml.methods.registry import MethodConfig, Setting
from worker.ml.rewards import reward_training
from worker.ml.rewards.action_ranking import can_rank
from worker.ml.rewards.loading import load_reward_model
from worker.ml.rewards.reward_models import RewardModel
from worker.ml.rewards.segments import SegmentPairs
from worker.ml.rewards.signal_scale import SignalScale
from worker.ml.teachers import INDIRECT, OPPOSED, TASTES, Manner, ScriptedTeacher, Taste, User
from worker.sim.costs import CostForm, preference_rewards
from worker.tasks import registry
from worker.tasks.registry import installed_task
from worker.whole_files import written_whole

SMALLEST_POOL = 48
"""scenarios, as in a study"""
CHOOSE_EVERY = 10
"""labels between two models that choose what is asked, as in a study"""
PAIRS_PER_SCENARIO = BEHAVIOURS_PER_SCENARIO * (BEHAVIOURS_PER_SCENARIO - 1) // 2

PAPER_USERS: Mapping[str, Taste] = {user.value: TASTES[user.value] for user in User}
OPPOSED_USERS: Mapping[str, Taste] = {taste.name: taste for pair in OPPOSED for taste in pair}
INDIRECT_USERS: Mapping[str, Taste] = {taste.name: taste for taste in INDIRECT}


def default_method(task: str) -> str:
    """The method whose filters a study of this task gets where its experimenter changes nothing."""
    return "pbarl_archived" if simulation.archived_policies(task) else "pbarl"


@dataclass(frozen=True)
class BenchmarkConfig:
    """What all cells of a benchmark share. Cells made under other terms are never mixed."""

    labels: int = 200
    scenarios: int = 500
    reward: reward_training.RewardKind = "structured"
    form: CostForm = "calibrated"
    rule: acquisition.Strategy = "entropy"
    """which pairs are asked; the studio's default, for every method alike"""
    manner: Manner = field(default_factory=Manner)
    """how the scripted users err; none of them skips"""
    smallest_pool: int = SMALLEST_POOL
    filter: FilterConfig = field(default_factory=FilterConfig)
    methods: MethodConfig = field(default_factory=MethodConfig)

    @property
    def pool(self) -> range:
        """Scenarios of the clips that are compared."""
        return first_of(POOL, max(self.smallest_pool, -(-self.labels // PAIRS_PER_SCENARIO)))

    def unseen(self, seed: int) -> range:
        """Scenarios of the evaluation; every seed has its own, so that another seed confirms with fresh ones."""
        return first_of(EVALUATION, self.scenarios, skip=seed * self.scenarios)

    def directory(self, work: Path) -> Path:
        """Where cells under these terms are kept."""
        mark = hashlib.sha256(json.dumps(asdict(self), sort_keys=True).encode()).hexdigest()[:8]
        name = f"{self.reward}-{self.form}-{self.labels}labels-{self.scenarios}scenarios-{mark}"
        return work / "cells" / name


@dataclass(frozen=True)
class Cell:
    """Which method for whom."""

    task: str
    taste: Taste
    method: str
    seed: int

    def path(self, terms: BenchmarkConfig, work: Path) -> Path:
        """The finished cell's file."""
        mark = hashlib.sha256(json.dumps(asdict(self.taste), sort_keys=True).encode()).hexdigest()[:6]
        folder = terms.directory(work) / f"{self.task}-{policy_mark(self.task)}" / f"{self.taste.name}-{mark}"
        return folder / f"{self.method}-seed{self.seed}.npz"


@cache
def code_mark() -> str:
    """Which state of the learning and simulation a cell was made with: a hash over their sources."""
    here = Path(worker.__file__).parent
    sources = sorted(
        [*(each for room in ("domain", "ml", "sim", "tasks") for each in here.glob(f"{room}/**/*.py")), Path(__file__)]
    )
    digest = hashlib.sha256()
    for source in sources:
        digest.update(f"{source.relative_to(here).as_posix()}\0".encode() + source.read_bytes())
    return digest.hexdigest()[:8]


def run_cell(cell: Cell, terms: BenchmarkConfig, work: Path) -> Path:
    """Label, fit, evaluate; the result is written to a file that is either complete or absent."""
    torch.set_num_threads(1)
    made_with = code_mark()
    rollout_cache = RolloutCache(cell.task, work / "rollouts")
    bench = BenchmarkUser(cell, terms, rollout_cache, work)
    started = time.perf_counter()
    fitted = methods.fit(cell.method, bench.setting())
    wall_s = time.perf_counter() - started
    unseen = terms.unseen(cell.seed)
    if cell.method == "reference":
        driven = rollout_cache.reference(unseen)
    else:
        driven = learning.run_scenarios(cell.task, fitted.act, unseen, 0.0, 0)
    record = {
        **{name: getattr(cell, name) for name in ("task", "method", "seed")},
        "taste": asdict(cell.taste),
        "labels": terms.labels,
        "spent": {
            "labels": fitted.labels,
            "environment_steps": fitted.environment_steps,
            "cpu_s": fitted.cpu_s,
            "wall_s": round(wall_s, 2),
        },
        "notes": fitted.notes,
        "code": made_with,
        "versions": {"python": platform.python_version(), "numpy": np.__version__, "torch": torch.__version__},
    }
    return _write(cell.path(terms, work), record, driven, bench.reward.returns(driven))


def _write(target: Path, record: dict[str, Any], driven: Sequence[Trajectory], learned: FloatArray) -> Path:
    target.parent.mkdir(parents=True, exist_ok=True)
    arrays: dict[str, Any] = {
        "record": np.array(json.dumps(record)),
        "scenarios": [each.scenario for each in driven],
        "success": [float(each.success) for each in driven],
        "learned": learned,
        "costs": [each.costs.sum(axis=0, dtype=np.float64) for each in driven],
        "signals": [each.signals.sum(axis=0, dtype=np.float64) for each in driven],
    }
    with written_whole(target) as draft:
        np.savez_compressed(draft, **arrays)
    return target


class BenchmarkUser:
    """A user's labels, what was learned from them, and everything that a method may ask for."""

    def __init__(self, cell: Cell, terms: BenchmarkConfig, rollout_cache: RolloutCache, work: Path) -> None:
        self.cell, self.terms, self.rollout_cache = cell, terms, rollout_cache
        self.task = registry.task(cell.task)
        self.pool = rollout_cache.behaviours(terms.pool)
        self.clip_steps = installed_task(cell.task).description.usual_clip_steps
        self.rows = acquisition.matched_pairs([each.scenario for each in self.pool])
        episode_means = [each.signals.mean(axis=0, dtype=np.float64) for each in self.pool]
        self.scale = SignalScale.of(self._cut(self.rows), episode_means)
        self.prior = prior_of(cell.task, self.scale.spread)
        self.labelled, self.targets = self._label()
        self.reward = self._kept_reward(cell.path(terms, work).with_name(f"reward-seed{cell.seed}.safetensors"))

    def setting(self) -> Setting:
        """What the method is given."""
        policy = simulation.reference_policy(self.cell.task)
        problem = FilterProblem(self.task, policy, self.reward, self.cell.seed, self.terms.filter)
        return Setting(
            problem=problem,
            labels=self.terms.labels,
            pool=self.rollout_cache.pool(self.terms.pool),
            surface=lambda: ResponseSurface.load(surface_file(self.cell.task), self.task.modes),
            action_reward=self._action_reward,
            reference=self.rollout_cache.reference,
            collect=self._collect,
            make_env=registry.environment_class(self.cell.task),
            config=self.terms.methods,
            archived=self.rollout_cache.archived,
            person=self._person(),
        )

    def _person(self) -> BenchmarkPerson:
        return BenchmarkPerson(
            self.cell.taste,
            Labels(self.labelled, self.targets),
            self.scale,
            self.terms.manner,
            self.pool,
            self.rows,
            self.clip_steps,
            self._rewards_of,
            lambda labels: self._fitted(self.terms.reward, labels),
        )

    def _collect(self, act: Act, scenarios: Sequence[int], noise: float, seed: int) -> list[Trajectory]:
        return learning.run_scenarios(self.cell.task, act, scenarios, noise, seed)

    def _label(self) -> tuple[SegmentPairs, FloatArray]:
        """What is asked and what the scripted user says about it; the same for every method."""
        rng = np.random.default_rng([self.cell.seed, 7])
        rewards = np.array([self._true_rewards(each)[: self.clip_steps] for each in self.pool])
        teacher = ScriptedTeacher.calibrated(self.terms.manner, rewards[self.rows])
        asked, targets = np.empty((0, 2), np.int64), np.empty(0)
        left_over = self.rows
        while len(asked) < self.terms.labels:
            rule, scores = self._scores(left_over, asked, targets)
            count = self.terms.labels - len(asked)
            if self.terms.rule != "uniform":
                count = min(count, CHOOSE_EVERY)
            choice = acquisition.choose(count, len(left_over), rng, rule=rule, scores=scores)
            chosen = np.where(choice.swapped[:, None], left_over[choice.indices][:, ::-1], left_over[choice.indices])
            answers = [TARGETS[teacher.answer(rewards[left], rewards[right], rng)] for left, right in chosen]
            asked, targets = np.concatenate([asked, chosen]), np.concatenate([targets, answers])
            left_over = np.delete(left_over, choice.indices, axis=0)
        return self._cut(asked), targets

    def _scores(
        self, candidates: npt.NDArray[np.int64], asked: npt.NDArray[np.int64], targets: FloatArray
    ) -> tuple[acquisition.Strategy, FloatArray | None]:
        """The first labels are chosen at random, later ones by a structured model of those before."""
        if self.terms.rule == "uniform" or not len(asked):
            return "uniform", None
        model = reward_training.fit(
            self._cut(asked), targets, "structured", self.cell.seed, scale=self.scale, prior=self.prior
        ).model
        return self.terms.rule, acquisition.score(self.terms.rule, model.member_probabilities(self._cut(candidates)))

    def _cut(self, rows: npt.NDArray[np.int64]) -> SegmentPairs:
        return SegmentPairs.cut([(self.pool[left], self.pool[right]) for left, right in rows], 0, self.clip_steps)

    def _true_rewards(self, trajectory: Trajectory) -> FloatArray:
        return self._rewards_of(self.cell.taste, trajectory)

    def _rewards_of(self, taste: Taste, trajectory: Trajectory) -> FloatArray:
        return preference_rewards(
            self.task, trajectory.costs, trajectory.signals, taste.omega, self.terms.form, taste.per_signal
        )

    def _kept_reward(self, path: Path) -> RewardModel:
        """The model that all methods of this user and seed are trained for and judged by."""
        if path.exists():
            return load_reward_model(path.read_bytes())
        model = self._fit(self.terms.reward)
        path.parent.mkdir(parents=True, exist_ok=True)
        with written_whole(path) as draft:
            draft.write_bytes(model.to_bytes())
        return load_reward_model(path.read_bytes())  # as stored, whoever was first

    def _action_reward(self) -> RewardModel:
        return self.reward if can_rank(self.reward) else self._fit("mlp")

    def _fit(self, kind: reward_training.RewardKind) -> RewardModel:
        return self._fitted(kind, Labels(self.labelled, self.targets))

    def _fitted(self, kind: reward_training.RewardKind, labels: Labels) -> RewardModel:
        return reward_training.fit(
            labels.pairs,
            labels.targets,
            kind,
            self.cell.seed,
            scale=self.scale,
            prior=self.prior,
            reference=simulation.reference_rollouts(self.cell.task),
            predictor=simulation.signal_predictor(self.cell.task) if kind == "predicted" else None,
        ).model
