"""What is expected before the first answer: populations that somebody may be of, among them anybody."""

import numpy as np
import pytest

from tests.worker import invented
from worker.compute.population import prior_of, scripted_weights
from worker.domain.trajectory import SIGNALS
from worker.ml.rewards.prior import ONE_MATTERS, Population, Prior, standardised_weights
from worker.ml.rewards.reward_models import NEVER_WANTED, StructuredReward
from worker.ml.rewards.reward_training import fit, posterior
from worker.ml.rewards.signal_scale import SignalScale
from worker.ml.teachers import OMEGA, User
from worker.sim.costs import signal_weights
from worker.tasks import registry

SIZE = len(SIGNALS)
ALIKE = np.array([3.0, -3.0, 0.0, 0.0])
KNOWN = Prior.standard(4).or_like("people", ALIKE + np.random.default_rng(0).normal(0.0, 0.3, (20, 4)))


def answers_of(weights: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Differences of pairs, and who wins for somebody with these weights."""
    features = np.random.default_rng(count).normal(0.0, 1.0, (count, len(weights)))
    return features, (features @ weights > 0.0).astype(np.float64)


def test_the_covariance_is_shrunk_towards_its_diagonal_and_never_singular() -> None:
    population = Population.of("people", np.array([[1.0, 1.0], [2.0, 2.0], [3.0, 3.0]]))
    np.testing.assert_allclose(population.mean, [2.0, 2.0])
    np.testing.assert_allclose(population.covariance, [[1.8, 0.7], [0.7, 1.8]])
    assert np.linalg.eigvalsh(population.covariance).min() > 0.0


def test_too_few_people_are_no_population() -> None:
    prior = Prior.standard(3).or_like("people", np.ones((2, 3)))
    assert len(prior.populations) == 1
    np.testing.assert_array_equal(prior.populations[0].covariance, 16.0 * np.eye(3))


def test_an_answer_that_says_nothing_leaves_the_mixture_of_the_populations() -> None:
    found = posterior(np.zeros((1, 4)), np.array([0.5]), KNOWN)
    anybody, known = KNOWN.populations
    np.testing.assert_allclose(found.shares, [0.5, 0.5])
    np.testing.assert_allclose(found.mean, known.mean / 2)
    expected = (anybody.covariance + known.covariance) / 2 + np.outer(known.mean, known.mean) / 4
    np.testing.assert_allclose(found.covariance, expected, atol=1e-9)


def test_who_is_like_the_others_is_heard_as_one_of_them() -> None:
    assert posterior(*answers_of(ALIKE, 10), KNOWN).shares[1] > 0.8


def test_who_is_not_like_the_others_is_heard_as_if_nobody_was_known() -> None:
    features, answers = answers_of(-ALIKE, 10)
    alone, known = posterior(features, answers), posterior(features, answers, KNOWN)
    assert known.shares[1] < 0.01
    np.testing.assert_allclose(known.mean, alone.mean, atol=0.2)


def test_without_an_answer_every_name_is_as_likely_however_many_populations_have_it() -> None:
    prior = KNOWN.or_for_whom_one_matters()
    found = posterior(np.zeros((0, 4)), np.zeros(0), prior)
    names = {"nobody known": 1 / 3, "people": 1 / 3, ONE_MATTERS: 1 / 3}
    assert prior.by_name(found.shares) == pytest.approx(names)
    np.testing.assert_allclose(found.shares[2:], 1 / 12)
    np.testing.assert_allclose(found.mean, KNOWN.populations[1].mean / 3)


@pytest.mark.parametrize("wish", [8.0, -8.0])
@pytest.mark.parametrize("column", range(4))
def test_who_cares_for_one_thing_is_known_after_twenty_answers(column: int, wish: float) -> None:
    weights = np.zeros(4)
    weights[column] = wish
    features, answers = answers_of(weights, 20)
    prior = KNOWN.or_for_whom_one_matters()
    found = posterior(features, answers, prior)
    assert prior.by_name(found.shares)[ONE_MATTERS] > 0.8
    assert int(found.shares.argmax()) == 2 + column
    others = np.delete(np.abs(found.mean), column)
    assert others.max() < 0.1 * abs(found.mean[column])
    assert others.max() < 0.5 * np.delete(np.abs(posterior(features, answers, KNOWN).mean), column).max()


def test_who_cares_for_many_things_is_not_taken_for_somebody_who_cares_for_one() -> None:
    prior = KNOWN.or_for_whom_one_matters()
    found = posterior(*answers_of(np.array([-3.0, 3.0, 3.0, -3.0]), 20), prior)
    assert prior.by_name(found.shares)[ONE_MATTERS] < 0.05


def test_earlier_models_give_their_weights_in_the_unit_of_the_fit() -> None:
    spread = np.linspace(0.5, 2.0, SIZE)
    standardised = np.random.default_rng(1).normal(0.0, 1.0, (4, SIZE))
    models = [StructuredReward(np.tile(each / spread, (8, 1))) for each in standardised]
    np.testing.assert_allclose(standardised_weights(models, spread), standardised)


def test_ten_labels_go_further_when_earlier_people_wanted_the_same() -> None:
    wish = np.random.default_rng(2).normal(0.0, 1.0, SIZE)
    shown, unseen = (invented.pairs(count, np.random.default_rng(count)) for count in (10, 300))
    scale = SignalScale.of(unseen)
    people = [StructuredReward(wish + np.random.default_rng(seed).normal(0, 0.2, (8, SIZE))) for seed in range(5)]
    answers, truth = (invented.answers_of(each, wish) for each in (shown, unseen))

    def accuracy(prior: Prior | None) -> float:
        model = fit(shown, answers, "structured", 0, scale=scale, prior=prior).model
        return float(((model.probability_right(unseen) > 0.5) == (truth > 0.5)).mean())

    assert accuracy(prior_of(None, scale.spread, people)) > accuracy(None) + 0.1
    assert accuracy(None) == pytest.approx(accuracy(Prior.standard(SIZE)))


def test_scripted_people_never_want_harm_and_are_always_the_same() -> None:
    harm = [SIGNALS.index(name) for name in NEVER_WANTED if name != "undelivered"]
    assert scripted_weights("feeding")[:, harm].max() <= 0.0
    scripted_weights.cache_clear()
    again = prior_of("feeding", np.ones(SIZE)).populations[1]
    np.testing.assert_array_equal(prior_of("feeding", np.ones(SIZE)).populations[1].mean, again.mean)


@pytest.mark.parametrize("user", User)
def test_the_papers_users_are_people_of_the_scripted_population(user: User) -> None:
    """Their answers to thirty pairs that differ in every signal about as much say so."""
    weights = signal_weights(registry.task("feeding"), OMEGA[user])
    features, answers = answers_of(weights, 30)
    assert posterior(features, answers, prior_of("feeding", np.ones(SIZE))).shares[0] < 0.5


def test_of_clips_that_were_not_made_here_nobody_is_known() -> None:
    assert len(prior_of(None, np.ones(5)).populations) == 1
