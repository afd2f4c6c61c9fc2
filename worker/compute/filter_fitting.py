"""From a reward model to a fitted filter, stage by stage, with the rollouts spread over the compute processes.

Between two stages everything is in one stored draft, so that a worker killed in the middle loses one stage at most.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TypeVar

from worker.analysis.filters.promise import Outcome, Promise
from worker.compute import harm_tests, learning, refining, simulation, stages
from worker.compute.archived import everything_archived
from worker.compute.pools import Computing, Lane
from worker.compute.simulation import surface_file
from worker.compute.stages import Stages
from worker.domain.lab_modes import PolicyChoice
from worker.domain.scenarios import RESIDUAL, first_of, of_promise
from worker.domain.trajectory import Trajectory
from worker.domain.type_aliases import Act
from worker.ml.filters.exported import filter_act
from worker.ml.filters.exported.filter_act import FilterAct
from worker.ml.filters.exported.filter_module import FilterWeights
from worker.ml.filters.fitting import mode_search, policy_choice, printed_filter, residual, residual_gate
from worker.ml.filters.fitting.filter_draft import FilterDraft
from worker.ml.filters.fitting.filter_problem import FilterConfig, FilterProblem, ReportProgress
from worker.ml.filters.fitting.pool import Pool
from worker.ml.filters.fitting.response_surface import ResponseSurface
from worker.ml.policies.checkpoint import Checkpoint
from worker.ml.policies.reference import ReferencePolicy
from worker.ml.reinforcement.archived_policy import ArchivedPolicy, best_archived, choose_archived
from worker.ml.reinforcement.quick_filter import quick_filter
from worker.ml.reinforcement.refinement import Refinement, is_promising
from worker.ml.reinforcement.refinement_gate import gate_refined
from worker.ml.rewards.loading import load_reward_model
from worker.tasks import registry

CHUNK = 3
"""Scenarios per call of a compute process: small enough to spread evenly, large enough not to matter."""


PRINTED_ROLLOUTS = 100
"""Episodes of the frozen policy whose transitions the printed method is trained on."""


T = TypeVar("T")
TrainPatiently = Callable[[Callable[[Path], T]], T | None]
"""Calls a part of a training with the folder of its checkpoint until it is whole; None: nobody needs it any more."""


def driven_as(task: str, archived: str) -> str:
    """The name under which rollouts of a policy that was refined beforehand are known."""
    return f"{task} refined beforehand: {archived}"


@dataclass(frozen=True)
class FilterFit:
    """One filter in the making."""

    task: str
    compute: Computing
    beat: Callable[[], None]
    reward: bytes
    seed: int
    config: FilterConfig
    progress: ReportProgress
    references: dict[tuple[str, range], list[Trajectory]]
    """rollouts of the frozen policy and of others, by their names, that other fittings have already made"""
    promise: Promise = field(default_factory=Promise)
    study_seed: int = 0
    version: int = 1
    """of this person's filters"""
    outcomes: dict[tuple[str, int], list[Outcome]] = field(default_factory=dict)
    """of the frozen policy, by task and first scenario"""
    stages: Stages = field(default_factory=lambda: stages.LAST)
    """what is to be done, for ``progress`` to hear how much of it is"""

    def during(self, stage: str) -> ReportProgress:
        """What hears how far this stage is, from 0 to 1."""
        return stages.during(self.stages, stage, self.progress)

    @property
    def problem(self) -> FilterProblem:
        """What is to be fitted, in the words of the learning code."""
        task, policy = registry.task(self.task), simulation.reference_policy(self.task)
        config = replace(self.config, residual_rounds=0) if task.is_a_labs else self.config
        return FilterProblem(task, policy, load_reward_model(self.reward), self.seed, config)

    def find_mode(self, pool: Pool) -> FilterDraft:
        """The person's execution mode, as far as held-out scenarios allow it; or their policy among several."""
        if isinstance(self.problem.task.modes, PolicyChoice):
            return self._choose(self.problem.task.modes, self.during("mode"))
        reference, progress = self._gate_reference(), self.during("mode")
        return mode_search.find_mode(self.problem, self._surface(), pool, reference, self.collect, progress)

    def find_quickly(self, pool: Pool, *, archived: bool) -> FilterDraft:
        """What can be had in a minute, while the person still answers: quick_filter().

        ``archived``: whether policies that were refined beforehand come into question.
        """
        if isinstance(self.problem.task.modes, PolicyChoice):
            return self._choose(self.problem.task.modes, self.during("quick"))
        policies = self._archived(self.during("quick")) if archived else []
        reference, progress = self._gate_reference(), self.during("quick")
        return quick_filter(self.problem, self._surface(), pool, policies, reference, self.collect, progress)

    def choose_archived(self, draft: FilterDraft, pool: Pool) -> FilterDraft:
        """The policy refined beforehand that is best for the person, if it is better than mode and residual."""
        problem, progress = self.problem, self.during("archived")
        archived, reference = self._archived(progress), self._gate_reference()
        more_reference, known = self._check_reference, pool.rollouts
        return choose_archived(problem, draft, archived, known, reference, more_reference, self.collect, progress)

    def _choose(self, family: PolicyChoice, progress: ReportProgress) -> FilterDraft:
        """What every policy does in the gate's scenarios is the same for everybody, and made once per worker."""
        scenarios = self.problem.config.gate_block(self.problem.task)
        others = {}
        for number, name in enumerate(family.names):
            progress(f"driving the policy {name} through held-out scenarios", number / len(family.names))
            others[name] = self.reference(scenarios, name)
        return policy_choice.choose(self.problem, self.reference(scenarios), others)

    def train_residual(self, draft: FilterDraft) -> FilterDraft:
        """The residual action encoder around the mode."""
        return residual.train_residual(self.problem, draft, self.collect, self.during("residual"), self._learn)

    def gate_residual(self, draft: FilterDraft) -> FilterDraft:
        """As much of the residual as held-out scenarios allow."""
        reference, progress = self._gate_reference(), self.during("gate")
        home = partial(self._home_reference, progress)
        return residual_gate.gate_residual(self.problem, draft, reference, home, self.collect, progress)

    def refine(
        self,
        draft: FilterDraft,
        known: Sequence[Trajectory],
        steps: int,
        begun: Path | None,
        train: TrainPatiently[tuple[FilterDraft, ...]],
    ) -> FilterDraft | None:
        """The person's refined policy in place of the mode, if it is better; None: nobody needs it any more.

        ``known``: the pool's rollouts; ``begun``: the folder of refine_ahead(); ``train``: calls what it is given with
        a folder for checkpoints, in a compute process, until that gives drafts.
        """
        is_ahead = begun is not None and refining.is_ahead(begun, Refinement(steps))
        training = self._training(draft, known, steps, watched=not is_ahead)
        drafts: tuple[FilterDraft, ...] = ()
        if not (begun and is_ahead) or self._is_promising(training, begun):
            drafts = train(partial(refining.train, training, begun)) or ()
            if not drafts:
                return None
        archived, reference, more_reference = training.archived, training.reference, self._check_reference
        during = self.during("refinement")

        def progress(stage: str, share: float) -> None:
            during(stage, stages.TRAINED + (1.0 - stages.TRAINED) * share)

        return gate_refined(self.problem, draft, archived, drafts, reference, more_reference, self.collect, progress)

    def _is_promising(self, training: refining.Training, begun: Path) -> bool:
        self.during("refinement")("checking what the refinement has come to", 0.0)
        draft, reference, checkpoint = training.start.draft, training.reference, Checkpoint(begun)
        return is_promising(self.problem, draft, reference, training.config, checkpoint, self.collect)

    def refine_ahead(self, pool: Pool, steps: int, train: TrainPatiently[bool]) -> None:
        """The larger part of a refinement, around this reward model's mode."""
        self._check_reference()  # while nobody waits for it
        training = self._training(self.find_mode(pool), pool.rollouts, steps, watched=True)
        train(partial(refining.train_ahead, training))

    def _training(
        self, mode: FilterDraft, known: Sequence[Trajectory], steps: int, *, watched: bool
    ) -> refining.Training:
        """``watched``: whether it is tried on the way, as it is until refine_ahead() is done."""
        looks = self.reference(self.problem.config.watch_block(self.problem.task)) if watched else ()
        reference, config = self._gate_reference(), Refinement(steps)
        policies = self._archived(self.during("refinement"))
        archived = best_archived(self.problem, mode, policies, known, reference, self.collect)
        return refining.Training(self.task, self.problem, mode, archived, known, reference, looks, config)

    def _archived(self, progress: ReportProgress) -> list[ArchivedPolicy]:
        """What archived policies do in the gate's scenarios is the same for everybody, and made once per worker."""
        progress("looking at policies that were refined beforehand", 0.0)
        scenarios, found = self.problem.config.gate_block(self.problem.task), list[ArchivedPolicy]()
        frozen = self._gate_reference()
        for each in everything_archived(self.task):
            driven = self._driven(driven_as(self.task, each.name), partial(each.exported, frozen), scenarios)
            found.append(ArchivedPolicy(each.policy, driven, each.around, each.mode))
        return found

    def _surface(self) -> ResponseSurface:
        return ResponseSurface.load(surface_file(self.task), self.problem.task.modes, self.problem.task.signals)

    def keep_promise(self, draft: FilterDraft) -> FilterDraft:
        """The filter behind its shield, as far as the promise about harm can be made of it."""
        progress = self.during("promise")
        draft = draft.shielded(self.problem.task.observation, partial(self._home_reference, progress))
        if draft.weights.moves_nothing:
            return harm_tests.untested(draft, self.promise, self.version)
        started = time.perf_counter()
        chooses = isinstance(self.problem.task.modes, PolicyChoice)  # there is no half of another policy
        strengths = harm_tests.STRENGTHS[: 1 if chooses else None]
        scenarios = of_promise(self.study_seed)
        driven, usual = 0, self.promise.needed(self.promise.error_of(0, self.version))

        def drive(weights: FilterWeights, some: range) -> Sequence[Outcome]:
            nonlocal driven
            progress("testing what the filter may do to people", driven / (driven + usual))
            driven += len(some)
            return self._outcomes(self.act_of(weights), some)

        kept = harm_tests.weakened_until_promised(
            draft, self.promise, self.version, strengths, scenarios, drive, self._reference_outcomes
        )
        return kept.timed("promise", started)

    def _outcomes(self, act: Act, scenarios: range) -> list[Outcome]:
        chunks = [(self.task, act, scenarios[first : first + CHUNK]) for first in range(0, len(scenarios), CHUNK)]
        parts = self.compute.run_all(Lane.LEARNING, self.beat, learning.outcomes, chunks)
        return [outcome for part in parts for outcome in part]

    def _reference_outcomes(self, scenarios: range) -> Sequence[Outcome]:
        """What the frozen policy does in scenarios of the promise: made once per study and worker."""
        block = of_promise(self.study_seed)
        key, last = (self.task, block.start), block.index(scenarios[-1]) + 1
        known = self.outcomes.get(key, [])
        if len(known) < last:
            policy = simulation.reference_policy(self.task).mean
            known = known + self._outcomes(policy, block[len(known) : last])
            self.outcomes[key] = known
        return known[last - len(scenarios) : last]

    def fit_printed(self) -> FilterDraft:
        """The paper's PbARL as printed, on transitions of the frozen policy. Not gated: it is what it is."""
        transitions = self.reference(first_of(RESIDUAL, PRINTED_ROLLOUTS))
        self.during("printed")("training the printed action encoder", 0.0)
        return self.compute.run(Lane.LEARNING, self.beat, printed_filter.fit_printed, self.problem, transitions)

    def collect(self, act: Act, scenarios: Sequence[int], noise: float, seed: int) -> list[Trajectory]:
        """One rollout per scenario, in order; the same whatever the number of processes."""
        chunks = [list(scenarios[first : first + CHUNK]) for first in range(0, len(scenarios), CHUNK)]
        arguments = [(self.task, act, chunk, noise, seed) for chunk in chunks]
        parts = self.compute.run_all(Lane.LEARNING, self.beat, learning.run_scenarios, arguments)
        return [trajectory for part in parts for trajectory in part]

    def _learn(self, problem: FilterProblem, draft: FilterDraft, rounds: Sequence[Sequence[Trajectory]]) -> FilterDraft:
        return self.compute.run(Lane.LEARNING, self.beat, residual.learn_round, problem, draft, rounds)

    def _gate_reference(self) -> Sequence[Trajectory]:
        return self.reference(self.problem.config.gate_block(self.problem.task))

    def _check_reference(self) -> Sequence[Trajectory]:
        return self.reference(self.problem.config.check_block(self.problem.task))

    def _home_reference(self, progress: ReportProgress) -> Sequence[Trajectory]:
        scenarios = self.problem.config.home_block(self.problem.task)
        if (self.task, scenarios) not in self.references:
            progress("driving the reference policy, whose reach the shield has to know", 0.0)
        return self.reference(scenarios)

    def act_of(self, weights: FilterWeights) -> FilterAct:
        """The filter around its policy."""
        return filter_act.act_of(self.problem.task.modes, self.policy_of(weights), weights)

    def policy_of(self, weights: FilterWeights) -> ReferencePolicy:
        """The frozen policy, or the one that was chosen."""
        return simulation.policy_in(self.task, weights.mode)

    def reference(self, scenarios: range, policy: str = "") -> Sequence[Trajectory]:
        """The frozen policy's rollouts, or those of another one: the same for everybody, so they are made once per
        worker."""
        act = simulation.reference_policy(self.task, policy).mean
        return self._driven(f"{self.task} {policy}".strip(), lambda: act, scenarios)

    def _driven(self, name: str, act: Callable[[], Act], scenarios: range) -> Sequence[Trajectory]:
        if (name, scenarios) not in self.references:
            self.references[name, scenarios] = self.collect(act(), scenarios, 0.0, 0)
        return self.references[name, scenarios]
