"""What is learned from beside R-hat: where the target is, strokes, force, and what a task undone costs."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from worker.domain.trajectory import SIGNALS, Trajectory
from worker.domain.type_aliases import Float32Array
from worker.ml.filters.exported.shield import FORCE_QUANTILE, FORCE_RAMP_N
from worker.ml.reinforcement.preference_rl import EpisodeReward

MOST_RAMPS = 3.0
"""of force are priced: or a single blow would be all that is learned from"""
_DISTANCE, _STROKES, _UNDONE = (SIGNALS.index(name) for name in ("distance_m", "strokes", "undelivered"))
_FORCES = [SIGNALS.index("force_at_target_n"), SIGNALS.index("force_away_n")]


def sketchy(reference: Sequence[Trajectory], learned: EpisodeReward) -> EpisodeReward:
    """PbRL-HRI's: minus the distance in standard deviations over reference rollouts, plus the learned reward."""
    distances = np.concatenate([each.signals[:, _DISTANCE] for each in reference])
    unit = max(float(distances.std()), 1e-6)

    def both(signals: Float32Array, observations: Float32Array, actions: Float32Array) -> npt.NDArray[np.floating]:
        rewards: npt.NDArray[np.floating] = learned(signals, observations, actions) - signals[:, _DISTANCE] / unit
        return rewards

    return both


def guided(
    reference: Sequence[Trajectory], learned: EpisodeReward, stroke_weight: float, force_price: float
) -> EpisodeReward:
    """The reward of a refinement: PbRL-HRI's, more for strokes where a task is done by them, and less for force.

    Distance and strokes in standard deviations over reference rollouts. A critic that is asked for a policy's value
    does not know that episodes end: without the latter strokes that come too late cost nothing. R-hat forgives a blow
    that is short; so force has a price where it is more than 95 of 100 reference episodes reach (decision 162;
    docs/results/how_the_refinement_was_found.md).
    """
    approaching = sketchy(reference, learned)
    unit = float(np.concatenate([each.signals[:, _STROKES] for each in reference]).std())
    worth = stroke_weight / unit if unit else 0.0
    usual = float(np.quantile([each.contact_force_n.max() for each in reference], FORCE_QUANTILE))

    def reward(signals: Float32Array, observations: Float32Array, actions: Float32Array) -> npt.NDArray[np.floating]:
        force = signals[:, _FORCES].sum(axis=1)
        too_much = np.clip((force - usual) / FORCE_RAMP_N, 0.0, MOST_RAMPS)
        rewards: npt.NDArray[np.floating] = approaching(signals, observations, actions)
        rewards = rewards + worth * signals[:, _STROKES] - force_price * too_much
        return rewards

    return reward


def priced(reward: EpisodeReward, price: float) -> EpisodeReward:
    """The same, less so much in every step with the task undone."""

    def both(signals: Float32Array, observations: Float32Array, actions: Float32Array) -> npt.NDArray[np.floating]:
        rewards: npt.NDArray[np.floating] = reward(signals, observations, actions) - price * signals[:, _UNDONE]
        return rewards

    return both
