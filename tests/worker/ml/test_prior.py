"""Earlier participants as the prior of the next one."""

import numpy as np
import pytest

from tests.worker import invented
from worker.domain.trajectory import SIGNALS
from worker.ml.rewards.pooled_prior import Prior, prior_of
from worker.ml.rewards.reward_models import StructuredReward
from worker.ml.rewards.reward_training import fit, posterior
from worker.ml.rewards.signal_scale import SignalScale

SIZE = len(SIGNALS)


def test_the_covariance_is_shrunk_towards_its_diagonal_and_never_singular() -> None:
    weights = np.array([[1.0, 1.0], [2.0, 2.0], [3.0, 3.0]])
    prior = Prior.pooled(weights)
    np.testing.assert_allclose(prior.mean, [2.0, 2.0])
    np.testing.assert_allclose(prior.covariance, [[1.8, 0.7], [0.7, 1.8]])
    assert np.linalg.eigvalsh(prior.covariance).min() > 0.0


def test_too_few_people_are_no_prior() -> None:
    prior = Prior.pooled(np.ones((2, 3)))
    np.testing.assert_array_equal(prior.mean, np.zeros(3))
    np.testing.assert_array_equal(prior.covariance, 16.0 * np.eye(3))


def test_without_labels_the_posterior_is_the_prior() -> None:
    prior = Prior.pooled(np.random.default_rng(0).normal(1.0, 0.5, (6, 4)))
    mean, covariance = posterior(np.zeros((1, 4)), np.array([0.5]), prior)
    np.testing.assert_allclose(mean, prior.mean)
    np.testing.assert_allclose(covariance, prior.covariance, atol=1e-9)


def test_earlier_models_give_their_weights_in_the_unit_of_the_fit() -> None:
    spread = np.linspace(0.5, 2.0, SIZE)
    standardised = np.random.default_rng(1).normal(0.0, 1.0, (4, SIZE))
    models = [StructuredReward(np.tile(each / spread, (8, 1))) for each in standardised]
    np.testing.assert_allclose(prior_of(models, spread).mean, standardised.mean(axis=0))


def test_ten_labels_go_further_when_earlier_people_wanted_the_same() -> None:
    wish = np.random.default_rng(2).normal(0.0, 1.0, SIZE)
    shown, unseen = (invented.pairs(count, np.random.default_rng(count)) for count in (10, 300))
    scale = SignalScale.of(unseen)
    people = [StructuredReward(wish + np.random.default_rng(seed).normal(0, 0.2, (8, SIZE))) for seed in range(5)]
    answers, truth = (invented.answers_of(each, wish) for each in (shown, unseen))

    def accuracy(prior: Prior | None) -> float:
        model = fit(shown, answers, "structured", 0, scale=scale, prior=prior).model
        return float(((model.probability_right(unseen) > 0.5) == (truth > 0.5)).mean())

    assert accuracy(prior_of(people, scale.spread)) > accuracy(None) + 0.1
    assert accuracy(None) == pytest.approx(accuracy(Prior.standard(SIZE)))
