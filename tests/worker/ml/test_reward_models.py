"""Reward models: the right form of Eq. (2), all kinds, normalisation, storage."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.worker import invented
from worker.domain.trajectory import SIGNALS
from worker.ml.rewards import bradley_terry, preference_loss, reward_training
from worker.ml.rewards.laplace import SMALLEST_GAIN
from worker.ml.rewards.loading import load_reward_model
from worker.ml.rewards.network_training import MlpTraining, TransformerTraining
from worker.ml.rewards.prior import DEVIATION
from worker.ml.rewards.reward_models import CLIP, RewardModel, StructuredReward, stored_config
from worker.ml.rewards.reward_training import fit, posterior
from worker.ml.rewards.segments import SegmentPairs
from worker.ml.rewards.signal_scale import SignalScale

KINDS: tuple[reward_training.RewardKind, ...] = ("structured", "predicted", "mlp", "preference_transformer")
QUICK = MlpTraining(steps=100, members=3, hidden=16, learning_rate=5e-3)
QUICK_TRANSFORMER = TransformerTraining(steps=120, members=2, hidden=16, learning_rate=1e-2, every_nth_step=1)
PREDICTOR = invented.predictor()
DISLIKES_SPEED = np.array([-1.0 if name == "speed_m_s" else 0.0 for name in SIGNALS])


@pytest.fixture(scope="module")
def labelled() -> tuple[SegmentPairs, np.ndarray]:
    """A hundred pairs labelled by somebody who minds speed only."""
    shown = invented.pairs(100, np.random.default_rng(1))
    return shown, invented.answers_of(shown, DISLIKES_SPEED)


@pytest.fixture(scope="module", params=KINDS)
def model(request: pytest.FixtureRequest, labelled: tuple[SegmentPairs, np.ndarray]) -> RewardModel:
    """All kinds, fitted."""
    return fit(*labelled, request.param, 3, mlp=QUICK, transformer=QUICK_TRANSFORMER, predictor=PREDICTOR).model


@pytest.mark.parametrize(("left", "right"), [(1.0, 0.0), (0.0, 1.0), (0.3, 0.3), (-700.0, 700.0)])
def test_swapping_the_sides_flips_the_preference(left: float, right: float) -> None:
    there = bradley_terry.probability_right(np.array(bradley_terry.preference_logits(left, right)))
    back = bradley_terry.probability_right(np.array(bradley_terry.preference_logits(right, left)))
    assert there + back == pytest.approx(1.0)
    assert bool(there > 0.5) == (right > left)


def test_the_probability_is_the_softmax_of_the_returns_as_in_equation_1() -> None:
    left, right = 0.4, 1.1
    expected = np.exp(right) / (np.exp(left) + np.exp(right))
    logits = bradley_terry.preference_logits(left, right)
    assert bradley_terry.probability_right(np.array(logits)) == pytest.approx(expected)


def test_an_equal_answer_is_served_best_by_equal_returns() -> None:
    target = torch.tensor([0.5])
    losses = [float(preference_loss.preference_loss(torch.tensor([logit]), target)) for logit in (-1.0, 0.0, 1.0)]
    assert losses[1] < losses[0] == pytest.approx(losses[2])


def test_equation_2_as_printed_learns_the_reversed_preference() -> None:
    """y = 1 means right was preferred: the right form raises the return of right, the printed one that of left."""
    learned = []
    for loss in (preference_loss.preference_loss, preference_loss.preference_loss_as_printed):
        logit = torch.zeros(1, requires_grad=True)
        loss(logit, torch.ones(1)).backward()  # type: ignore[no-untyped-call]
        assert logit.grad is not None
        learned.append(-float(logit.grad))
    right_form, as_printed = learned
    assert right_form > 0 > as_printed


def test_the_structured_fit_minimises_the_right_form_of_equation_2_for_people_who_slip_with_a_normal_prior(
    labelled: tuple[SegmentPairs, np.ndarray],
) -> None:
    shown, targets = labelled
    features = shown.signal_differences() / SignalScale.of(shown).spread
    mean, covariance, _ = posterior(features, targets)
    weights = torch.tensor(mean, requires_grad=True)
    logits = torch.tensor(features) @ weights
    said, y = 0.05 + 0.9 * torch.sigmoid(logits), torch.tensor(targets)
    surprise = -(y * said.log() + (1 - y) * (1 - said).log()).sum()
    (surprise + 0.5 * (weights**2).sum() / DEVIATION**2).backward()  # type: ignore[no-untyped-call]
    assert weights.grad is not None
    assert float(weights.grad.abs().max()) < 1e-5
    assert np.linalg.eigvalsh(covariance).min() > 0


def test_slips_on_easy_pairs_do_not_outweigh_careful_answers(labelled: tuple[SegmentPairs, np.ndarray]) -> None:
    """Somebody who minds speed only has three times named the clip that is far too fast."""
    shown, targets = labelled
    easiest = np.argsort(-np.abs(shown.signal_differences()[:, SIGNALS.index("speed_m_s")]))[:3]
    slipped = targets.copy()
    slipped[easiest] = 1.0 - slipped[easiest]
    unseen = invented.pairs(300, np.random.default_rng(2))
    truth = invented.answers_of(unseen, DISLIKES_SPEED) > 0.5
    careful, careless = (
        float(((fit(shown, said, "structured", 0).model.probability_right(unseen) > 0.5) == truth).mean())
        for said in (targets, slipped)
    )
    assert careless > careful - 0.02


def test_what_somebody_says_mattered_is_believed_of_that_alone() -> None:
    """Slow clips are also gentle ones: only what is named tells which of the two is minded."""
    rng = np.random.default_rng(6)
    speed, force = SIGNALS.index("speed_m_s"), SIGNALS.index("force_away_n")
    shown = invented.pairs(60, rng)
    shown.signals[..., force] = shown.signals[..., speed]
    named = np.zeros((60, len(SIGNALS)), bool)
    named[:, speed] = True
    answers = invented.answers_of(shown, DISLIKES_SPEED)
    weights = [fit(shown, answers, "structured", 0, mattered=mattered).metrics["weights"] for mattered in (None, named)]
    unnamed, heard = ((each["speed_m_s"]["mean"], each["force_away_n"]["mean"]) for each in weights)
    assert unnamed[0] == pytest.approx(unnamed[1])
    assert heard[0] < unnamed[0]
    assert heard[1] > unnamed[1]


def test_naming_nothing_changes_nothing(labelled: tuple[SegmentPairs, np.ndarray]) -> None:
    nothing = np.zeros((100, len(SIGNALS)), bool)
    said, unsaid = (fit(*labelled, "structured", 3, mattered=mattered) for mattered in (nothing, None))
    assert said.model.to_bytes() == unsaid.model.to_bytes()


def test_no_hints_change_nothing(labelled: tuple[SegmentPairs, np.ndarray]) -> None:
    said, unsaid = (fit(*labelled, "structured", 3, hints=hints) for hints in (np.zeros((0, len(SIGNALS))), None))
    assert said.model.to_bytes() == unsaid.model.to_bytes()


def test_a_hint_is_believed_at_first_and_outvoted_by_answers_that_say_the_opposite() -> None:
    """Somebody who minds speed hints at the opposite."""
    speed = SIGNALS.index("speed_m_s")
    wrong = np.eye(len(SIGNALS))[[speed]]
    shown = invented.pairs(60, np.random.default_rng(6))
    answers = invented.answers_of(shown, DISLIKES_SPEED)

    def weight(count: int, hints: np.ndarray | None) -> float:
        few = SegmentPairs(shown.signals[:count], shown.observations[:count], shown.actions[:count])
        found = fit(few, answers[:count], "structured", 0, scale=SignalScale.of(shown), hints=hints)
        return float(found.metrics["weights"]["speed_m_s"]["mean"])

    assert weight(1, wrong) > max(0.0, weight(1, None))
    assert weight(60, wrong) < 0.5 * weight(60, None) < 0.0


def test_weights_stay_finite_when_a_few_answers_can_be_explained_perfectly() -> None:
    shown = invented.pairs(12, np.random.default_rng(4))
    model = fit(shown, invented.answers_of(shown, 1e3 * DISLIKES_SPEED), "structured", 0).model
    assert isinstance(model, StructuredReward)
    assert np.isfinite(model.weights).all()


def test_all_kinds_rank_what_they_were_told(model: RewardModel, labelled: tuple[SegmentPairs, np.ndarray]) -> None:
    shown, targets = labelled
    right = (model.probability_right(shown) > 0.5) == (targets > 0.5)
    assert right.mean() > 0.85


def test_the_structured_kind_generalises_from_a_hundred_labels(labelled: tuple[SegmentPairs, np.ndarray]) -> None:
    unseen = invented.pairs(300, np.random.default_rng(2))
    model = fit(*labelled, "structured", 0).model
    agrees = (model.probability_right(unseen) > 0.5) == (invented.answers_of(unseen, DISLIKES_SPEED) > 0.5)
    assert agrees.mean() > 0.85


def test_learned_weights_come_with_intervals_and_find_the_one_that_matters(
    labelled: tuple[SegmentPairs, np.ndarray],
) -> None:
    weights = fit(*labelled, "structured", 0).metrics["weights"]
    assert set(weights) == set(SIGNALS)
    assert weights["speed_m_s"]["high"] < 0
    assert all(each["low"] < each["mean"] < each["high"] for each in weights.values())
    others = [abs(each["mean"]) for name, each in weights.items() if name != "speed_m_s"]
    assert max(others) < abs(weights["speed_m_s"]["mean"]) / 2


@pytest.mark.parametrize("kind", KINDS)
def test_the_same_seed_gives_the_same_model_and_another_seed_another(
    kind: reward_training.RewardKind, labelled: tuple[SegmentPairs, np.ndarray]
) -> None:
    first, again, other = (
        fit(*labelled, kind, seed, mlp=QUICK, transformer=QUICK_TRANSFORMER, predictor=PREDICTOR).model.to_bytes()
        for seed in (5, 5, 6)
    )
    assert first == again
    assert first != other


def test_swapped_pairs_with_flipped_targets_give_the_same_weights(labelled: tuple[SegmentPairs, np.ndarray]) -> None:
    shown, targets = labelled
    model = fit(shown, targets, "structured", 0).model
    mirrored = fit(shown.swapped(), 1 - targets, "structured", 0).model
    assert isinstance(model, StructuredReward)
    assert isinstance(mirrored, StructuredReward)
    one_step = np.sqrt(SMALLEST_GAIN)  # by which both may stop short of the most probable weights
    np.testing.assert_allclose(model.weights, mirrored.weights, atol=one_step)


def test_the_probability_is_the_mean_over_members(
    model: RewardModel, labelled: tuple[SegmentPairs, np.ndarray]
) -> None:
    members = model.member_probabilities(labelled[0])
    assert members.shape == (model.size, 100)
    assert members.std(axis=0).max() > 0
    np.testing.assert_allclose(model.probability_right(labelled[0]), members.mean(axis=0))


def test_rewards_have_mean_0_and_deviation_1_over_the_reference_rollouts(model: RewardModel) -> None:
    reference = [invented.trajectory(np.random.default_rng(seed)) for seed in range(20)]
    normalised = model.normalised_over(reference)
    steps = [(each.signals, each.observations[: len(each)], each.actions) for each in reference]
    rewards = np.concatenate([normalised.step_rewards(*each).mean(axis=0) for each in steps])
    assert rewards.mean() == pytest.approx(0, abs=1e-6)
    assert rewards.std() == pytest.approx(1, abs=1e-6)


def test_one_broken_step_cannot_decide_what_is_trained() -> None:
    signals = np.zeros((20, len(SIGNALS)))
    signals[3] = 1e6
    broken = invented.trajectory(np.random.default_rng(0), signals=signals)
    model = StructuredReward(np.ones((8, len(SIGNALS))))
    assert model.rewards_of(broken).max() == CLIP
    assert model.rewards_of(broken).sum() == pytest.approx(CLIP)


def test_a_model_survives_storage(model: RewardModel) -> None:
    stored = model.to_bytes()
    episode = invented.trajectory(np.random.default_rng(8))
    np.testing.assert_allclose(load_reward_model(stored).rewards_of(episode), model.rewards_of(episode), atol=1e-4)
    assert stored_config(stored)["kind"] == model.kind


def test_a_file_of_something_else_is_refused() -> None:
    with pytest.raises(ValueError, match="safetensors"):
        load_reward_model(b"\xff" * 20)


@pytest.mark.parametrize(("targets", "problem"), [([0.0], "as many targets"), ([0.3] * 100, "0, 1/2 or 1")])
def test_targets_that_mean_nothing_are_refused(
    targets: list[float], problem: str, labelled: tuple[SegmentPairs, np.ndarray]
) -> None:
    with pytest.raises(ValueError, match=problem):
        fit(labelled[0], targets, "structured", 0)


def test_weights_on_signals_are_exact_for_the_structured_kind_and_close_for_networks(model: RewardModel) -> None:
    rng = np.random.default_rng(4)
    pool = [invented.trajectory(rng) for _ in range(60)]
    predicted = np.array([each.signals.sum(0) for each in pool]) @ model.signal_weights(pool).mean(axis=0)
    if model.kind == "structured":
        differences = np.diff(predicted) - np.diff(replace(model, undone_column=None).returns(pool))
        assert np.abs(differences).max() < 0.05 * np.abs(np.diff(predicted)).max()
    else:
        assert np.isfinite(predicted).all()


def test_a_handful_of_one_sided_labels_does_not_break_the_fit() -> None:
    few = invented.pairs(2, np.random.default_rng(0))
    for kind in KINDS:
        model = fit(few, [1.0, 1.0], kind, 0, mlp=QUICK, transformer=QUICK_TRANSFORMER, predictor=PREDICTOR).model
        assert np.isfinite(model.probability_right(few)).all()


def test_segments_are_cut_at_the_same_steps_on_both_sides() -> None:
    rng = np.random.default_rng(0)
    left, right = invented.trajectory(rng), invented.trajectory(rng)
    cut = SegmentPairs.cut([(left, right)], first_step=5, step_count=10)
    np.testing.assert_array_equal(cut.signals[0, 1], right.signals[5:15])
    np.testing.assert_array_equal(cut.observations[0, 0], left.observations[5:15])
    with pytest.raises(ValueError, match="only 20"):
        SegmentPairs.cut([(left, right)], first_step=15, step_count=10)


def test_nobody_is_rewarded_for_more_of_a_signal_than_was_ever_shown() -> None:
    weights = np.zeros((8, len(SIGNALS)))
    weights[:, SIGNALS.index("force_at_target_n")] = 0.5
    weights[:, SIGNALS.index("distance_m")] = -1.0
    most = np.full(len(SIGNALS), 0.1)
    model = StructuredReward(weights, most_per_step=most)
    usual, extreme = np.zeros((10, len(SIGNALS)), np.float32), np.zeros((10, len(SIGNALS)), np.float32)
    usual[:, SIGNALS.index("force_at_target_n")] = 0.1
    extreme[:, SIGNALS.index("force_at_target_n")] = 3.0
    states, actions = np.zeros((10, 4), np.float32), np.zeros((10, 7), np.float32)
    paid = model.episode_rewards(usual, states, actions).sum(axis=1)
    assert paid == pytest.approx(np.full(8, 10 * 0.1 * 0.5))
    assert model.episode_rewards(extreme, states, actions).sum(axis=1) == pytest.approx(paid)
    extreme[:, SIGNALS.index("distance_m")] = 2.0
    costs = model.episode_rewards(extreme, states, actions).sum(axis=1) - paid
    assert costs == pytest.approx(np.full(8, -20.0)), "costs go on counting"


def test_nobody_is_rewarded_for_less_of_a_signal_than_was_ever_shown_and_may_make_good_on_the_way() -> None:
    weights = np.zeros((8, len(SIGNALS)))
    weights[:, SIGNALS.index("speed_m_s")] = -1.0
    model = StructuredReward(weights, least_per_step=np.full(len(SIGNALS), 0.1))
    calm, still, late = (np.zeros((10, len(SIGNALS)), np.float32) for _ in range(3))
    calm[:, SIGNALS.index("speed_m_s")] = 0.1
    late[9, SIGNALS.index("speed_m_s")] = 1.0
    states, actions = np.zeros((10, 4), np.float32), np.zeros((10, 7), np.float32)
    paid = [model.episode_rewards(each, states, actions).sum(axis=1) for each in (calm, still, late)]
    for each in paid:
        assert each == pytest.approx(np.full(8, -1.0)), "a robot that does nothing is not better than the calmest shown"


def test_what_was_driven_is_judged_beyond_what_was_shown_if_the_task_got_done() -> None:
    weights = np.zeros((8, len(SIGNALS)))
    weights[:, SIGNALS.index("speed_m_s")] = 0.5
    undone = SIGNALS.index("undelivered")
    model = StructuredReward(weights, most_per_step=np.full(len(SIGNALS), 0.1), undone_column=undone)
    rng = np.random.default_rng(0)
    shown, faster, failing = (
        invented.trajectory(rng, steps=15, signals=np.zeros((15, len(SIGNALS)), np.float32)) for _ in range(3)
    )
    for driven, speed in ((shown, 0.1), (faster, 40.0), (failing, 40.0)):
        driven.signals[:, SIGNALS.index("speed_m_s")] = speed
    failing.signals[:, undone] = 1.0
    trained_on = [model.rewards_of(each).sum() for each in (shown, faster)]
    assert trained_on[0] == pytest.approx(trained_on[1]), "what may do anything has no use for more"
    worth = model.member_returns([shown, faster, failing])
    np.testing.assert_allclose(worth, np.tile([15 * 0.05, 15 * 20.0, 0.0], (8, 1)), rtol=1e-6)
    np.testing.assert_allclose(model.returns([shown, faster, failing]), worth[0], rtol=1e-6)
    assert model.returns([]).shape == (0,)


def test_limits_reach_as_far_as_what_an_archived_policy_does_and_no_further() -> None:
    speed = SIGNALS.index("speed_m_s")
    weights = np.zeros((8, len(SIGNALS)))
    weights[:, speed] = -1.0
    limit = np.full(len(SIGNALS), 0.1)
    model = StructuredReward(weights, least_per_step=limit, most_per_step=limit)
    rng = np.random.default_rng(0)
    usual, calmer, calmest = (
        invented.trajectory(rng, steps=15, signals=np.full((15, len(SIGNALS)), value, np.float32))
        for value in (0.1, 0.04, 0.0)
    )
    reaching = model.reaching([calmer] * 5)
    worth = [[each.rewards_of(driven).sum() for driven in (usual, calmer, calmest)] for each in (model, reaching)]
    np.testing.assert_allclose(worth, [[-1.5, -1.5, -1.5], [-1.5, -0.6, -0.6]], rtol=1e-5)
    assert model.reaching([]) is model
    assert model.reaching([usual]).rewards_of(calmest).sum() == pytest.approx(-1.5)
    unlimited = StructuredReward(weights)
    assert unlimited.reaching([calmer]).rewards_of(calmest).sum() == pytest.approx(0.0)


def test_whole_episodes_count_as_shown_beside_the_clips(labelled: tuple[SegmentPairs, np.ndarray]) -> None:
    clips = SignalScale.of(labelled[0])
    longer = SignalScale.of(labelled[0], [clips.least_per_step - 1.0, clips.most_per_step - 0.5])
    assert (longer.least_per_step < clips.least_per_step).all()
    np.testing.assert_array_equal(longer.most_per_step, clips.most_per_step)


def test_slow_clips_that_show_less_of_the_task_done_are_not_a_wish_that_it_is_not_done() -> None:
    """Whoever likes calm clips prefers those in which less has been delivered by their end."""
    shown = invented.pairs(100, np.random.default_rng(1))
    speed, undelivered = SIGNALS.index("speed_m_s"), SIGNALS.index("undelivered")
    signals = shown.signals.copy()
    signals[..., undelivered] = 2.0 - signals[..., speed] + 0.02 * np.random.default_rng(2).random(signals.shape[:-1])
    confounded = replace(shown, signals=signals)
    learned = fit(confounded, invented.answers_of(shown, DISLIKES_SPEED), "structured", 0).metrics["weights"]
    assert learned["speed_m_s"]["high"] < 0.0
    assert learned["undelivered"]["mean"] == 0.0


def test_an_episode_that_leaves_the_task_undone_earns_nothing(
    model: RewardModel, labelled: tuple[SegmentPairs, np.ndarray]
) -> None:
    model = load_reward_model(model.to_bytes())
    pairs, undelivered = labelled[0], SIGNALS.index("undelivered")
    states, actions, signals = pairs.observations[0, 0], pairs.actions[0, 0], pairs.signals[0, 0].copy()
    signals[:, undelivered] = 1.0
    never_served = model.episode_rewards(signals, states, actions)
    signals[-1, undelivered] = 0.0
    served_at_last = model.episode_rewards(signals, states, actions)
    assert never_served.max() == 0.0 < served_at_last.max()
    costs = served_at_last[:, :-1] < 0.0
    np.testing.assert_array_equal(never_served[:, :-1][costs], served_at_last[:, :-1][costs], "costs go on counting")


def test_what_was_shown_is_rewarded_as_it_was_learned_and_the_limit_survives_storage(
    labelled: tuple[SegmentPairs, np.ndarray],
) -> None:
    again = load_reward_model(fit(*labelled, "structured", 0).model.to_bytes())
    assert isinstance(again, StructuredReward)
    assert again.least_per_step is not None
    assert again.most_per_step is not None
    pairs = labelled[0]
    states, actions = pairs.observations[0, 0], pairs.actions[0, 0]
    usual = np.tile((again.least_per_step + again.most_per_step) / 2, (len(actions), 1)).astype(np.float32)
    np.testing.assert_allclose(
        again.episode_rewards(usual, states, actions).sum(axis=1),
        again.step_rewards(usual, states, actions).sum(axis=1),
        rtol=1e-5,
        atol=1e-5,
    )
