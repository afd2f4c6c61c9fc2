"""Whether a robot answers to actions as it did in a filter's tests: a linear forward model, and what departs from it.

    o' - o = [o, a, 1] W + e
    departure = mean over the numbers of o of  log(1 + rms(e) / max(usual rms(e), FLOOR width))
    lateness = departure - the departure if a were the action of one step before

W comes from a ridge regression over the evaluation's episodes. The rms is over the steps since the episode began, the
last as many as an episode has. The logarithm keeps a single number that a touch or a rare posture throws far off from
outweighing all others. How large both usually become is measured in each half of the episodes with the W of the other
half: of 100 episodes that are like these about one exceeds a limit. Noise in the sensors and a tremor depart from it
within seconds, and late actions follow better from the action before; friction and mass do neither (docs/decisions.md,
177).
"""

import io
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np

FILE = "forward_model.npz"
FIRST_STEPS = 10
"""Fewer say little."""
FLOOR = 1e-3
"""of the width that is declared for a number: sensors may be so much less exact than a simulation's"""
LEAST_LATENESS = 0.01
"""With noise that drowns all else lateness is 0 on average, and scatters by less."""
NARROWEST = 0.01
"""of that width: what moves less in the tests is not extrapolated from"""
NO_WIDTH = 1e-9
"""of a number that is declared not to change"""
RIDGE = 1e-3
"""beside squares of mean 1"""
LARGEST = 500
"""numbers of an observation and an action. Larger ones hold pictures or point clouds, of which no linear model says
much, and its square of numbers would fill a bundle."""
LIMIT_OF = 0.99
"""of the tests' episodes"""


@dataclass(frozen=True)
class ForwardModel:
    """What usually follows from an action, in numbers of the observation."""

    coefficients: Any
    """(D + A + 1, D)"""
    usual: Any
    """(D,) root mean square of what it misses"""
    departure_at_most: float
    lateness_at_most: float

    @classmethod
    def learned(cls, episodes: Sequence[tuple[Any, Any]], widths: Any) -> Self | None:
        """From observations (T + 1, D) and actions (T, A) of whole episodes; None if there are too few to learn from.

        None, too, for observations of more than LARGEST numbers. ``widths``: (D,) of the ranges that are declared for
        the numbers of the observation.
        """
        widths = np.maximum(widths, NO_WIDTH)
        episodes = [(seen, done) for seen, done in episodes if len(done) > 1]
        halves = episodes[::2], episodes[1::2]
        size = len(widths) + 1 + episodes[0][1].shape[1] if episodes else 0
        if size > LARGEST or min(sum(len(actions) for _, actions in half) for half in halves) <= size:
            return None
        missed = [
            _missed(_coefficients(half, widths), *each) for half, other in (halves, halves[::-1]) for each in other
        ]
        usual = np.maximum(np.sqrt((np.concatenate(missed)[:, 0] ** 2).mean(axis=0)), FLOOR * widths)
        largest = [_departure_and_lateness(each, usual).max(axis=0) for each in missed]
        departure, lateness = np.quantile(largest, LIMIT_OF, axis=0, method="higher").tolist()
        return cls(_coefficients(episodes, widths), usual, departure, max(lateness, LEAST_LATENESS))

    @classmethod
    def of_bundle(cls, folder: Path) -> Self | None:
        """None: the bundle has none, as those of earlier versions."""
        stored = folder / FILE
        return cls.from_bytes(stored.read_bytes()) if stored.exists() else None

    @classmethod
    def from_bytes(cls, stored: bytes) -> Self:
        """Of to_bytes()."""
        with np.load(io.BytesIO(stored), allow_pickle=False) as arrays:
            return cls(arrays["coefficients"], arrays["usual"], *arrays["departure_and_lateness_at_most"].tolist())

    def to_bytes(self) -> bytes:
        """An .npz file."""
        file = io.BytesIO()
        at_most = np.array([self.departure_at_most, self.lateness_at_most])
        np.savez(file, coefficients=self.coefficients, usual=self.usual, departure_and_lateness_at_most=at_most)
        return file.getvalue()


class DynamicsMonitor:
    """A loop's steps beside the forward model of its tests."""

    def __init__(self, model: ForwardModel, names: Sequence[str], episode_steps: int) -> None:
        """``names``: (D,) of the fields that the numbers of the observation belong to."""
        self._model, self._names = model, names
        self._squares = deque[Any](maxlen=episode_steps)
        self._before: tuple[Any, Any] | None = None

    def begin(self) -> None:
        """An episode."""
        self._squares.clear()
        self.go_on()

    def go_on(self) -> None:
        """After a pause: what was done before it says nothing of what is seen now."""
        self._before = None

    def step(self, before: Any, action: Any, after: Any) -> None:
        """(D,), (A,), (D,): what was seen, what was done in [-1, 1], and what was seen then."""
        if self._before is not None:
            observations, actions = np.stack([self._before[0], before, after]), np.stack([self._before[1], action])
            self._squares.append((_missed(self._model.coefficients, observations, actions)[0] / self._model.usual) ** 2)
        self._before = before, action

    def notes(self) -> dict[str, str]:
        """That actions are "late", or the "dynamics" other than in tests, in words; empty: they are as usual."""
        if len(self._squares) < FIRST_STEPS:
            return {}
        off = np.sqrt(np.mean(self._squares, axis=0))
        departure, if_late = _departure(off)
        if departure - if_late > self._model.lateness_at_most:
            return {
                "late": "what is seen follows from the action before the last better than from the last: actions come "
                "late, which they did not in its tests; measure by how much before anybody is touched"
            }
        if departure > self._model.departure_at_most:
            times = np.expm1(departure) / np.expm1(self._model.departure_at_most)
            return {
                "dynamics": f"what is seen follows from actions otherwise than in its tests: {times:.1f} times as far "
                f"off as in 99 of 100 episodes there, most of all {self._names[int(off[0].argmax())]}; look for noise "
                "in the sensors, tremors, and another robot"
            }
        return {}


def _features(observations: Any, actions: Any) -> Any:
    """(N, D), (N, A) -> (N, D + A + 1)"""
    return np.hstack([observations, actions, np.ones((len(actions), 1))]).astype(np.float64)


def _coefficients(episodes: Sequence[tuple[Any, Any]], widths: Any) -> Any:
    features = np.concatenate([_features(seen[:-1], done) for seen, done in episodes])
    changes = np.concatenate([np.diff(seen.astype(np.float64), axis=0) for seen, _ in episodes])
    offset = features.mean(axis=0)
    narrowest = NARROWEST * np.concatenate([widths, np.full(features.shape[1] - len(widths) - 1, 2.0)])
    scale = np.maximum(features[:, :-1].std(axis=0), narrowest)
    scaled = np.hstack([(features[:, :-1] - offset[:-1]) / scale, features[:, -1:]])
    penalty = RIDGE * len(scaled) * np.eye(scaled.shape[1])
    found = np.linalg.solve(scaled.T @ scaled + penalty, scaled.T @ changes)
    slopes = found[:-1] / scale[:, None]
    return np.vstack([slopes, found[-1:] - offset[None, :-1] @ slopes])


def _missed(coefficients: Any, observations: Any, actions: Any) -> Any:
    """(T + 1, D), (T, A) -> (T - 1, 2, D) from the second step on: of the action, and of the one before it"""
    changes = np.diff(observations[1:].astype(np.float64), axis=0)
    followed = [_features(observations[1:-1], some) @ coefficients for some in (actions[1:], actions[:-1])]
    return changes[:, None] - np.stack(followed, axis=1)


def _departure(off: Any) -> Any:
    """(..., D) -> (...)"""
    return np.log1p(off).mean(axis=-1)


def _departure_and_lateness(missed: Any, usual: Any) -> Any:
    """(T, 2, D) -> (steps, 2) after each step from the first on that says enough."""
    squares = np.cumsum((missed / usual) ** 2, axis=0) / np.arange(1, len(missed) + 1)[:, None, None]
    departure, if_late = _departure(np.sqrt(squares))[min(FIRST_STEPS, len(missed)) - 1 :].T
    return np.stack([departure, departure - if_late], axis=1)
