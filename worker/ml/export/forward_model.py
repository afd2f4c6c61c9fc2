"""Whether a robot answers to actions as it did in a filter's tests: a linear forward model, and what departs from it.

    o' - o = [o, a, 1] W + e
    departure = mean over the numbers of o of  log(1 + rms(e) / max(usual rms(e), FLOOR width))

W comes from a ridge regression over the evaluation's episodes. The rms is over the steps since the episode began, the
last as many as an episode has. The logarithm keeps a single number that a touch or a rare posture throws far off from
outweighing all others. How large it usually becomes is measured in each half of the episodes with the W of the other
half: of 100 episodes that are like these about one exceeds the limit. Noisy sensors, late actions and a tremor depart
from it within seconds; friction and mass do not (docs/decisions.md, 177).
"""

import io
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

FILE = "forward_model.npz"
FIRST_STEPS = 10
"""Fewer say little."""
FLOOR = 2e-4
"""of the width that is declared for a number: sensors may be so much less exact than a simulation's"""
NARROWEST = 0.01
"""of that width: what moves less in the tests is not extrapolated from"""
NO_WIDTH = 1e-9
"""of a number that is declared not to change"""
RIDGE = 1e-3
"""beside squares of mean 1"""
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

    @classmethod
    def learned(cls, episodes: Sequence[tuple[Any, Any]], widths: Any) -> Self | None:
        """From observations (T + 1, D) and actions (T, A) of whole episodes; None if there are too few to learn from.

        ``widths``: (D,) of the ranges that are declared for the numbers of the observation.
        """
        widths = np.maximum(widths, NO_WIDTH)
        halves = episodes[::2], episodes[1::2]
        size = len(widths) + 1 + episodes[0][1].shape[1] if episodes else 0
        if min(sum(len(actions) for _, actions in half) for half in halves) <= size:
            return None
        missed = [
            _missed(_coefficients(half, widths), *each) for half, other in (halves, halves[::-1]) for each in other
        ]
        usual = np.maximum(np.sqrt((np.concatenate(missed) ** 2).mean(axis=0)), FLOOR * widths)
        largest = [_departures(each, usual).max() for each in missed]
        at_most = float(np.quantile(largest, LIMIT_OF, method="higher"))
        return cls(_coefficients(episodes, widths), usual, at_most)

    @classmethod
    def from_bytes(cls, stored: bytes) -> Self:
        """Of to_bytes()."""
        with np.load(io.BytesIO(stored), allow_pickle=False) as arrays:
            return cls(arrays["coefficients"], arrays["usual"], float(arrays["departure_at_most"]))

    def to_bytes(self) -> bytes:
        """An .npz file."""
        file = io.BytesIO()
        np.savez(
            file, coefficients=self.coefficients, usual=self.usual, departure_at_most=np.float64(self.departure_at_most)
        )
        return file.getvalue()


class DynamicsMonitor:
    """A loop's steps beside the forward model of its tests."""

    def __init__(self, model: ForwardModel, names: Sequence[str], episode_steps: int) -> None:
        """``names``: (D,) of the fields that the numbers of the observation belong to."""
        self._model, self._names = model, names
        self._squares = deque[Any](maxlen=episode_steps)

    def begin(self) -> None:
        """An episode."""
        self._squares.clear()

    def step(self, before: Any, action: Any, after: Any) -> None:
        """(D,), (A,), (D,): what was seen, what was done in [-1, 1], and what was seen then."""
        missed = _missed(self._model.coefficients, np.stack([before, after]), np.asarray(action)[None])[0]
        self._squares.append((missed / self._model.usual) ** 2)

    @property
    def departures(self) -> Any:
        """(D,) of how many times as far off as usual; None while that is not known."""
        return np.sqrt(np.mean(self._squares, axis=0)) if len(self._squares) >= FIRST_STEPS else None

    def note(self) -> str:
        """That the world is another than the tests'; empty: it is as usual."""
        each, at_most = self.departures, self._model.departure_at_most
        if each is None or _departure(each) <= at_most:
            return ""
        off, usual = np.expm1(_departure(each)), np.expm1(at_most)
        return (
            f"what is seen follows from what is done otherwise than in its tests: it is {off:.1f} times as far off as "
            f"usual, most of all {self._names[int(each.argmax())]}, where 99 of 100 episodes stay below {usual:.1f}; "
            "look for noisy sensors and late actions before anybody is touched"
        )


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
    """(T + 1, D), (T, A) -> (T, D)"""
    return np.diff(observations.astype(np.float64), axis=0) - _features(observations[:-1], actions) @ coefficients


def _departures(missed: Any, usual: Any) -> Any:
    """(T, D) -> (steps,) after each step from the first on that says enough."""
    squares = np.cumsum((missed / usual) ** 2, axis=0) / np.arange(1, len(missed) + 1)[:, None]
    return _departure(np.sqrt(squares))[min(FIRST_STEPS, len(missed)) - 1 :]


def _departure(each: Any) -> Any:
    """(..., D) -> (...)"""
    return np.log1p(each).mean(axis=-1)
