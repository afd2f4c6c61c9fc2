"""What a new reward model says beside its predictions: which clips it likes, and whether more labels still pay."""

from typing import Any

import numpy as np

from app.domain.studies import Participant, Study
from worker import dataset, laboratory
from worker.exploration import surface_file
from worker.ml.advice import expected_regret
from worker.ml.response_surface import ResponseSurface
from worker.ml.reward_models import RewardModel, load_reward_model
from worker.ml.segments import LEFT, SegmentPairs
from worker.workplace import Workplace


def insight(place: Workplace, participant_id: int, stored_model: bytes) -> dict[str, Any]:
    """More metrics of a reward model: ``ranking`` and, for simulated tasks, ``advice``."""
    model = load_reward_model(stored_model)
    found: dict[str, Any] = {"ranking": _ranking(place, participant_id, model)}
    regret = _regret(place, participant_id, model)
    if regret is not None:
        found["advice"] = {"expected_regret": round(regret, 4)}
    return found


def _ranking(place: Workplace, participant_id: int, model: RewardModel) -> list[list[float]]:
    """[scenario, behaviour, return] of every clip of the pool, the best first.

    Returns are those of what the clip shows, in standard deviations over the pool. Named by scenario and behaviour,
    since ids change when a study moves to another installation.
    """
    with place.database.reading() as session:
        participant = session.get_one(Participant, participant_id)
        clips = dataset.pool_clips(session, participant.study_id)
        if not clips:
            return []
        names = [(clip.rollout.scenario, clip.rollout.behaviour) for clip in clips]
        stretches = [dataset.stretch(place.store, clip) for clip in clips]
    shown = SegmentPairs.of([(stretch, stretch) for stretch in stretches])
    rewards = model.raw_rewards(shown.signals[:, LEFT], shown.observations[:, LEFT], shown.actions[:, LEFT])
    returns = rewards.sum(axis=-1, where=shown.shown[:, LEFT]).mean(axis=0)
    standard = (returns - returns.mean()) / max(float(returns.std()), 1e-9)
    order = np.argsort(-standard, kind="stable")
    return [[*names[row], round(float(standard[row]), 3)] for row in order]


def _regret(place: Workplace, participant_id: int, model: RewardModel) -> float | None:
    """None for recorded tasks, and for reward models that are not linear: their members' wishes are not known."""
    with place.database.reading() as session:
        study = session.get_one(Study, session.get_one(Participant, participant_id).study_id)
        task, recorded = study.task, study.material is not None
    if recorded or model.kind != "structured" or not surface_file(task).exists():
        return None
    surface = ResponseSurface.load(surface_file(task), laboratory.task(task).modes)
    return expected_regret(surface, model.signal_weights(()))
