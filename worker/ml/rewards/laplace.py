"""Bayesian logistic regression: what answers say about weights under a Gaussian prior, by Laplace's approximation.

The likelihood is Bradley and Terry's with lapses (bradley_terry.py), summed over pairs as in Eq. (2); the evidence is
that of MacKay, "The evidence framework applied to classification networks" (1992).
"""

from typing import NamedTuple

import numpy as np

from worker.domain.type_aliases import FloatArray
from worker.ml.rewards.bradley_terry import probability_of_answer, probability_right, slope_of_answer

MOST_STEPS = 200
SMALLEST_GAIN = 1e-14
"""Of log probability, that is still a step worth making."""


class Laplace(NamedTuple):
    """A Gaussian around the most probable weights, and how probable the answers were before the weights were known."""

    mean: FloatArray
    """(S,)"""
    information: FloatArray
    """(S, S) the inverse of the covariance: Fisher's, and the prior's precision"""
    evidence: float
    """log p(answers), in natural logarithms"""


def laplace(features: FloatArray, answers: FloatArray, mean: FloatArray, precision: FloatArray) -> Laplace:
    """Weights from N(mean, precision^-1), of which N answers are known.

    features (N, S) right minus left; answers (N,) in {0, 1/2, 1}; mean (S,); precision (S, S). Fisher scoring with
    halved steps, which overshoots neither on separable answers nor where somebody may have slipped.
    """
    weights = mean.copy()
    loss, gradient, information = _loss(features, answers, weights, mean, precision)
    for _ in range(MOST_STEPS):
        step = np.linalg.solve(information, gradient)
        if step @ gradient < SMALLEST_GAIN:
            break
        while (found := _loss(features, answers, weights - step, mean, precision))[0] > loss:
            step = step / 2
        weights, (loss, gradient, information) = weights - step, found
    narrowed = np.linalg.slogdet(precision)[1] - np.linalg.slogdet(information)[1]
    return Laplace(weights, information, float(0.5 * narrowed - loss))


def _loss(
    features: FloatArray, answers: FloatArray, weights: FloatArray, mean: FloatArray, precision: FloatArray
) -> tuple[float, FloatArray, FloatArray]:
    """Minus the log of the answers' and the weights' probability up to a constant, its gradient, the information."""
    preferred = probability_right(features @ weights)
    said, slope = probability_of_answer(preferred), slope_of_answer(preferred)
    variance, apart = said * (1.0 - said), weights - mean
    pull = precision @ apart
    surprise = -(answers * np.log(said) + (1.0 - answers) * np.log(1.0 - said)).sum()
    gradient = features.T @ ((said - answers) * slope / variance) + pull
    information = features.T @ (features * (slope**2 / variance)[:, None]) + precision
    return float(surprise + 0.5 * pull @ apart), gradient, information
