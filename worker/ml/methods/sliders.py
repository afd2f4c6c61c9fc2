"""Direct setting: the person moves one slider per mode axis and watches, as in FEAST (Jenamani et al., RSS 2025, arXiv
2506.14968), where people adapt the robot themselves.

Slider by slider the person tries some positions in one scenario, watches an episode of each and leaves the slider where
it seemed best; every round they try in a narrower range around where they are. What they see is their true return with
Gaussian noise. They may watch two episodes per answer of everybody else, and the mode they end with must keep the task.
"""

from collections.abc import Sequence

import numpy as np

from worker.domain.scenarios import RESIDUAL, first_of
from worker.domain.type_aliases import FloatArray
from worker.ml.filters.fitting.filter_problem import Collect, FilterProblem
from worker.ml.methods.kept_task import in_mode
from worker.ml.methods.people import Person

POSITIONS = 5
"""of one slider that are tried beside the present one"""
NARROWER = 0.6
"""the range of each round as a share of the one before"""
SMALLEST_RANGE = 0.05
"""as a share of the axis; finer positions look alike"""


def set_by(person: Person, problem: FilterProblem, collect: Collect, noise: float, episodes: int) -> FloatArray:
    """(A,) where the sliders are left after at most so many watched episodes.

    ``noise``: deviation of what is perceived of one episode, in units of the spread of pairs of the pool.
    """
    axes = problem.task.modes.axes
    rng = np.random.default_rng([problem.seed, 21])
    setting, share, watched = problem.task.modes.reference, 1.0, 0
    for scenario in first_of(RESIDUAL, max(1, episodes // (POSITIONS + 1))):
        axis = watched // (POSITIONS + 1) % len(axes)
        tried = _positions(setting, axis, axes[axis].low, axes[axis].high, share)
        driven = [collect(in_mode(problem, each), [scenario], 0.0, problem.seed)[0] for each in tried]
        setting = tried[int(np.argmax([person.perceived(each, noise, rng) for each in driven]))]
        watched += len(tried)
        if axis == len(axes) - 1:
            share = max(NARROWER * share, SMALLEST_RANGE)
    return setting


def _positions(setting: FloatArray, axis: int, low: float, high: float, share: float) -> Sequence[FloatArray]:
    """The present setting and POSITIONS others that differ in one axis, in a share of its range around the present."""
    half = 0.5 * share * (high - low)
    middle = np.clip(setting[axis], low + half, high - half)
    tried = [setting.copy() for _ in range(POSITIONS + 1)]
    for each, value in zip(tried[1:], np.linspace(middle - half, middle + half, POSITIONS), strict=True):
        each[axis] = value
    return tried
