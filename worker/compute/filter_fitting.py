"""From a reward model to a published filter, stage by stage, with the rollouts spread over the compute processes.

Between two stages everything is in one stored draft, so that a worker killed in the middle loses one stage at most.
"""

import io
import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from app.installed_tasks.lab import REFERENCE
from worker.analysis.filters.evaluation import evaluate
from worker.analysis.filters.promise import Outcome, Promise, sentence
from worker.analysis.filters.proof import case_against
from worker.compute import harm_tests, learning, refining, simulation
from worker.compute.pools import Computing, Lane
from worker.compute.simulation import surface_file
from worker.domain.lab_modes import PolicyChoice
from worker.domain.scenarios import EVALUATION, RESIDUAL, first_of, of_promise
from worker.domain.task import Task
from worker.domain.trajectory import Trajectory
from worker.domain.type_aliases import Act
from worker.ml.export import bundle
from worker.ml.export.bundle import BundleContents, Provenance, RecordedSteps
from worker.ml.filters import filter_problem, mode_search, policy_choice, printed_filter, residual
from worker.ml.filters.filter_module import FilterWeights
from worker.ml.filters.filter_onnx import SHIELD
from worker.ml.filters.filter_problem import (
    FilterAct,
    FilterConfig,
    FilterDraft,
    FilterProblem,
    GateTrial,
    ReportProgress,
)
from worker.ml.filters.policy_choice import SURE
from worker.ml.filters.response_surface import ResponseSurface
from worker.ml.policies.checkpoint import Checkpoint
from worker.ml.policies.reference import ReferencePolicy
from worker.ml.reinforcement.refinement import Refinement, given_up, is_promising
from worker.ml.reinforcement.refinement_gate import gate_refined
from worker.ml.rewards.loading import load_reward_model
from worker.tasks import registry

CHUNK = 3
"""Scenarios per call of a compute process: small enough to spread evenly, large enough not to matter."""


PRINTED_ROLLOUTS = 100
"""Episodes of the frozen policy whose transitions the printed method is trained on."""

RECORDED_EPISODES = 2
"""How much of the evaluation goes into the bundle for checking the filter elsewhere."""


@dataclass(frozen=True)
class Proven:
    """A filter, or the reference in its place, with what was measured of it on unseen scenarios."""

    draft: FilterDraft
    act: FilterAct
    evaluation: dict[str, Any]
    driven: list[Trajectory]
    rejected: dict[str, Any]
    """what was measured of the filter that the reference has replaced; empty: it was not"""


@dataclass(frozen=True)
class Finished:
    """A filter ready to be published."""

    filter_weights: bytes
    bundle: bytes
    metrics: dict[str, Any]


T = TypeVar("T")
TrainPatiently = Callable[[Callable[[Path], T]], T | None]
"""Calls a part of a training with the folder of its checkpoint until it is whole; None: nobody needs it any more."""


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
    """rollouts of the frozen policy that other fittings have already made"""
    promise: Promise = field(default_factory=Promise)
    study_seed: int = 0
    version: int = 1
    """of this person's filters"""
    outcomes: dict[tuple[str, int], list[Outcome]] = field(default_factory=dict)
    """of the frozen policy, by task and first scenario"""

    @property
    def problem(self) -> FilterProblem:
        """What is to be fitted, in the words of the learning code."""
        task, policy = registry.task(self.task), simulation.reference_policy(self.task)
        config = replace(self.config, residual_rounds=0) if task.is_a_labs else self.config
        return FilterProblem(task, policy, load_reward_model(self.reward), self.seed, config)

    def find_mode(self, pool: Sequence[Trajectory]) -> FilterDraft:
        """The person's execution mode, as far as held-out scenarios allow it; or their policy among several."""
        if isinstance(self.problem.task.modes, PolicyChoice):
            return self._choose(self.problem.task.modes)
        surface = ResponseSurface.load(surface_file(self.task), self.problem.task.modes, self.problem.task.signals)
        reference = self._gate_reference()
        return mode_search.find_mode(self.problem, surface, pool, reference, self.collect, self.progress)

    def _choose(self, family: PolicyChoice) -> FilterDraft:
        """What every policy does in the gate's scenarios is the same for everybody, and made once per worker."""
        scenarios = self.problem.config.gate_block(self.problem.task)
        others = {}
        for number, name in enumerate(family.names):
            self.progress(f"driving the policy {name} through held-out scenarios", 0.6 * number / len(family.names))
            others[name] = self.reference(scenarios, name)
        return policy_choice.choose(self.problem, self.reference(scenarios), others)

    def train_residual(self, draft: FilterDraft) -> FilterDraft:
        """The residual action encoder around the mode."""
        return residual.train_residual(self.problem, draft, self.collect, self.progress, self._learn)

    def gate_residual(self, draft: FilterDraft) -> FilterDraft:
        """As much of the residual as held-out scenarios allow."""
        reference = self._gate_reference()
        return residual.gate_residual(self.problem, draft, reference, self.collect, self.progress)

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
        if begun and is_ahead and not self._is_promising(training, begun):
            return given_up(draft)
        drafts = train(partial(refining.train, training, begun))
        if not drafts:
            return None
        return gate_refined(
            self.problem, drafts, training.reference, self._check_reference, self.collect, self.progress
        )

    def _is_promising(self, training: refining.Training, begun: Path) -> bool:
        self.progress("checking what the refinement has come to", 0.34)
        draft, reference, checkpoint = training.draft, training.reference, Checkpoint(begun)
        return is_promising(self.problem, draft, reference, training.config, checkpoint, self.collect)

    def refine_ahead(self, known: Sequence[Trajectory], steps: int, train: TrainPatiently[bool]) -> None:
        """The larger part of a refinement, around this reward model's mode."""
        self._check_reference()  # while nobody waits for it
        train(partial(refining.train_ahead, self._training(self.find_mode(known), known, steps, watched=True)))

    def _training(
        self, draft: FilterDraft, known: Sequence[Trajectory], steps: int, *, watched: bool
    ) -> refining.Training:
        """``watched``: whether it is tried on the way, as it is until refine_ahead() is done."""
        looks = self.reference(self.problem.config.watch_block(self.problem.task)) if watched else ()
        reference, config = self._gate_reference(), Refinement(steps)
        return refining.Training(self.task, self.problem, draft, known, reference, looks, config)

    def keep_promise(self, draft: FilterDraft) -> FilterDraft:
        """The filter behind its shield, as far as the promise about harm can be made of it."""
        draft = draft.shielded()
        if moves_nothing(draft.weights):
            return harm_tests.untested(draft, self.promise, self.version)
        started = time.perf_counter()
        chooses = isinstance(self.problem.task.modes, PolicyChoice)  # there is no half of another policy
        strengths, scenarios = (1.0, *(() if chooses else self.config.gates)), of_promise(self.study_seed)

        def drive(weights: FilterWeights, some: range) -> Sequence[Outcome]:
            self.progress("testing what the filter may do to people", 0.86)
            return self._outcomes(self._act_of(weights), some)

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
        self.progress("training the printed action encoder", 0.1)
        return self.compute.run(Lane.LEARNING, self.beat, printed_filter.fit_printed, self.problem, transitions)

    def finish(self, draft: FilterDraft, provenance: Provenance, learned: Mapping[str, Any]) -> Finished:
        """Prove and pack.

        ``learned``: the reward model's metrics and what to say of its foresight (``foresight_notes``), for the card.
        """
        started = time.perf_counter()
        proven = self.prove(draft)
        draft, evaluation = proven.draft, proven.evaluation
        unchanged = moves_nothing(draft.weights)
        metrics: dict[str, Any] = {
            "evaluation": evaluation,
            "uses_reference": unchanged,
            "promise": self._promised(draft, unchanged),
            "shield_active": _shield_active(proven),
            "rejected": proven.rejected,
            **_strengths(draft.weights),
            "mode": dict(draft.weights.mode),
            "method": draft.weights.method,
            "refined": bool(draft.weights.refined),
            "notes": [
                *draft.notes,
                *learned.get("foresight_notes", ()),
                *_warnings(evaluation, self.config.success_tolerance),
            ],
            "trials": [asdict(trial) for trial in draft.trials],
            "seconds": {**draft.seconds, "evaluation": round(time.perf_counter() - started, 1)},
            "weights": learned.get("weights"),
            "costs": learned.get("costs"),
            "choice": _choice(self.problem.task, draft),
        }
        contents = BundleContents(
            task=self._bundled_task(draft.weights),
            filter_onnx=proven.act.exported.stored,
            weights=draft.weights,
            reward=self.problem.reward,
            policy=self._policy_of(draft.weights),
            recording=self._recording(proven),
            metrics=metrics,
            provenance=provenance,
        )
        return Finished(draft.weights.to_bytes(), bundle.write(contents), metrics)

    def _bundled_task(self, weights: FilterWeights) -> Task:
        """The task with what runs beside the robot has to know of the policy that was chosen."""
        task, described = self.problem.task, registry.lab(self.task)
        if described is None or not (policy := task.modes.policy(task.modes.vector(weights.mode))):
            return task
        return replace(task, interface=registry.found_out(self.task).interface(described, policy))

    def _recording(self, proven: Proven) -> RecordedSteps:
        """What goes into the bundle; the policy's own actions are those of the one that was chosen."""
        recorded = RecordedSteps.of(proven.driven[:RECORDED_EPISODES])
        if not proven.draft.choice:
            return recorded
        policy = self._policy_of(proven.draft.weights)
        return replace(recorded, policy_means=policy.mean(recorded.observations))

    def _promised(self, draft: FilterDraft, unchanged: bool) -> dict[str, Any]:
        """The promise with its sentence; empty for a filter of which none is made."""
        if not draft.promise:
            return {}
        said = sentence(draft.promise, uses_reference=unchanged, task=self.problem.task)
        return {**draft.promise, "sentence": said}

    def prove(self, draft: FilterDraft) -> Proven:
        """Drive through unseen scenarios; a studio's filter that does not meet the burden of proof
        (worker.analysis.filters.proof) is replaced by the reference.
        """
        self.progress("driving the filter through unseen scenarios", 0.88)
        act = self._act_of(draft.weights)
        evaluation, driven = self._evaluate(act)
        against = case_against(evaluation) if draft.weights.method == "studio" else ()
        if not against:
            return Proven(draft, act, evaluation, driven, {})
        rejected = {"evaluation": evaluation, "mode": dict(draft.weights.mode), **_strengths(draft.weights)}
        draft = as_reference(draft, evaluation["preference"], against)
        act = self._act_of(draft.weights)
        return Proven(draft, act, *self._evaluate_reference(), rejected)

    def _evaluate(self, act: FilterAct) -> tuple[dict[str, Any], list[Trajectory]]:
        scenarios = first_of(EVALUATION, self.config.evaluation_scenarios)
        filtered = self.collect(act, scenarios, 0.0, self.seed)
        reference, reward = self.reference(scenarios), self.problem.reward
        return evaluate(
            reference, filtered, reward.returns(reference), reward.returns(filtered), self.problem.task
        ), filtered

    def _evaluate_reference(self) -> tuple[dict[str, Any], list[Trajectory]]:
        """What would be measured of a filter that changes nothing: simulations repeat themselves exactly."""
        reference = self.reference(first_of(EVALUATION, self.config.evaluation_scenarios))
        returns = self.problem.reward.returns(reference)
        return evaluate(reference, reference, returns, returns, self.problem.task), list(reference)

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

    def _act_of(self, weights: FilterWeights) -> FilterAct:
        return filter_problem.act_of(self.problem.task.modes, self._policy_of(weights), weights)

    def _policy_of(self, weights: FilterWeights) -> ReferencePolicy:
        """The frozen policy, or the one that was chosen."""
        return simulation.policy_in(self.task, weights.mode)

    def reference(self, scenarios: range, policy: str = "") -> Sequence[Trajectory]:
        """The frozen policy's rollouts, or those of another one: the same for everybody, so they are made once per
        worker."""
        key = (f"{self.task} {policy}".strip(), scenarios)
        if key not in self.references:
            act = simulation.reference_policy(self.task, policy).mean
            self.references[key] = self.collect(act, scenarios, 0.0, 0)
        return self.references[key]


def _choice(task: Task, draft: FilterDraft) -> dict[str, Any] | None:
    """Which of several policies it is in the end, and whether the answers clearly say so; None: a filter."""
    if not draft.choice:
        return None
    policy = task.modes.policy(task.modes.vector(draft.weights.mode)) or REFERENCE
    return {"policy": policy, "chances": dict(draft.choice), "sure": draft.choice[policy] >= SURE}


def moves_nothing(weights: FilterWeights) -> bool:
    """Whether the filter leaves the reference policy as it is."""
    without_residual = not weights.encoder or weights.residual_share == 0.0
    off = without_residual and not any(weights.mode.values()) and not weights.refined
    return weights.gate == 0.0 or (weights.method == "studio" and off)


def as_reference(draft: FilterDraft, preference: Mapping[str, float], against: Sequence[str]) -> FilterDraft:
    """A filter that changes nothing in place of one that did not meet the burden of proof, and why."""
    note = (
        "The reference policy is used as it is. The filter that was trained had no sure gain on unseen scenarios "
        f"(learned preference {preference['delta']:+.2f} [{preference['low']:+.2f}, {preference['high']:+.2f}] sd), "
        f"and a price: {'; '.join(against)}."
    )
    return replace(draft, weights=FilterWeights(gate=0.0), notes=(*draft.notes, note))


def _shield_active(proven: Proven) -> float | None:
    """In what share of the evaluation's steps the shield did something; None: there is none."""
    if not proven.act.exported.is_shielded:
        return None
    steps = RecordedSteps.of(proven.driven)
    (activity,) = proven.act.exported.run(steps.observations, steps.policy_means, [SHIELD])
    return round(float((activity > 0.0).mean()), 4)


def _strengths(weights: FilterWeights) -> dict[str, float]:
    return {"gate": weights.gate, "residual_share": weights.residual_share if weights.encoder else 0.0}


def _warnings(evaluation: dict[str, Any], tolerance: float) -> list[str]:
    """What must not be overlooked: the printed method is not gated, and a gate can be wrong on other scenarios."""
    delta = evaluation["success"]["delta"]
    if delta >= -tolerance:
        return []
    return [
        f"Success fell by {-100 * delta:.0f} points on unseen scenarios, more than the study's tolerance of "
        f"{100 * tolerance:.1f}. Do not run this filter on a person."
    ]


def draft_to_bytes(draft: FilterDraft) -> bytes:
    """A draft as one .npz file of plain arrays."""
    record = {
        "trials": [asdict(trial) for trial in draft.trials],
        "notes": draft.notes,
        "seconds": dict(draft.seconds),
        "promise": dict(draft.promise),
        "choice": dict(draft.choice),
    }
    arrays: dict[str, Any] = {f"value/{name}": array for name, array in draft.value.items()}
    arrays |= {f"tested/{name}": array for name, array in draft.tested.items()}
    arrays["weights"] = np.frombuffer(draft.weights.to_bytes(), np.uint8)
    arrays["record"] = np.array(json.dumps(record))
    target = io.BytesIO()
    np.savez(target, **arrays)
    return target.getvalue()


def draft_from_bytes(stored: bytes) -> FilterDraft:
    """Read what draft_to_bytes() wrote."""
    with np.load(io.BytesIO(stored), allow_pickle=False) as arrays:
        record = json.loads(str(arrays["record"]))
        value, tested = (
            {name.removeprefix(part): arrays[name] for name in arrays.files if name.startswith(part)}
            for part in ("value/", "tested/")
        )
        weights = FilterWeights.from_bytes(arrays["weights"].tobytes())
    trials = tuple(GateTrial(**each) for each in record["trials"])
    return FilterDraft(
        weights,
        value,
        trials,
        tuple(record["notes"]),
        record["seconds"],
        tested,
        record.get("promise", {}),
        record.get("choice", {}),
    )
