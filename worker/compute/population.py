"""What is expected of a person before the first answer: the scripted population of a task, and who came before."""

from collections.abc import Sequence
from functools import cache

import numpy as np

from worker.domain.type_aliases import FloatArray
from worker.ml.rewards.prior import DECIDED, EARLIER, SCRIPTED, Prior, standardised_weights
from worker.ml.rewards.reward_models import RewardModel
from worker.ml.teachers import random_taste
from worker.sim.costs import signal_weights
from worker.tasks import registry

PEOPLE = 400


def prior_of(task: str | None, spread: FloatArray, earlier: Sequence[RewardModel] = ()) -> Prior:
    """Somebody is like the scripted population of the task, hardly minds or likes anything but one signal, is like
    those whose ``earlier`` models are given, or like nobody known.

    ``spread`` (S,) as in SignalScale; None: no task of ours, whose signals we know nothing about.
    """
    prior = Prior.standard(len(spread))
    if task is not None and not registry.task(task).is_a_labs:
        wants = scripted_weights(task) * spread
        decided = DECIDED * wants / np.linalg.norm(wants, axis=1, keepdims=True)
        prior = prior.or_like(SCRIPTED, decided).or_for_whom_one_matters()
    return prior.or_like(EARLIER, standardised_weights(earlier, spread))


@cache
def scripted_weights(task: str) -> FloatArray:
    """(P, S) reward per unit of each signal of people drawn by random_taste(), always the same ones."""
    rng = np.random.default_rng(19)
    drawn = [random_taste("somebody", rng) for _ in range(PEOPLE)]
    return np.array([signal_weights(registry.task(task), each.omega, each.per_signal) for each in drawn])
