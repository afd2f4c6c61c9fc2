"""Predicted probabilities mean what they say, on answers that the model has not learned from."""

from dataclasses import replace

import numpy as np
import pytest

from tests.worker import invented
from worker.domain.trajectory import SIGNALS
from worker.ml.rewards.calibration import HeldOut, expected_calibration_error, fit_temperature, report
from worker.ml.rewards.network_training import MlpTraining
from worker.ml.rewards.reward_training import fit


def answered(logits: np.ndarray[tuple[int, ...], np.dtype[np.float64]], seed: int = 0) -> HeldOut:
    """Answers that are as probable as one member's log odds say."""
    rng = np.random.default_rng(seed)
    answers = (rng.random(logits.shape[-1]) < 1 / (1 + np.exp(-logits))).astype(float)
    return HeldOut(logits[None], answers)


@pytest.mark.parametrize("exaggeration", [0.5, 1.0, 4.0])
def test_the_temperature_undoes_exaggeration(exaggeration: float) -> None:
    honest = answered(np.random.default_rng(1).normal(0, 2, 4000))
    found = fit_temperature(HeldOut(exaggeration * honest.logits, honest.answers))
    assert found == pytest.approx(exaggeration, rel=0.1)


def test_a_handful_of_answers_leaves_the_temperature_almost_alone() -> None:
    assert fit_temperature(HeldOut(np.full((2, 9), 5.0), np.zeros(9))) == 1.0
    assert 0.5 < fit_temperature(HeldOut(np.full((1, 12), 0.5), np.r_[np.zeros(1), np.ones(11)])) < 1.0


def test_the_expected_calibration_error_is_the_gap_between_confidence_and_accuracy() -> None:
    half_right = np.tile([0.0, 1.0], 50)
    assert expected_calibration_error(np.full(100, 0.9), half_right) == pytest.approx(0.4)
    assert expected_calibration_error(np.full(100, 0.1), half_right) == pytest.approx(0.4)
    assert expected_calibration_error(np.full(100, 0.5), np.full(100, 0.5)) == 0.0
    nine_of_ten = np.tile(np.r_[np.ones(9), 0.0], 10)
    assert expected_calibration_error(np.full(100, 0.9), nine_of_ten) == pytest.approx(0.0)


def test_calibration_reduces_the_error_of_an_exaggerating_model() -> None:
    honest = answered(np.random.default_rng(1).normal(0, 1.5, 3000))
    loud = HeldOut(5 * honest.logits, honest.answers)
    found = report(loud, fit_temperature(loud))
    assert found["expected_error"] < 0.03 < 0.1 < found["expected_error_before"]


@pytest.mark.parametrize("kind", ["structured", "mlp"])
def test_every_fit_reports_its_calibration_and_the_model_uses_it(kind: str) -> None:
    shown = invented.pairs(80, np.random.default_rng(1))
    likes = np.eye(len(SIGNALS))[1]
    config = MlpTraining(steps=40, members=2, hidden=8)
    fitted = fit(shown, invented.answers_of(shown, likes), "mlp" if kind == "mlp" else "structured", 0, mlp=config)
    calibration = fitted.metrics["calibration"]
    assert calibration["temperature"] == fitted.model.temperature != 1.0
    assert calibration["held_out_answers"] >= 10
    assert 0.0 <= calibration["expected_error"] <= 1.0
    plain = replace(fitted.model, temperature=1.0)
    same_side = (fitted.model.logits(shown) > 0) == (plain.logits(shown) > 0)
    assert same_side.all(), "a temperature changes no ranking"


def test_slips_do_not_make_a_model_hesitant_that_allows_for_them() -> None:
    """Sure and right on every pair, but five of a hundred answers were slips."""
    rng = np.random.default_rng(3)
    answers = (rng.random(400) < 0.5).astype(float)
    logits = np.where(answers > 0.5, 6.0, -6.0)[None]
    slipped = answers.copy()
    slipped[::20] = 1.0 - slipped[::20]
    assert fit_temperature(HeldOut(logits, slipped)) > 1.5
    assert fit_temperature(HeldOut(logits, slipped, allows_for_lapses=True)) < 1.2
