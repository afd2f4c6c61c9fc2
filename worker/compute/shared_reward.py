"""Reward models of nobody in particular: the mean of several people's, and those of the paper's types of users."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from worker.compute.simulation import reference_rollouts
from worker.domain.type_aliases import FloatArray
from worker.ml.rewards.loading import load_reward_model
from worker.ml.rewards.reward_models import UNDONE, StructuredReward
from worker.ml.rewards.signal_scale import SignalScale
from worker.ml.teachers import OF_LABS, OMEGA, User
from worker.sim.costs import signal_weights
from worker.tasks import registry


def of_people(task: str, rewards: Sequence[bytes], scale: SignalScale) -> bytes:
    """The mean of stored reward models, each with standard deviation 1 per step of the reference policy.

    So nobody counts more for being more decided. A model that is not linear in the signals counts as the linear one
    nearest to it (RewardModel.signal_weights).
    """
    reference = reference_rollouts(task)
    models = [load_reward_model(each) for each in rewards]
    return reward_of(task, np.array([each.signal_weights(reference).mean(axis=0) for each in models]), scale)


def of_types(task: str, users: Sequence[str], scale: SignalScale) -> bytes:
    """The mean of what types of users want, by their names (see types_of). Raises ValueError for one there is not."""
    known = registry.task(task)
    if known.is_a_labs:
        minds = {taste.name: taste.signal_weights(known.signals) for taste in OF_LABS}
        return reward_of(task, np.array([minds[user] for user in users]), scale)
    return reward_of(task, np.array([signal_weights(known, OMEGA[User(user)]) for user in users]), scale)


def types_of(task: str) -> list[str]:
    """The types of users whom somebody's filter may be made for while there are no people: the paper's, or a lab's."""
    return [taste.name for taste in OF_LABS] if registry.task(task).is_a_labs else [user.value for user in OMEGA]


def reward_of(task: str, weights: FloatArray, scale: SignalScale) -> bytes:
    """A stored model whose one member is the mean of P people's weights, each scaled alike.

    ``weights``: (P, S) reward per unit of each signal; ``scale``: of the pool that they have seen.
    """
    reference = reference_rollouts(task)
    alike = [StructuredReward(each[None]).normalised_over(reference).signal_weights()[0] for each in weights]
    mean = StructuredReward(
        np.mean(alike, axis=0)[None],
        least_per_step=scale.least_per_step,
        most_per_step=scale.most_per_step,
    )
    return replace(mean.normalised_over(reference), undone_column=registry.task(task).signals.index(UNDONE)).to_bytes()
