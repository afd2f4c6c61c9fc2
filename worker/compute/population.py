"""What is expected of a person before the first answer: the scripted population of a task, and who came before."""

from collections.abc import Sequence
from functools import cache

import numpy as np

from worker.domain.type_aliases import FloatArray
from worker.ml.rewards.prior import EARLIER, SCRIPTED, Prior, standardised_weights
from worker.ml.rewards.reward_models import RewardModel
from worker.ml.teachers import random_taste
from worker.sim.costs import signal_weights
from worker.tasks import registry

PEOPLE = 400
DECIDEDNESS = 10.0
"""Norm of a scripted person's weights, log odds per standard deviation of a pair: how sure their answers are."""


def prior_of(task: str | None, spread: FloatArray, earlier: Sequence[RewardModel] = ()) -> Prior:
    """Somebody is like the scripted population of the task, like those whose ``earlier`` models are given, or like
    nobody known. ``spread`` (S,) as in SignalScale; None: no task of ours, whose signals we know nothing about."""
    prior = Prior.standard(len(spread))
    if task is not None and not registry.task(task).is_a_labs:
        wants = scripted_weights(task) * spread
        prior = prior.or_like(SCRIPTED, DECIDEDNESS * wants / np.linalg.norm(wants, axis=1, keepdims=True))
    return prior.or_like(EARLIER, standardised_weights(earlier, spread))


@cache
def scripted_weights(task: str) -> FloatArray:
    """(P, S) reward per unit of each signal of people drawn by random_taste(), always the same ones."""
    rng = np.random.default_rng(19)
    drawn = [random_taste("somebody", rng) for _ in range(PEOPLE)]
    return np.array([signal_weights(registry.task(task), each.omega, each.per_signal) for each in drawn])
