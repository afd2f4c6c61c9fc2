"""Signals that are foreseen instead of measured: how well, and what a reward model makes of them."""

import json
from functools import cache
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
import torch

from app.installed_tasks import catalogue
from tests.worker import invented
from worker.compute import learning, simulation
from worker.domain.trajectory import SIGNALS, Trajectory
from worker.experiments import train_signal_predictor
from worker.experiments.rollout_cache import RolloutCache
from worker.ml.rewards import reward_training, signal_training
from worker.ml.rewards.action_ranking import ranker_at
from worker.ml.rewards.loading import load_reward_model
from worker.ml.rewards.predicted_reward import PredictedReward
from worker.ml.rewards.reward_models import StructuredReward
from worker.ml.rewards.segments import SegmentPairs
from worker.ml.rewards.signal_predictor import UNSENSED, SignalPredictor
from worker.ml.rewards.signal_scale import SignalScale
from worker.ml.rewards.signal_training import PredictorTraining
from worker.sim.rollout import rollout

QUICK = PredictorTraining(hidden=16, steps=60, batch=64, learning_rate=1e-2)
SPEED, FORCE = SIGNALS.index("speed_m_s"), SIGNALS.index("force_at_target_n")


def random_weights(seed: int = 1) -> StructuredReward:
    """Likes and dislikes of no one."""
    return StructuredReward(np.random.default_rng(seed).standard_normal((8, len(SIGNALS))))


def predicted() -> PredictedReward:
    """The same with foreseen signals."""
    return PredictedReward.with_predictor(random_weights(), invented.predictor())


@cache
def episodes(task: str, count: int) -> list[Trajectory]:
    """Behaviours as in a pool of clips, in scenarios that the predictor has never seen; nobody changes them."""
    found = []
    for scenario in range(260_000, 260_000 + count):
        for behaviour in simulation.behaviours(task, scenario, 3):
            found.append(rollout(simulation.environment(task), simulation.act_as(task, behaviour), scenario))
    return found


@pytest.mark.parametrize("task", catalogue.names())
def test_what_ships_foresees_the_signals_of_clips_it_has_not_seen(task: str) -> None:
    found = signal_training.explained(simulation.signal_predictor(task), episodes(task, 4), steps=60)
    assert found["distance_m"]["clip"] > 0.9
    assert found["speed_squared_m2_s2"]["clip"] > 0.8
    assert found["force_at_target_n" if task != "drinking" else "undelivered"]["clip"] > 0.5


def test_it_learns_a_signal_that_follows_from_the_action_and_is_the_same_every_time() -> None:
    rng = np.random.default_rng(0)
    rollouts = [invented.trajectory(rng) for _ in range(200)]
    training = PredictorTraining(hidden=32, steps=500, batch=128, learning_rate=1e-2)
    first, again, other = (signal_training.fit(rollouts, seed, training) for seed in (0, 0, 1))
    share = signal_training.explained(first, [invented.trajectory(rng) for _ in range(20)], 10)
    assert share["speed_m_s"]["step"] > 0.9  # invented speeds are the first joint's action
    assert share["force_at_target_n"]["step"] < 0.2  # invented forces are noise
    assert np.array_equal(first.layers[0][0], again.layers[0][0])
    assert not np.array_equal(first.layers[0][0], other.layers[0][0])


def test_a_constant_signal_is_foreseen_as_that_constant() -> None:
    rng = np.random.default_rng(0)
    signals = np.full((20, len(SIGNALS)), 3.0)
    foreseen = signal_training.fit([invented.trajectory(rng, signals=signals) for _ in range(4)], 0, QUICK)
    episode = invented.trajectory(rng)
    np.testing.assert_allclose(foreseen.predict(episode.observations[:-1], episode.actions).mean(axis=0), 3.0, atol=0.3)


def test_no_sensor_on_the_person_is_read() -> None:
    episode, model = invented.trajectory(np.random.default_rng(3)), predicted()
    before = model.raw_rewards(episode.signals, episode.observations[:-1], episode.actions)
    unsensed = [SIGNALS.index(name) for name in UNSENSED]
    hidden, moved = episode.signals.copy(), episode.signals.copy()
    hidden[:, unsensed] = np.nan
    moved[:, SPEED] += 1.0
    assert np.array_equal(model.raw_rewards(hidden, episode.observations[:-1], episode.actions), before)
    changed = model.raw_rewards(moved, episode.observations[:-1], episode.actions) - before
    np.testing.assert_allclose(changed, np.tile(model.weights[:, [SPEED]], len(episode)))


def test_labels_are_read_without_those_sensors() -> None:
    """Somebody's answers about forces are learned from foreseen forces: the measured ones may be missing."""
    rng = np.random.default_rng(4)
    shown = invented.pairs(60, rng)
    measured = shown.signals.copy()
    measured[..., FORCE] = 1e6 * rng.standard_normal(measured.shape[:-1])
    answers = invented.answers_of(shown, -np.eye(len(SIGNALS))[SPEED])
    models = [
        reward_training.fit(
            SegmentPairs(signals, shown.observations, shown.actions),
            answers,
            "predicted",
            0,
            scale=SignalScale.of(shown),
            predictor=invented.predictor(),
        ).model.to_bytes()
        for signals in (shown.signals, measured)
    ]
    assert models[0] == models[1]


def test_the_stored_model_needs_nothing_beside_it() -> None:
    episode, model = invented.trajectory(np.random.default_rng(3)), predicted()
    again = load_reward_model(model.to_bytes())
    assert isinstance(again, PredictedReward)
    assert again.size == 8
    np.testing.assert_allclose(again.returns([episode]), model.returns([episode]), rtol=1e-5)


def test_untried_actions_are_ranked_by_what_they_would_measure() -> None:
    episode, model = invented.trajectory(np.random.default_rng(3)), predicted()
    rank = ranker_at(model, [episode])(torch.tensor([0, 1]))
    states = torch.from_numpy(np.repeat(episode.observations[:2, None], 3, axis=1))
    actions = torch.from_numpy(np.random.default_rng(0).uniform(-1, 1, (2, 3, 7)).astype(np.float32))
    expected = model.predictor.predict(states.numpy(), actions.numpy()) @ model.weights.mean(axis=0)
    np.testing.assert_allclose(rank(states, actions).numpy(), expected, rtol=1e-5)


def test_a_file_says_the_same_again(tmp_path: Path) -> None:
    foreseen, episode = invented.predictor(), invented.trajectory(np.random.default_rng(0))
    foreseen.save(tmp_path / "predictor.safetensors")
    again = SignalPredictor.load(tmp_path / "predictor.safetensors")
    there, back = (each.predict(episode.observations[:-1], episode.actions) for each in (foreseen, again))
    assert np.array_equal(there, back)


def test_a_model_without_a_predictor_is_refused_in_words() -> None:
    with pytest.raises(ValueError, match="needs a predictor of the signals"):
        reward_training.fit(invented.pairs(4, np.random.default_rng(0)), [1, 0, 1, 0], "predicted", 0)


def test_a_task_whose_signals_cannot_be_foreseen_says_what_to_do(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(simulation, "checkpoint", lambda name: tmp_path / name)
    simulation.signal_predictor.cache_clear()
    with pytest.raises(simulation.NoPredictor, match="python -m worker foresee --task drinking"):
        simulation.signal_predictor("drinking")


def test_a_study_s_reward_model_is_fitted_without_sensors() -> None:
    rng = np.random.default_rng(5)
    rollouts = episodes("feeding", 4)
    couples = [(rollouts[3 * at], rollouts[3 * at + 1]) for at in range(4)]
    shown = SegmentPairs.cut(couples, 0, 60)
    answers: npt.NDArray[np.float32] = rng.integers(0, 2, len(shown)).astype(np.float32)
    stored, metrics = learning.fit_reward("feeding", "predicted", shown, answers, SignalScale.of(shown), 0)
    model = load_reward_model(stored)
    assert isinstance(model, PredictedReward)
    assert metrics["kind"] == "predicted"
    assert set(metrics["weights"]) == set(SIGNALS)


@pytest.mark.long
def test_the_command_keeps_its_rollouts_and_says_how_well_signals_are_foreseen(tmp_path: Path) -> None:
    target = tmp_path / "predictor.safetensors"
    record = train_signal_predictor.foresee(
        "feeding", tmp_path, 1, scenarios=2, tested=1, training=QUICK, target=target
    )
    assert json.loads(target.with_suffix(".json").read_text()) == record
    assert record["explained_share"]["distance_m"]["step"] > 0.3
    kept = list(RolloutCache("feeding", tmp_path).directory.glob("behaviour-*.npz"))
    made = {path: path.stat().st_mtime_ns for path in kept}
    again = train_signal_predictor.foresee("feeding", tmp_path, 1, scenarios=2, tested=1, training=QUICK, target=target)
    assert again == record
    assert {path: path.stat().st_mtime_ns for path in kept} == made
    assert len(kept) == 18
