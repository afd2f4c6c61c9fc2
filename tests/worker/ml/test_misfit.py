"""Whether it is noticed that weighted sums of signals do not explain somebody's answers."""

import numpy as np
import pytest
from scipy.integrate import quad

from app.services.answers.accuracy import ENOUGH_EVIDENCE
from app.services.answers.misfit import IN_WORDS
from worker.domain.trajectory import SIGNALS
from worker.domain.type_aliases import FloatArray
from worker.ml.rewards.beyond_sums import explanations, misfit
from worker.ml.rewards.bradley_terry import probability_of_answer, probability_right
from worker.ml.rewards.segments import SegmentPairs
from worker.ml.rewards.signal_scale import SignalScale
from worker.tasks.registry import task

STEPS = 60
DISTANCE, SPEED, TILT, LATERAL = (
    SIGNALS.index(name) for name in ("distance_m", "speed_m_s", "tilt_rad", "lateral_offset_m")
)
SCENE = misfit.scene_of(task("feeding").observation)


@pytest.fixture(scope="module")
def pairs() -> SegmentPairs:
    """200 pairs of clips in which the robot arrives sooner or later, with one jerk each; the rest is noise."""
    rng = np.random.default_rng(4)
    signals = rng.gamma(0.5, 1.0, (200, 2, STEPS, len(SIGNALS))) * rng.gamma(1.0, 1.0, (200, 2, 1, len(SIGNALS)))
    signals[..., SPEED] = rng.uniform(0.0, 1.0, (200, 2, 1))
    signals[..., 30, SPEED] = rng.uniform(1.0, 20.0, (200, 2))
    arrives = rng.uniform(20, 55, (200, 2, 1))
    signals[..., DISTANCE] = np.clip(0.5 - 0.4 * np.arange(STEPS) / arrives, 0.02, None)
    observations = rng.standard_normal((200, 1, 1, 28)).repeat(2, axis=1).repeat(STEPS, axis=2)
    return SegmentPairs(
        signals.astype(np.float32), observations.astype(np.float32), np.zeros((200, 2, STEPS, 7), np.float32)
    )


def answers_to(worth: FloatArray, mistakes: float = 0.05) -> FloatArray:
    """What somebody says to whom the clips are worth so much, (N, 2) -> (N,)."""
    errs = np.random.default_rng(5).random(len(worth)) < mistakes
    return ((worth[:, 1] > worth[:, 0]) ^ errs).astype(np.float64)


def looked(pairs: SegmentPairs, answers: FloatArray) -> tuple[bool, str]:
    found = misfit.look(pairs, answers, SignalScale.of(pairs), SIGNALS, SCENE)
    return found["evidence"] >= ENOUGH_EVIDENCE, found["explanation"]


def total(pairs: SegmentPairs, column: int) -> FloatArray:
    summed: FloatArray = pairs.signals[..., column].sum(axis=-1, dtype=np.float64)
    return summed


def test_whoever_wants_less_of_some_signals_is_not_flagged(pairs: SegmentPairs) -> None:
    assert not looked(pairs, answers_to(-total(pairs, SPEED) - 0.5 * total(pairs, TILT)))[0]


def test_whoever_guesses_is_not_flagged_for_it(pairs: SegmentPairs) -> None:
    assert not looked(pairs, answers_to(-total(pairs, SPEED), mistakes=0.5))[0]


def test_whoever_minds_the_worst_moment_is_flagged_for_that(pairs: SegmentPairs) -> None:
    assert looked(pairs, answers_to(-pairs.signals[..., SPEED].max(axis=-1))) == (True, "worst_moments")


def test_whoever_wants_the_robot_neither_early_nor_late_is_flagged_for_that(pairs: SegmentPairs) -> None:
    arrival = (pairs.signals[..., DISTANCE] < explanations.ARRIVED_M).argmax(axis=-1)
    assert looked(pairs, answers_to(-np.abs(arrival - 35.0))) == (True, "arrival")


def test_whoever_wants_the_opposite_in_other_poses_is_flagged_for_that(pairs: SegmentPairs) -> None:
    turned = np.sign(pairs.observations[:, :, 0, SCENE[0]])
    assert looked(pairs, answers_to(turned * total(pairs, LATERAL))) == (True, "poses")


def test_whoever_comes_to_want_the_opposite_is_flagged_for_that(pairs: SegmentPairs) -> None:
    order = np.linspace(-1.0, 1.0, len(pairs))[:, None]
    assert looked(pairs, answers_to(order * total(pairs, SPEED))) == (True, "changing")


def test_nothing_is_said_of_a_few_answers(pairs: SegmentPairs) -> None:
    few = pairs.take(np.arange(misfit.FEWEST_ANSWERS - 1))
    assert misfit.look(few, np.ones(len(few)), SignalScale.of(few), SIGNALS, SCENE) == {}


def test_signals_of_another_name_leave_out_what_is_made_of_them(pairs: SegmentPairs) -> None:
    names = [f"signal_{number}" for number in range(len(SIGNALS))]
    assert misfit.further_differences(pairs, names) == {}
    found = misfit.look(pairs, answers_to(-total(pairs, SPEED)), SignalScale.of(pairs), names)
    assert found["explanation"] == "changing"


def test_every_explanation_has_words(pairs: SegmentPairs) -> None:
    assert {*misfit.further_differences(pairs, SIGNALS, SCENE), misfit.CHANGING} == IN_WORDS.keys()


def test_steps_that_were_not_shown_count_for_nothing(pairs: SegmentPairs) -> None:
    shown = np.arange(STEPS) < 45
    cut = SegmentPairs(pairs.signals[:, :, :45], pairs.observations[:, :, :45], pairs.actions[:, :, :45])
    filled = SegmentPairs(
        np.where(shown[:, None], pairs.signals, 0.0),
        np.where(shown[:, None], pairs.observations, 0.0),
        pairs.actions,
        np.broadcast_to(shown, (len(pairs), 2, STEPS)),
    )
    expected = misfit.further_differences(cut, SIGNALS, SCENE)
    for name, found in misfit.further_differences(filled, SIGNALS, SCENE).items():
        np.testing.assert_allclose(found, expected[name], atol=1e-6, err_msg=name)


def test_the_likelihood_is_that_of_the_answers_whatever_the_weight(pairs: SegmentPairs) -> None:
    """One weight, whose every value can be gone through."""
    feature = np.random.default_rng(6).standard_normal(200)
    answers = answers_to(np.stack([0 * feature, feature], axis=1), mistakes=0.3)

    def joint(weight: float) -> float:
        said = probability_of_answer(probability_right(feature * weight))
        prior = np.exp(-0.5 * (weight / 4.0) ** 2) / (4.0 * np.sqrt(2 * np.pi))
        return float(prior * np.prod(np.where(answers == 1.0, said, 1.0 - said)))

    exact = np.log(quad(joint, -20.0, 20.0, points=[0.0, 1.0, 2.0], limit=200)[0])
    assert misfit.log_likelihood(feature[:, None], answers, np.array([4.0])) == pytest.approx(exact, abs=0.1)
