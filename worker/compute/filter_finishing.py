"""From a fitted filter to a published one: proved on unseen scenarios, and packed as a bundle."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from app.installed_tasks.lab import REFERENCE
from worker.analysis.filters.evaluation import evaluate
from worker.analysis.filters.promise import sentence
from worker.analysis.filters.proof import case_against
from worker.compute.filter_fitting import FilterFit
from worker.domain.scenarios import EVALUATION, first_of
from worker.domain.task import Task
from worker.domain.trajectory import Trajectory
from worker.ml.export import bundle
from worker.ml.export.bundle import BundleContents, Provenance, RecordedSteps
from worker.ml.export.forward_model import ForwardModel
from worker.ml.export.interface import own_observation
from worker.ml.export.run_filter import strong_share
from worker.ml.filters.exported.filter_act import FilterAct
from worker.ml.filters.exported.filter_module import FilterWeights
from worker.ml.filters.fitting.filter_draft import FilterDraft
from worker.ml.filters.fitting.policy_choice import SURE
from worker.tasks import registry

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


def prove(fit: FilterFit, draft: FilterDraft) -> Proven:
    """Drive through unseen scenarios; a studio's filter that does not meet the burden of proof
    (worker.analysis.filters.proof) is replaced by the reference.
    """
    fit.during("finish")("driving the filter through unseen scenarios", 0.0)
    act = fit.act_of(draft.weights)
    evaluation, driven = _evaluate(fit, act)
    against = case_against(evaluation) if draft.weights.method == "studio" else ()
    if not against:
        return Proven(draft, act, evaluation, driven, {})
    rejected = {"evaluation": evaluation, "mode": dict(draft.weights.executed_mode), **_strengths(draft.weights)}
    draft = _as_reference(draft, evaluation["preference"], against)
    act = fit.act_of(draft.weights)
    return Proven(draft, act, *_evaluate_reference(fit), rejected)


def finish(fit: FilterFit, draft: FilterDraft, provenance: Provenance, learned: Mapping[str, Any]) -> Finished:
    """Prove and pack.

    ``learned``: the reward model's metrics and what to say of its foresight (``foresight_notes``), for the card.
    """
    started = time.perf_counter()
    proven = prove(fit, draft)
    draft, evaluation, task = proven.draft, proven.evaluation, fit.problem.task
    metrics: dict[str, Any] = {
        "evaluation": evaluation,
        "uses_reference": draft.weights.moves_nothing,
        "promise": _promised(draft, task),
        **_shield_activity(proven),
        "rejected": proven.rejected,
        **_strengths(draft.weights),
        "mode": dict(draft.weights.executed_mode),
        "method": draft.weights.method,
        "refined": bool(draft.weights.refined),
        "notes": [
            *draft.notes,
            *learned.get("foresight_notes", ()),
            *_warnings(evaluation, fit.config.success_tolerance),
        ],
        "trials": [asdict(trial) for trial in draft.trials],
        "seconds": {**draft.seconds, "evaluation": round(time.perf_counter() - started, 1)},
        "weights": learned.get("weights"),
        "costs": learned.get("costs"),
        "choice": _choice(task, draft),
    }
    contents = BundleContents(
        task=_bundled_task(task, draft.weights),
        filter_onnx=proven.act.exported.stored,
        weights=draft.weights,
        reward=fit.problem.reward,
        policy=fit.policy_of(draft.weights),
        recording=_recording(fit, proven),
        metrics=metrics,
        provenance=provenance,
        forward_model=forward_model_of(task, proven.driven),
    )
    return Finished(draft.weights.to_bytes(), bundle.write(contents), metrics)


def _evaluate(fit: FilterFit, act: FilterAct) -> tuple[dict[str, Any], list[Trajectory]]:
    scenarios = first_of(EVALUATION, fit.config.evaluation_scenarios)
    filtered = fit.collect(act, scenarios, 0.0, fit.seed)
    reference, reward = fit.reference(scenarios), fit.problem.reward
    returns = reward.returns(reference), reward.returns(filtered)
    return evaluate(reference, filtered, *returns, fit.problem.task), filtered


def _evaluate_reference(fit: FilterFit) -> tuple[dict[str, Any], list[Trajectory]]:
    """What would be measured of a filter that changes nothing: simulations repeat themselves exactly."""
    reference = fit.reference(first_of(EVALUATION, fit.config.evaluation_scenarios))
    returns = fit.problem.reward.returns(reference)
    return evaluate(reference, reference, returns, returns, fit.problem.task), list(reference)


def _as_reference(draft: FilterDraft, preference: Mapping[str, float], against: Sequence[str]) -> FilterDraft:
    """A filter that changes nothing in place of one that did not meet the burden of proof, and why."""
    note = (
        "The reference policy is used as it is. The filter that was trained had no sure gain on unseen scenarios "
        f"(learned preference {preference['delta']:+.2f} [{preference['low']:+.2f}, {preference['high']:+.2f}] sd), "
        f"and a price: {'; '.join(against)}."
    )
    return replace(draft, weights=FilterWeights(gate=0.0), notes=(*draft.notes, note))


def _bundled_task(task: Task, weights: FilterWeights) -> Task:
    """The task with what runs beside the robot has to know of the policy that was chosen."""
    described = registry.lab(task.name)
    if described is None or not (policy := task.modes.policy(task.modes.vector(weights.mode))):
        return task
    return replace(task, interface=registry.found_out(task.name).interface(described, policy))


def _recording(fit: FilterFit, proven: Proven) -> RecordedSteps:
    """What goes into the bundle; the policy's own actions are those of the one that was chosen."""
    recorded = RecordedSteps.of(proven.driven[:RECORDED_EPISODES])
    if not proven.draft.choice:
        return recorded
    policy = fit.policy_of(proven.draft.weights)
    return replace(recorded, policy_means=policy.mean(recorded.observations))


def _promised(draft: FilterDraft, task: Task) -> dict[str, Any]:
    """The promise with its sentence; empty for a filter of which none is made."""
    if not draft.promise:
        return {}
    said = sentence(draft.promise, uses_reference=draft.weights.moves_nothing, task=task)
    return {**draft.promise, "sentence": said}


def _choice(task: Task, draft: FilterDraft) -> dict[str, Any] | None:
    """Which of several policies it is in the end, and whether the answers clearly say so; None: a filter."""
    if not draft.choice:
        return None
    policy = task.modes.policy(task.modes.vector(draft.weights.mode)) or REFERENCE
    return {"policy": policy, "chances": dict(draft.choice), "sure": draft.choice[policy] >= SURE}


def _shield_activity(proven: Proven) -> dict[str, float]:
    """The share of the evaluation's steps with any activity of the shield, and the usual limit of strong_share()."""
    if not proven.act.exported.is_shielded:
        return {}
    activities = [proven.act.shield_activity(each) for each in proven.driven]
    return {
        "shield_active": round(float((np.concatenate(activities) > 0.0).mean()), 4),
        "shield_strong_at_most": round(usually_at_most([strong_share(each) for each in activities]), 4),
    }


def usually_at_most(shares: Sequence[float]) -> float:
    """What 99 of 100 episodes do not exceed; with fewer of them the largest."""
    return float(np.quantile(shares, 0.99, method="higher"))


def forward_model_of(task: Task, driven: Sequence[Trajectory]) -> ForwardModel | None:
    """Of what clients see: what a loop adds to a laboratory's observations is not measured."""
    seen = own_observation(task)
    return ForwardModel.learned([(each.observations[:, : seen.size], each.actions) for each in driven], seen.widths)


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
