"""Variations of somebody's mode: which one an answer about would tell most, at a distance that people can see."""

import numpy as np

from worker.domain.type_aliases import FloatArray
from worker.ml import acquisition
from worker.ml.filters.fitting.mode_worth import SUCCESS_TOLERANCE
from worker.ml.filters.fitting.response_surface import ResponseSurface
from worker.ml.rewards.bradley_terry import probability_right
from worker.ml.rewards.reward_models import StructuredReward

SAMPLES = 4000
"""Of modes that share about half of their axes with the first."""


def variation(
    surface: ResponseSurface,
    model: StructuredReward,
    mode: FloatArray,
    shown: float,
    apart: float,
    rng: np.random.Generator,
) -> FloatArray:
    """(A,) another mode than ``mode`` (A,): what would be best for this person if one member of the model were right.

    Of what is best for each member (draws from the posterior, as in Thompson sampling) the one about which an answer is
    expected to tell most (information gain), by what the surface predicts. ``shown``: the share of an episode that a
    clip shows; ``apart``: the share of some axis' range by which two modes differ that a person can tell apart.
    """
    sampled = rng.uniform(surface.low, surface.high, (SAMPLES, len(mode)))
    others = np.where(rng.random(sampled.shape) < 0.5, sampled, mode)
    distance = (np.abs(others - mode) / (surface.high - surface.low)).max(axis=-1)
    others = others[distance >= min(apart, distance.max())]
    (changes, success), (before, success_before) = surface.predict(others), surface.predict(mode)
    lost = np.maximum(success_before - success - SUCCESS_TOLERANCE, 0.0)
    log_odds = model.weights_of_signals @ (changes - before).T * shown / model.temperature
    best = np.unique(np.where(lost > lost.min(), -np.inf, log_odds).argmax(axis=1))
    told = acquisition.information_gain(probability_right(log_odds[:, best]))
    found: FloatArray = others[best[np.argmax(told)]]
    return found
