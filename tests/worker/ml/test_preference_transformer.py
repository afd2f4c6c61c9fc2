"""The Preference Transformer: what it may look at, what it can learn that others cannot, how it scores candidates."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.worker import invented
from worker.domain.trajectory import SIGNALS
from worker.domain.type_aliases import FloatArray
from worker.ml.rewards import preference_transformer
from worker.ml.rewards.action_ranking import HistoryMemory, ranker_at
from worker.ml.rewards.loading import load_reward_model
from worker.ml.rewards.network_training import MlpTraining, TransformerTraining
from worker.ml.rewards.preference_transformer import PreferenceTransformer
from worker.ml.rewards.reward_models import StructuredReward
from worker.ml.rewards.reward_training import fit
from worker.ml.rewards.segments import SegmentPairs

STEPS = 10


def of_random_weights(stride: int = 2, layers: int = 2) -> PreferenceTransformer:
    """Two members that nobody has trained."""
    inputs = invented.D + invented.A
    drawn = preference_transformer.new_weights(inputs, 2, 8, layers, torch.Generator().manual_seed(1))
    weights = {name: (tensor * (50 if name == "reward" else 1)).numpy() for name, tensor in drawn.items()}
    return PreferenceTransformer(weights, np.zeros(inputs, np.float32), np.ones(inputs, np.float32), 2, stride)


def one_before_the_other(count: int, rng: np.random.Generator) -> tuple[SegmentPairs, FloatArray]:
    """A knock and a ring in every segment, equally loud everywhere; liked is to hear the knock first."""
    segments = np.zeros((count, 2, STEPS, 2), np.float32)
    knock_first = rng.random((count, 2)) < 0.5
    knock_first[:, 1] = ~knock_first[:, 0]
    for place in np.ndindex(count, 2):
        early, late = np.sort(rng.choice(STEPS, 2, replace=False))
        knock, ring = (early, late) if knock_first[place] else (late, early)
        segments[place][knock, 0] = segments[place][ring, 1] = 1.0
    actions = np.zeros((count, 2, STEPS, 7), np.float32)
    signals = np.zeros((count, 2, STEPS, len(SIGNALS)), np.float32)
    return SegmentPairs(signals, segments, actions), knock_first[:, 1].astype(np.float64)


def test_it_learns_a_preference_about_order_that_no_reward_of_single_steps_can() -> None:
    shown, targets = one_before_the_other(150, np.random.default_rng(0))
    unseen, truth = one_before_the_other(200, np.random.default_rng(1))
    training = {"members": 2, "hidden": 16, "learning_rate": 1e-2, "every_nth_step": 1, "patience": 12, "steps": 200}
    transformer = fit(
        shown,
        targets,
        "preference_transformer",
        0,
        transformer=TransformerTraining(weight_decay=0.0, **training),  # type: ignore[arg-type]
    ).model
    network = fit(shown, targets, "mlp", 0, mlp=MlpTraining(**training)).model  # type: ignore[arg-type]

    def accuracy(probabilities: FloatArray) -> float:
        return float(((probabilities > 0.5) == (truth > 0.5)).mean())

    assert accuracy(transformer.probability_right(unseen)) > 0.9
    assert accuracy(network.probability_right(unseen)) < 0.65
    assert np.abs(network.logits(unseen)).max() < 1e-3, "both segments hold the same steps: their sums are equal"


def test_what_comes_later_does_not_change_an_earlier_reward() -> None:
    model, episode = of_random_weights(), invented.trajectory(np.random.default_rng(0), steps=STEPS)
    changed = episode.actions.copy()
    changed[6] += 0.5
    before, after = (
        model.raw_rewards(episode.signals, episode.observations[:-1], actions) for actions in (episode.actions, changed)
    )
    np.testing.assert_array_equal(before[:, :6], after[:, :6])
    assert (np.abs(before[:, 6] - after[:, 6]) > 1e-6).all()
    assert (np.abs(before[:, 8] - after[:, 8]) > 1e-6).all(), "every second step is a token: 8 remembers 6"
    np.testing.assert_array_equal(before[:, 7], after[:, 7])


def test_an_episode_may_be_longer_than_the_clips_and_its_beginning_is_rewarded_alike() -> None:
    model, episode = of_random_weights(), invented.trajectory(np.random.default_rng(0), steps=40)
    whole = model.raw_rewards(episode.signals, episode.observations[:40], episode.actions)
    part = model.raw_rewards(episode.signals[:9], episode.observations[:9], episode.actions[:9])
    np.testing.assert_allclose(whole[:, :9], part, atol=1e-5)


def test_swapping_the_sides_flips_the_probability() -> None:
    model, shown = of_random_weights(), invented.pairs(6, np.random.default_rng(3), STEPS)
    there, back = model.probability_right(shown), model.probability_right(shown.swapped())
    np.testing.assert_allclose(there + back, 1.0, atol=1e-6)
    assert np.abs(there - 0.5).max() > 0.05


def test_steps_are_weighed_by_preference_attention_and_count_one_each_in_the_mean() -> None:
    model, shown = of_random_weights(), invented.pairs(3, np.random.default_rng(3), STEPS)
    weights = model.step_weights(shown)
    np.testing.assert_allclose(weights.mean(-1), 1.0, atol=1e-5)
    assert weights.std(-1).max() > 0.01
    returns = (model.raw_rewards(shown.signals, shown.observations, shown.actions) * weights).sum(-1)
    np.testing.assert_allclose(model.logits(shown), returns[..., 1] - returns[..., 0], atol=1e-6)


def test_it_survives_storage_bit_for_bit() -> None:
    model, shown = replace(of_random_weights(), temperature=1.7), invented.pairs(3, np.random.default_rng(3), STEPS)
    again = load_reward_model(model.to_bytes())
    np.testing.assert_array_equal(again.member_probabilities(shown), model.member_probabilities(shown))
    assert again.to_bytes() == model.to_bytes()


@pytest.mark.parametrize("stride", [1, 3])
def test_a_candidate_is_scored_in_place_of_the_last_action_of_the_history(stride: int) -> None:
    model, rng = of_random_weights(stride), np.random.default_rng(4)
    episodes = [invented.trajectory(rng, steps=steps) for steps in (7, 12)]
    candidates = rng.uniform(-1, 1, (2, 3, 7)).astype(np.float32)
    steps = (5, 11)
    rows = torch.tensor([steps[0], len(episodes[0]) + steps[1]])
    states = np.stack([episode.observations[step] for episode, step in zip(episodes, steps, strict=True)])
    repeated = torch.from_numpy(states)[:, None].expand(-1, 3, -1)
    scored = HistoryMemory(model, episodes).rewards(rows, repeated, torch.from_numpy(candidates)).numpy()
    for row, (episode, step) in enumerate(zip(episodes, steps, strict=True)):
        for column in range(3):
            actions = episode.actions[: step + 1].copy()
            actions[step] = candidates[row, column]
            expected = model.raw_rewards(episode.signals, episode.observations[: step + 1], actions)[:, step]
            np.testing.assert_allclose(scored[:, row, column], expected, atol=1e-5)


def test_the_executed_action_ranks_by_the_reward_it_had() -> None:
    model, episode = of_random_weights(), invented.trajectory(np.random.default_rng(5), steps=6)
    rank = ranker_at(model, [episode])(torch.tensor([4]))
    states, action = torch.from_numpy(episode.observations[4:5, None]), torch.from_numpy(episode.actions[4:5, None])
    expected = model.raw_rewards(episode.signals, episode.observations[:6], episode.actions)[:, 4].mean()
    assert float(rank(states, action)) == pytest.approx(expected, abs=1e-5)


def test_measured_signals_cannot_rank_untried_actions() -> None:
    episode = invented.trajectory(np.random.default_rng(5), steps=6)
    with pytest.raises(TypeError, match="preference_transformer"):
        ranker_at(StructuredReward(np.ones((8, len(SIGNALS)))), [episode])
