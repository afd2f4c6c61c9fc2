"""Whole trajectories and clips are learned from together: what fills up the shorter ones must count for nothing."""

import numpy as np
import pytest

from tests.worker import invented
from worker.domain.trajectory import Trajectory
from worker.ml.rewards import reward_training
from worker.ml.rewards.network_training import MlpTraining, TransformerTraining
from worker.ml.rewards.reward_models import RewardModel
from worker.ml.rewards.segments import SegmentPairs, Stretch

SHORT, LONG = 20, 33
KINDS: tuple[reward_training.RewardKind, ...] = ("structured", "mlp", "preference_transformer")
Both = list[tuple[Trajectory, Trajectory]]


@pytest.fixture(scope="module")
def both() -> Both:
    rng = np.random.default_rng(4)
    return [(invented.trajectory(rng, steps=LONG), invented.trajectory(rng, steps=LONG)) for _ in range(30)]


def stretches(both: Both, counts: list[int]) -> SegmentPairs:
    return SegmentPairs.of(
        [(Stretch(left, 0, count), Stretch(right, 0, count)) for (left, right), count in zip(both, counts, strict=True)]
    )


@pytest.fixture(scope="module", params=KINDS)
def model(request: pytest.FixtureRequest, both: Both) -> RewardModel:
    """Trained on clips and whole trajectories at once."""
    mixed = stretches(both, [LONG] * 10 + [SHORT] * 20)
    answers = invented.answers_of(mixed, np.random.default_rng(2).standard_normal(invented.S))
    return reward_training.fit(
        mixed,
        answers,
        request.param,
        seed=1,
        mlp=MlpTraining(steps=30),
        transformer=TransformerTraining(steps=10, hidden=16),
    ).model


def garbled(pairs: SegmentPairs) -> SegmentPairs:
    """The same pairs with noise where nothing was shown."""
    rng = np.random.default_rng(9)

    def noisy(
        array: np.ndarray[tuple[int, ...], np.dtype[np.float32]],
    ) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
        noise = rng.standard_normal(array.shape).astype(np.float32)
        return np.where(pairs.shown[..., None], array, noise)

    return SegmentPairs(noisy(pairs.signals), noisy(pairs.observations), noisy(pairs.actions), pairs.mask)


def test_a_pair_that_was_filled_up_is_worth_what_it_is_worth_alone(model: RewardModel, both: Both) -> None:
    alone = SegmentPairs.cut(both[:5], 0, SHORT)
    beside_longer_ones = stretches(both[:10], [SHORT] * 5 + [LONG] * 5)
    logits = model.logits(beside_longer_ones)[:, :5]
    np.testing.assert_allclose(logits, model.logits(alone), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(
        model.member_probabilities(beside_longer_ones)[:, :5], model.member_probabilities(alone), atol=1e-6
    )


def test_what_fills_up_a_pair_is_never_looked_at(model: RewardModel, both: Both) -> None:
    mixed = stretches(both[:10], [SHORT] * 5 + [LONG] * 5)
    np.testing.assert_array_equal(model.logits(garbled(mixed)), model.logits(mixed))
    np.testing.assert_array_equal(garbled(mixed).signal_differences(), mixed.signal_differences())


@pytest.mark.parametrize("kind", KINDS)
def test_training_never_looks_at_what_fills_up_a_pair(kind: reward_training.RewardKind, both: Both) -> None:
    mixed = stretches(both, [LONG] * 10 + [SHORT] * 20)
    answers = invented.answers_of(mixed, np.ones(invented.S))
    brief, briefer = MlpTraining(steps=10), TransformerTraining(steps=4, hidden=16)
    clean, noisy = (
        reward_training.fit(pairs, answers, kind, 3, mlp=brief, transformer=briefer)
        for pairs in (mixed, garbled(mixed))
    )
    assert clean.model.to_bytes() == noisy.model.to_bytes()
    assert clean.metrics["calibration"] == noisy.metrics["calibration"]


def test_the_sum_of_signals_is_exactly_that_of_the_steps_shown(both: Both) -> None:
    mixed = stretches(both[:3], [SHORT, LONG, SHORT])
    alone = SegmentPairs.cut(both[:1], 0, SHORT)
    np.testing.assert_array_equal(mixed.signal_differences()[:1], alone.signal_differences())


def test_rows_and_sides_keep_their_own_lengths(both: Both) -> None:
    mixed = SegmentPairs.of([(Stretch(both[0][0], 0, SHORT), Stretch(both[0][1], 0, LONG))] * 2)
    assert mixed.shown.sum(axis=2).tolist() == [[SHORT, LONG]] * 2
    assert mixed.swapped().take(np.array([1])).shown.sum(axis=2).tolist() == [[LONG, SHORT]]


def test_segments_of_one_length_need_no_filling_up(both: Both) -> None:
    assert SegmentPairs.cut(both[:2], 0, SHORT).mask is None


def test_a_stretch_beyond_the_end_of_its_trajectory_is_refused(both: Both) -> None:
    with pytest.raises(ValueError, match=f"only {LONG}"):
        SegmentPairs.of([(Stretch(both[0][0], 0, LONG), Stretch(both[0][1], 5, LONG))])
