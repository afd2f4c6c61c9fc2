"""Whether weighted sums of signals explain somebody's answers, or something richer does so much better that it is said.

The linear model is compared with richer ones by how probable each makes the answers before it knows its weights (their
marginal likelihoods, by Laplace's approximation). The mean of these ratios is a bet against the linear model: while
that model is right it is expected not to grow from one answer to the next, so that it ever exceeds x with a chance of
at most 1 / x, however often one looks (Ville). That is true over people as the prior takes them to be; how often it
errs for scripted people, and whom it finds: docs/results/misfit.md. Both models allow for as many answers at random as
the reward does; people who err much more often than that are flagged more often than one in twenty.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from worker.domain.spaces import Space
from worker.domain.type_aliases import FloatArray
from worker.ml.rewards.beyond_sums import explanations
from worker.ml.rewards.laplace import laplace
from worker.ml.rewards.prior import DEVIATION
from worker.ml.rewards.segments import SegmentPairs
from worker.ml.rewards.signal_scale import SignalScale

FEWEST_ANSWERS = 60
"""Fewer are not looked at: with fewer answers than weights Laplace's approximation is too rough to bet on, and somebody
linear is now and then taken for one whose weights depend on the pose (docs/results/misfit.md)."""
RICHER_DEVIATION = 1.0
"""Of the prior of a richer model's further weights, in log odds per usual difference of a pair. A wider one finds more
of what is very clear, and errs more often (docs/results/misfit.md)."""
CHANGING = "changing"
"""The richer model whose weights move along with the number of the answer."""
_SPEED, _NEAR_SPEED = "speed_squared_m2_s2", "near_speed_squared_m2_s2"
_SCENE = ("target_outward", "tool_to_target_m")
_SMALLEST_SPREAD = 1e-6


def look(
    pairs: SegmentPairs, answers: FloatArray, scale: SignalScale, signal_names: Sequence[str], scene: Sequence[int] = ()
) -> dict[str, Any]:
    """For a model's metrics: ``evidence`` against the linear model, and the richer one that explains most.

    pairs and answers (N,) in {0, 1/2, 1} in the order in which they were given; ``scene``: columns of the observation
    that say how a scene begins. Nothing for fewer than FEWEST_ANSWERS.
    """
    if len(answers) < FEWEST_ANSWERS:
        return {}
    sums = linear_features(pairs.signal_differences(), scale, signal_names)
    richer = {name: by_spread(each) for name, each in further_differences(pairs, signal_names, scene).items()}
    ratios = log_ratios(sums, {**richer, CHANGING: changing(sums)}, answers)
    return {"evidence": evidence(ratios), "explanation": max(ratios, key=lambda name: ratios[name])}


def linear_features(differences: FloatArray, scale: SignalScale, signal_names: Sequence[str]) -> FloatArray:
    """(N, S) differences of summed signals, standardised, and that of the speed far away where there are both speeds.

    That one is a difference of two signals, and linear. Without its own column the prior keeps it small where the robot
    moves much more near than far, and people who mind it would look as if they minded something
    else (docs/results/misfit.md).
    """
    usual = differences / scale.spread
    if not {_SPEED, _NEAR_SPEED} <= {*signal_names}:
        return usual
    whole, near = (differences[:, [*signal_names].index(name)] for name in (_SPEED, _NEAR_SPEED))
    return np.concatenate([usual, by_spread((whole - near)[:, None])], axis=1)


def evidence(ratios: Mapping[str, float]) -> float:
    """The mean ratio of the richer models' likelihoods to the linear one's."""
    return float(np.exp(np.minimum([*ratios.values()], 700.0)).mean())


def log_ratios(sums: FloatArray, further: Mapping[str, FloatArray], answers: FloatArray) -> dict[str, float]:
    """Natural logarithms of the richer models' likelihoods over the linear one's. sums (N, S), further (N, F) each."""
    usual = np.full(sums.shape[1], DEVIATION)
    linear = log_likelihood(sums, answers, usual)
    return {
        name: log_likelihood(
            np.concatenate([sums, each], axis=1), answers, np.append(usual, np.full(each.shape[1], RICHER_DEVIATION))
        )
        - linear
        for name, each in further.items()
    }


def log_likelihood(features: FloatArray, answers: FloatArray, deviations: FloatArray) -> float:
    """log p(answers) under weights of N(0, deviations^2), deviations (S,), by Laplace's approximation."""
    return laplace(features, answers, np.zeros(len(deviations)), np.diag(deviations**-2.0)).evidence


def scene_of(observation: Space) -> list[int]:
    """The columns of an observation that say how a scene begins; of spaces that are not a task of ours none."""
    names = {field.name for field in observation.fields} & set(_SCENE)
    return [column for name in sorted(names) for column in range(*observation.slice_of(name).indices(observation.size))]


def further_differences(
    pairs: SegmentPairs, signal_names: Sequence[str], scene: Sequence[int] = ()
) -> dict[str, FloatArray]:
    """What each richer model reads beside the signals' sums: right minus left, (N, F) each."""
    columns = {name: pairs.signals[..., place].astype(np.float64) for place, name in enumerate(signal_names)}
    mean, deviation = explanations.usual_scene(pairs, scene)
    held = (pairs.observations[:, :, 0, list(scene)].astype(np.float64) - mean) / deviation
    sums = {name: each.sum(axis=-2) for name, each in explanations.measured(columns, held).items()}
    return {name: each[:, 1] - each[:, 0] for name, each in sums.items()}


def by_spread(differences: FloatArray) -> FloatArray:
    """(N, F) in units of the usual difference of each column; one that never differs stays 0."""
    spread = np.sqrt((differences**2).mean(axis=0))
    standard: FloatArray = np.asarray(differences / np.where(spread > _SMALLEST_SPREAD, spread, 1.0), np.float64)
    return standard


def changing(sums: FloatArray) -> FloatArray:
    """(N, S) the sums times the answer's number."""
    moved: FloatArray = sums * order(len(sums))[:, None]
    return moved


def order(answers: int) -> FloatArray:
    """(N,) the number of each answer, in deviations from the middle one."""
    number = np.arange(answers) - (answers - 1) / 2
    return np.asarray(number / number.std(), np.float64)
