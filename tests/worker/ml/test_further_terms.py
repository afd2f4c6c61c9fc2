"""Further terms of the structured reward: who gets them, what they foresee, and that nobody else notices."""

from dataclasses import replace

import numpy as np
import pytest

from app.services.answers import misfit as flag
from tests.worker.ml.test_misfit import DISTANCE, SCENE, SPEED, STEPS, TILT, answers_to, pairs, total
from worker.domain.trajectory import SIGNALS
from worker.domain.type_aliases import FloatArray
from worker.ml.rewards import reward_training
from worker.ml.rewards.beyond_sums import choice, explanations, misfit
from worker.ml.rewards.beyond_sums.choice import fit_by_evidence
from worker.ml.rewards.beyond_sums.terms import FurtherTerms, RicherReward
from worker.ml.rewards.loading import load_reward_model
from worker.ml.rewards.prior import Prior
from worker.ml.rewards.reward_models import NEVER_WANTED
from worker.ml.rewards.reward_training import FitResult
from worker.ml.rewards.segments import SegmentPairs
from worker.ml.rewards.signal_scale import SignalScale

__all__ = ["pairs"]
LEARNED_FROM = 150


def lateness(pairs: SegmentPairs) -> FloatArray:
    """How far from step 35 the robot arrives, which no sum of signals says."""
    arrived = np.argmax(pairs.signals[..., DISTANCE] < 0.1, axis=-1)
    return np.abs(np.where((pairs.signals[..., DISTANCE] < 0.1).any(axis=-1), arrived, STEPS) - 35.0)


def learned(pairs: SegmentPairs, answers: FloatArray) -> FitResult:
    some = pairs.take(np.arange(LEARNED_FROM))
    return fit_by_evidence(
        some, answers[:LEARNED_FROM], 0, scale=SignalScale.of(some), signal_names=SIGNALS, scene=SCENE
    )


def foreseen(result: FitResult, pairs: SegmentPairs, answers: FloatArray) -> float:
    """The share of answers foreseen that it was not fitted to."""
    fresh = np.arange(LEARNED_FROM, len(pairs))
    hits: FloatArray = (result.model.probability_right(pairs.take(fresh)) > 0.5) == (answers[fresh] > 0.5)
    return float(hits.mean())


@pytest.fixture(scope="module")
def on_time(pairs: SegmentPairs) -> FitResult:
    return learned(pairs, answers_to(-lateness(pairs), mistakes=0.0))


def test_whoever_wants_the_robot_on_time_gets_terms_for_it_and_is_foreseen_better(
    pairs: SegmentPairs, on_time: FitResult
) -> None:
    answers = answers_to(-lateness(pairs), mistakes=0.0)
    assert (on_time.metrics["further"], on_time.model.kind) == ("arrival", "richer")
    some = pairs.take(np.arange(LEARNED_FROM))
    scale = SignalScale.of(some)
    linear = reward_training.fit(some, answers[:LEARNED_FROM], "structured", 0, scale=scale)
    assert foreseen(on_time, pairs, answers) > foreseen(linear, pairs, answers) + 0.1


def test_whose_answers_sums_explain_gets_exactly_the_model_of_sums(pairs: SegmentPairs) -> None:
    answers = answers_to(-total(pairs, SPEED) - 0.5 * total(pairs, TILT))
    result = learned(pairs, answers)
    some = pairs.take(np.arange(LEARNED_FROM))
    linear = reward_training.fit(some, answers[:LEARNED_FROM], "structured", 0, scale=SignalScale.of(some))
    assert result.metrics["further"] == ""
    assert result.model.to_bytes() == linear.model.to_bytes()


def test_whose_weights_change_gets_those_of_the_last_answers(pairs: SegmentPairs) -> None:
    """Fast first and slow in the end, fresh pairs are judged as in the end."""
    turning = np.append(np.linspace(3.0, -1.0, LEARNED_FROM), np.full(len(pairs) - LEARNED_FROM, -1.0))
    answers = answers_to(turning[:, None] * total(pairs, SPEED), mistakes=0.0)
    result = learned(pairs, answers)
    assert (result.metrics["further"], result.model.kind) == (misfit.CHANGING, "structured")
    some = pairs.take(np.arange(LEARNED_FROM))
    scale = SignalScale.of(some)
    alike = reward_training.fit(some, answers[:LEARNED_FROM], "structured", 0, scale=scale)
    assert foreseen(result, pairs, answers) > foreseen(alike, pairs, answers) + 0.3
    assert result.model.signal_weights(()).shape == alike.model.signal_weights(()).shape


def test_nobody_is_taken_to_like_the_worst_moment_of_what_nobody_wants(pairs: SegmentPairs) -> None:
    hardest = pairs.signals[..., SIGNALS.index("force_away_n")].max(axis=-1)
    some = pairs.take(np.arange(LEARNED_FROM))
    scale, terms = SignalScale.of(some), FurtherTerms.of(some, "worst_moments", SIGNALS, SCENE)
    answers = answers_to(hardest, mistakes=0.0)[:LEARNED_FROM]
    for costs, liked in ((NEVER_WANTED, False), ((), True)):
        model = reward_training.fit(some, answers, "structured", 0, scale=scale, costs=costs, further=terms).model
        assert isinstance(model, RicherReward)
        worst = len(SIGNALS) + terms.amounts.index("force_away_n")
        assert (model.weights[:, worst].mean() > 1e-3) == liked


def test_it_comes_back_from_its_file(pairs: SegmentPairs, on_time: FitResult) -> None:
    again = load_reward_model(on_time.model.to_bytes())
    assert isinstance(again, RicherReward)
    for model in (again, on_time.model):
        np.testing.assert_allclose(
            model.raw_rewards(pairs.signals, pairs.observations, pairs.actions),
            on_time.model.raw_rewards(pairs.signals, pairs.observations, pairs.actions),
            rtol=1e-4,
            atol=1e-4,
        )


def test_a_file_with_terms_that_there_are_not_is_no_reward_model(on_time: FitResult) -> None:
    with pytest.raises(ValueError, match="no terms for 'arriver'"):
        load_reward_model(on_time.model.to_bytes().replace(b"arrival", b"arriver"))


def test_a_file_that_names_signals_or_columns_which_there_are_not_costs_no_memory(on_time: FitResult) -> None:
    assert isinstance(on_time.model, RicherReward)
    with pytest.raises(ValueError, match="need the signals distance_m"):
        replace(on_time.model.terms, signal_names=("speed_m_s",))
    far_away = replace(on_time.model.terms, scene=(10**15,), scene_mean=np.zeros(1), scene_deviation=np.ones(1))
    assert far_away.width == on_time.model.terms.width


def test_a_file_of_a_version_with_other_terms_is_refused_in_words(
    on_time: FitResult, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(explanations, "KNOTS", (0, 20, 30, 40, 50))
    with pytest.raises(ValueError, match="another version: learn it anew"):
        load_reward_model(on_time.model.to_bytes())


def test_to_whoever_asks_for_weights_of_signals_it_gives_those_alone(on_time: FitResult) -> None:
    assert on_time.model.signal_weights(()).shape == (on_time.model.size, len(SIGNALS))
    assert on_time.metrics["weights"].keys() == set(SIGNALS)


def test_steps_that_were_not_shown_are_worth_nothing(pairs: SegmentPairs, on_time: FitResult) -> None:
    shown = np.arange(STEPS) < 45
    cut = SegmentPairs(pairs.signals[:, :, :45], pairs.observations[:, :, :45], pairs.actions[:, :, :45])
    filled = replace(
        pairs,
        signals=np.where(shown[:, None], pairs.signals, np.float32(0.0)),
        mask=np.broadcast_to(shown, (len(pairs), 2, STEPS)),
    )
    np.testing.assert_allclose(on_time.model.logits(filled), on_time.model.logits(cut), rtol=1e-5, atol=1e-5)


def test_a_wider_prior_knows_of_the_signals_what_it_knew() -> None:
    narrow = Prior.standard(2).or_like("somebody", [[1.0, 2.0], [3.0, 1.0], [2.0, 4.0]])
    for before, after in zip(narrow.populations, narrow.with_further(3, 0.5).populations, strict=True):
        np.testing.assert_array_equal(after.mean, [*before.mean, 0.0, 0.0, 0.0])
        np.testing.assert_array_equal(after.covariance[:2, :2], before.covariance)
        np.testing.assert_array_equal(after.covariance[2:], np.eye(5)[2:] * 0.25)


def test_pages_speak_of_the_evidence_that_the_model_goes_by() -> None:
    assert flag.DOUBT == choice.DOUBT
