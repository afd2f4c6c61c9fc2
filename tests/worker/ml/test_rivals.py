"""Rivals of today on worlds whose best answer is known."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.worker import invented
from tests.worker.ml.invented_person import InventedPerson
from tests.worker.ml.test_methods import POLICY, REWARD, World, collect
from worker.domain.trajectory import SIGNALS, Trajectory
from worker.domain.type_aliases import Act, FloatArray
from worker.ml.filters.fitting.filter_problem import FilterProblem
from worker.ml.methods import bayesian_modes, clusters, latent_people, residual_rl, sliders
from worker.ml.methods.behaviour_flow import fit_flow
from worker.ml.methods.dsrl import OwnNoise
from worker.ml.methods.latent_people import Latent
from worker.ml.methods.prefft_lagrangian import Constraint, Price
from worker.ml.methods.residual_rl import Corrected
from worker.ml.methods.steered_rl import Steering
from worker.ml.policies.sac import Replay
from worker.ml.reinforcement.preference_rl import learned
from worker.ml.rewards.reward_models import UNDONE

SEEN = invented.observations(200, np.random.default_rng(9))
PROBLEM = FilterProblem(invented.TASK, POLICY, REWARD, 0)
STEERING = Steering(
    steps=1_600, warm_up_steps=400, critic_first_updates=200, hidden=32, learning_rate=3e-3, progressive_steps=300
)


# -- duels -------------------------------------------------------------------------------------------------------------

LIKED = np.array([0.7, 0.2])


def anywhere(count: int, rng: np.random.Generator) -> FloatArray:
    return np.concatenate([np.full((1, 2), 0.5), rng.random((count, 2))])[:count]


def found_by_duels(seed: int, mistakes: float = 0.05) -> FloatArray:
    rng = np.random.default_rng(seed)

    def duel(first: FloatArray, second: FloatArray) -> float:
        nearer = np.linalg.norm(second - LIKED) < np.linalg.norm(first - LIKED)
        return float(nearer != (rng.random() < mistakes))

    return bayesian_modes.best_by_duels(duel, anywhere, 40, seed)


def test_duels_lead_to_the_point_that_is_liked_best_in_spite_of_mistakes_and_are_the_same_again() -> None:
    best = found_by_duels(0)
    assert np.linalg.norm(best - LIKED) < 0.15
    np.testing.assert_array_equal(found_by_duels(0), best)


def test_nothing_is_tried_that_is_not_safe() -> None:
    tried: list[FloatArray] = []

    def safe(count: int, rng: np.random.Generator) -> FloatArray:
        return np.asarray(anywhere(count, rng) * np.array([0.5, 1.0]))

    def duel(first: FloatArray, second: FloatArray) -> float:
        tried.extend([first, second])
        return float(second[0] > first[0])

    best = bayesian_modes.best_by_duels(duel, safe, 20, 0)
    assert max(each[0] for each in tried) <= 0.5
    assert 0.4 < best[0] <= 0.5


def test_the_utility_explains_the_answers_it_was_fitted_to() -> None:
    points = np.random.default_rng(0).random((40, 2))
    answers = (points[1::2, 0] > points[::2, 0]).astype(float)
    mean = bayesian_modes.fit_utility(points, answers).mean(points)
    np.testing.assert_array_equal(mean[1::2] > mean[::2], answers == 1.0)


# -- sliders -----------------------------------------------------------------------------------------------------------


class Watching:
    """Counts episodes; speed is the first axis' distance from 0.3, whatever the observations."""

    def __init__(self) -> None:
        self.episodes = 0

    def collect(self, act: Act, scenarios: Sequence[int], noise: float, seed: int) -> list[Trajectory]:
        self.episodes += len(scenarios)
        driven = collect(act, scenarios, noise, seed)
        for each in driven:
            each.signals[:, :] = 0.0
            each.signals[:, SIGNALS.index("speed_m_s")] = abs(self.first_axis - 0.3)
        return driven

    first_axis = 0.0


def set_with(noise: float, episodes: int, monkeypatch: pytest.MonkeyPatch) -> tuple[FloatArray, int]:
    watching = Watching()

    def in_mode(problem: FilterProblem, mode: FloatArray) -> Act:
        watching.first_axis = float(mode[0])
        return POLICY.mean

    # One episode at a time is watched right after its mode was set, so the axis is read when it is.
    monkeypatch.setattr(sliders, "in_mode", in_mode)
    return sliders.set_by(InventedPerson(), PROBLEM, watching.collect, noise, episodes), watching.episodes


def test_sliders_are_left_where_it_is_liked_best_and_no_more_is_watched_than_allowed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    setting, episodes = set_with(0.0, 240, monkeypatch)
    assert setting[0] == pytest.approx(0.3, abs=0.05)
    assert episodes <= 240


def test_who_sees_only_noise_sets_nothing_right_and_the_same_again(monkeypatch: pytest.MonkeyPatch) -> None:
    setting, _ = set_with(1e6, 120, monkeypatch)
    again, _ = set_with(1e6, 120, monkeypatch)
    np.testing.assert_array_equal(setting, again)
    assert abs(setting[0] - 0.3) > 0.05


# -- steering ----------------------------------------------------------------------------------------------------------


def test_a_correction_is_bounded_and_none_is_the_frozen_policy() -> None:
    decoder = Corrected(POLICY, 0.2)
    said = np.random.default_rng(0).uniform(-1, 1, (len(SEEN), 7)).astype(np.float32)
    assert np.abs(decoder(SEEN, said) - POLICY.mean(SEEN)).max() <= 0.2 + 1e-6
    np.testing.assert_array_equal(decoder(SEEN, np.zeros_like(said)), POLICY.mean(SEEN))


def test_own_noise_is_what_the_frozen_policy_would_draw() -> None:
    decoder = OwnNoise(POLICY, 1.5)
    np.testing.assert_allclose(decoder(SEEN, np.zeros((len(SEEN), 7), np.float32)), POLICY.mean(SEEN), atol=1e-5)
    mean, deviation = POLICY.mean_and_std(SEEN)
    expected = 0.7 * np.tanh(np.arctanh(mean / 0.7) + 1.5 * deviation)
    np.testing.assert_allclose(decoder(SEEN, np.ones((len(SEEN), 7), np.float32)), expected, atol=1e-4)


@pytest.mark.long
def test_steering_follows_the_learned_reward() -> None:
    space = invented.TASK.observation
    before = POLICY.mean(SEEN)[:, 0].mean()
    corrected = residual_rl.fit(World, POLICY, learned(REWARD), space, STEERING, 0)
    actions = np.array([corrected(each) for each in SEEN])
    assert actions[:, 0].mean() < before - 0.1
    assert np.abs(actions - POLICY.mean(SEEN)).max() <= STEERING.residual_bound + 1e-6
    others = (actions - POLICY.mean(SEEN))[:, 1:].mean(axis=0)
    assert np.abs(others).max() < 0.05, "the reward says nothing of the other joints"


def test_a_flow_fitted_to_two_ways_of_doing_it_has_both_in_its_noise() -> None:
    rng = np.random.default_rng(0)
    pool = [
        invented.trajectory(rng, actions=np.tile([side, *[0.1] * 6], (20, 1))) for side in (-0.6, 0.6) for _ in range(6)
    ]
    flow = fit_flow(pool, POLICY, 1.5, 32, 600, 0)
    said = np.zeros((len(SEEN), 7), np.float32)
    said[::2, 0], said[1::2, 0] = -0.8, 0.8
    actions = flow(SEEN, said)
    assert np.median(actions[::2, 0]) == pytest.approx(-0.6, abs=0.15)
    assert np.median(actions[1::2, 0]) == pytest.approx(0.6, abs=0.15)
    assert np.median(actions[:, 1:]) == pytest.approx(0.1, abs=0.1)


# -- the price of an undone task ---------------------------------------------------------------------------------------


def test_the_price_rises_with_lost_success_and_earlier_steps_are_priced_anew() -> None:
    reference = collect(POLICY.mean, range(4), 0.0, 0)  # all of which succeed
    price = Price(
        lambda signals, observations, actions: np.full(len(signals), 5.0), Constraint(), reference, collect, 0
    )
    assert price.target == pytest.approx(0.98)
    signals = np.zeros((3, len(SIGNALS)), np.float32)
    signals[:2, SIGNALS.index(UNDONE)] = 1.0
    replay = Replay(10, 2, 1)
    rewards = price(signals, signals, signals)
    assert rewards.tolist() == [4.0, 4.0, 5.0]
    states, actions = np.zeros((3, 2), np.float32), np.zeros((3, 1), np.float32)
    replay.add(states, actions, rewards, np.ones(3, np.float32), states)
    price.measured(0.88, replay)  # ten points below the target: 20 * .1 more
    assert price.price == pytest.approx(3.0)
    torch.testing.assert_close(replay.split(replay.rows[:3])[2][:, 0], torch.tensor([2.0, 2.0, 5.0]))
    price.measured(0.0, replay)
    assert price.price == Constraint().largest_price
    for _ in range(40):
        price.measured(1.0, replay)
    assert price.price == 0.0
    torch.testing.assert_close(replay.split(replay.rows[:3])[2][:, 0], torch.tensor([5.0, 5.0, 5.0]))


# -- others ------------------------------------------------------------------------------------------------------------


def agreement(person: InventedPerson, count: int) -> float:
    """Share of the own answers that the nearest cluster's model gives, too."""
    model, _ = clusters.nearest(person, 4, 40, count, 0)
    return float(((model.probability_right(person.labels.pairs) > 0.5) == person.labels.targets).mean())


def test_a_person_gets_the_model_of_their_own_kind_and_the_average_of_nobody_in_particular() -> None:
    for speed in (-1.0, 1.0):
        assert agreement(InventedPerson(speed), 2) > 0.8
        assert agreement(InventedPerson(speed), 1) < 0.8


@pytest.mark.long
def test_a_latent_that_was_learned_from_others_tells_their_kinds_apart() -> None:
    reference = collect(POLICY.mean, range(4), 0.3, 0)
    for speed in (-1.0, 1.0):
        person = InventedPerson(speed)
        model = latent_people.model_of(person, reference, 12, 40, replace(Latent(), steps=200, context=40), 0)
        said = model.probability_right(person.labels.pairs) > 0.5
        assert (said == person.labels.targets).mean() > 0.7
