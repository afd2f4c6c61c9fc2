"""What a new reward model says beside its predictions: which clips it likes, what it thinks of the paper's six costs,
and whether more labels still pay."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from app.domain.studies import Participant, Study
from worker.compute.simulation import surface_file
from worker.domain.trajectory import COSTS
from worker.domain.type_aliases import FloatArray
from worker.jobs.learning import dataset
from worker.jobs.runtime.context import WorkerContext
from worker.ml.filters.fitting.response_surface import ResponseSurface
from worker.ml.rewards.loading import load_reward_model
from worker.ml.rewards.reward_models import RewardModel
from worker.ml.rewards.segments import LEFT, SegmentPairs, Stretch
from worker.ml.stopping import relative_regret
from worker.tasks import registry

FEWEST_CLIPS = 12
"""Fewer say nothing about six costs."""
WITHIN_95 = 1.96
"""Standard deviations on either side of a mean."""


def insight(context: WorkerContext, participant_id: int, stored_model: bytes) -> dict[str, Any]:
    """More metrics of a reward model: ``ranking`` and, for simulated tasks, ``costs`` and ``advice``."""
    model = load_reward_model(stored_model)
    with context.database.reading() as session:
        study = session.get_one(Study, session.get_one(Participant, participant_id).study_id)
        task, recorded = study.task, study.material is not None
        clips = dataset.pool_clips(session, study.id)
        names = [(clip.rollout.scenario, clip.rollout.behaviour) for clip in clips]
        stretches = [dataset.stretch(context.store, clip) for clip in clips]
    returns = _returns(model, stretches) if stretches else np.zeros((1, 0))
    found: dict[str, Any] = {"ranking": _ranking(names, returns)}
    if recorded:
        return found
    if len(stretches) >= FEWEST_CLIPS:
        sums = np.array([each.cut("costs").sum(axis=0, dtype=np.float64) for each in stretches])
        found["costs"] = weights_of_costs(sums, returns, registry.task(task).costs)
    regret = _regret(task, model)
    if regret is not None:
        found["advice"] = {"relative_regret": round(regret, 4)}
    return found


def weights_of_costs(sums: FloatArray, returns: FloatArray, costs_named: Sequence[str] = COSTS) -> dict[str, Any]:
    """What the model's returns say about the paper's six costs, whatever it was learned from.

    ``sums`` (N, C): summed costs of every clip, ``costs_named`` in that order; ``returns`` (E, N): every member's
    return of it. Least squares of each member's standardised returns on the standardised costs. Weights are
    standard deviations of the learned return per standard deviation of a cost, the other costs being equal;
    positive: liked. Intervals (95 %) hold how members differ and what the costs leave unexplained. Costs that are
    the same in all clips are left out. ``explained``: the share of the mean return's variance.
    """
    varied = sums.std(axis=0) > 1e-9
    costs, mean_return = _standardised(sums[:, varied]), _standardised(returns.mean(axis=0))
    inverse = np.linalg.pinv(costs.T @ costs)
    members = np.array([inverse @ costs.T @ _standardised(each) for each in returns])
    left_over = (mean_return - costs @ (inverse @ costs.T @ mean_return)).var()
    variance = members.var(axis=0) + left_over * np.diag(inverse)
    mean, spread = members.mean(axis=0), WITHIN_95 * np.sqrt(variance)
    names = [name for name, there in zip(costs_named, varied, strict=True) if there]
    return {
        "weights": {
            name: {"mean": round(float(at), 4), "low": round(float(at - by), 4), "high": round(float(at + by), 4)}
            for name, at, by in zip(names, mean, spread, strict=True)
        },
        "explained": round(float(max(0.0, 1.0 - left_over)), 4),
    }


def _standardised(values: FloatArray) -> FloatArray:
    """Mean 0 and standard deviation 1 along the first axis; what does not vary becomes 0."""
    standard: FloatArray = (values - values.mean(axis=0)) / np.maximum(values.std(axis=0), 1e-9)
    return standard


def _returns(model: RewardModel, stretches: Sequence[Stretch]) -> FloatArray:
    """Every member's return of what each clip shows, (E, N)."""
    shown = SegmentPairs.of([(stretch, stretch) for stretch in stretches])
    rewards = model.raw_rewards(shown.signals[:, LEFT], shown.observations[:, LEFT], shown.actions[:, LEFT])
    returns: FloatArray = rewards.sum(axis=-1, where=shown.shown[:, LEFT]).astype(np.float64)
    return returns


def _ranking(names: Sequence[tuple[int, int]], returns: FloatArray) -> list[list[float]]:
    """[scenario, behaviour, return] of every clip of the pool, the best first; in standard deviations over the pool.

    Named by scenario and behaviour, since ids change when a study moves to another installation.
    """
    if not names:
        return []
    standard = _standardised(returns.mean(axis=0))
    order = np.argsort(-standard, kind="stable")
    return [[*names[row], round(float(standard[row]), 3)] for row in order]


def _regret(task: str, model: RewardModel) -> float | None:
    """None for reward models that are not linear: their members' wishes are not known."""
    if not model.is_linear or not surface_file(task).exists():
        return None
    described = registry.task(task)
    surface = ResponseSurface.load(surface_file(task), described.modes, described.signals)
    return relative_regret(surface, model.signal_weights(()))
