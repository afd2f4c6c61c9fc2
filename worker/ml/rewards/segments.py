"""Pairs of segments as arrays: what reward models are trained on."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np
import numpy.typing as npt

from worker.domain.trajectory import Recorded
from worker.domain.type_aliases import Float32Array

Mask = npt.NDArray[np.bool_]
LEFT, RIGHT = 0, 1


class Stretch(NamedTuple):
    """What is shown of a trajectory: steps first_step .. first_step + step_count."""

    trajectory: Recorded
    first_step: int
    step_count: int

    def cut(self, name: str) -> Float32Array:
        """One of the trajectory's arrays, as long as the stretch. Raises ValueError beyond the trajectory's end."""
        stop = self.first_step + self.step_count
        if stop > len(self.trajectory):
            raise ValueError(
                f"Steps {self.first_step} to {stop} asked for, but a trajectory has only {len(self.trajectory)}."
            )
        array: Float32Array = getattr(self.trajectory, name)[self.first_step : stop]
        return array


@dataclass(frozen=True)
class SegmentPairs:
    """N pairs of segments of at most T steps; the second axis is the side of the screen, left then right.

    Shorter segments are filled up with zeros at their end, which ``mask`` tells apart from steps that were shown.
    Raises ValueError when the arrays disagree about N or T.
    """

    signals: Float32Array
    """(N, 2, T, S)"""
    observations: Float32Array
    """(N, 2, T, D) before each step's action"""
    actions: Float32Array
    """(N, 2, T, 7) as executed"""
    mask: Mask | None = None
    """(N, 2, T) True: was shown; None: all steps were"""

    def __post_init__(self) -> None:
        arrays = (self.signals, self.observations, self.actions, self.shown)
        shapes = {array.shape[:3] for array in arrays}
        if len(shapes) != 1 or next(iter(shapes))[1:2] != (2,):
            raise ValueError(f"Segments must agree on (N, 2, T), got {sorted(shapes)}.")

    @classmethod
    def cut(
        cls, pairs: Sequence[tuple[Recorded, Recorded]], first_step: int = 0, step_count: int | None = None
    ) -> Self:
        """The same stretch of both trajectories of every pair. (left, right) each."""
        if not pairs:
            raise ValueError("At least one pair is needed.")
        shortest = min(len(trajectory) for pair in pairs for trajectory in pair)
        count = shortest - first_step if step_count is None else step_count
        return cls.of([(Stretch(left, first_step, count), Stretch(right, first_step, count)) for left, right in pairs])

    @classmethod
    def of(cls, pairs: Sequence[tuple[Stretch, Stretch]]) -> Self:
        """Stretches of any lengths, (left, right) each. Raises ValueError for no pair and beyond a trajectory's end."""
        if not pairs:
            raise ValueError("At least one pair is needed.")
        counts = np.array([[side.step_count for side in pair] for pair in pairs])
        longest = int(counts.max())

        def stack(name: str) -> Float32Array:
            return np.stack([[_filled_up(side.cut(name), longest) for side in pair] for pair in pairs])

        mask = np.arange(longest) < counts[..., None]
        return cls(stack("signals"), stack("observations"), stack("actions"), None if mask.all() else mask)

    @property
    def shown(self) -> Mask:
        """(N, 2, T) True: a step that was shown; False: filled up."""
        return np.ones(self.actions.shape[:3], np.bool_) if self.mask is None else self.mask

    def __len__(self) -> int:
        return len(self.signals)

    def take(self, rows: npt.NDArray[np.integer]) -> Self:
        """The pairs in these rows."""
        mask = None if self.mask is None else self.mask[rows]
        return type(self)(self.signals[rows], self.observations[rows], self.actions[rows], mask)

    def swapped(self) -> Self:
        """The same pairs with left and right exchanged."""
        mask = None if self.mask is None else self.mask[:, ::-1]
        return type(self)(self.signals[:, ::-1], self.observations[:, ::-1], self.actions[:, ::-1], mask)

    def signal_differences(self) -> npt.NDArray[np.float64]:
        """Sum of the signals over the right segment minus that over the left one, (N, S)."""
        sums = self.signals.sum(axis=2, dtype=np.float64, where=self.shown[..., None])
        difference: npt.NDArray[np.float64] = sums[:, RIGHT] - sums[:, LEFT]
        return difference


def _filled_up(array: Float32Array, length: int) -> Float32Array:
    """(T, F) -> (length, F), zeros at the end."""
    return np.pad(array, ((0, length - len(array)), (0, 0)))
