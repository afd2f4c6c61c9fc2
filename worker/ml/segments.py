"""Pairs of segments as arrays: what reward models are trained on."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
import numpy.typing as npt

from worker.trajectory import Trajectory

Array = npt.NDArray[np.float32]
LEFT, RIGHT = 0, 1


@dataclass(frozen=True)
class SegmentPairs:
    """N pairs of segments of T steps; the second axis is the side of the screen, left then right.

    Raises ValueError when the arrays disagree about N or T.
    """

    signals: Array
    """(N, 2, T, S)"""
    observations: Array
    """(N, 2, T, D) before each step's action"""
    actions: Array
    """(N, 2, T, 7) as executed"""

    def __post_init__(self) -> None:
        shapes = {array.shape[:3] for array in (self.signals, self.observations, self.actions)}
        if len(shapes) != 1 or next(iter(shapes))[1:2] != (2,):
            raise ValueError(f"Segments must agree on (N, 2, T), got {sorted(shapes)}.")

    @classmethod
    def cut(
        cls, pairs: Sequence[tuple[Trajectory, Trajectory]], first_step: int = 0, step_count: int | None = None
    ) -> Self:
        """The same stretch of both trajectories of every pair. (left, right) each."""
        if not pairs:
            raise ValueError("At least one pair is needed.")
        shortest = min(len(trajectory) for pair in pairs for trajectory in pair)
        stop = shortest if step_count is None else first_step + step_count
        if stop > shortest:
            raise ValueError(f"Steps {first_step} to {stop} asked for, but a trajectory has only {shortest}.")
        window = slice(first_step, stop)

        def stack(name: str) -> Array:
            return np.stack([[getattr(side, name)[window] for side in pair] for pair in pairs])

        return cls(stack("signals"), stack("observations"), stack("actions"))

    def __len__(self) -> int:
        return len(self.signals)

    def take(self, rows: npt.NDArray[np.integer]) -> Self:
        """The pairs in these rows."""
        return type(self)(self.signals[rows], self.observations[rows], self.actions[rows])

    def swapped(self) -> Self:
        """The same pairs with left and right exchanged."""
        return type(self)(self.signals[:, ::-1], self.observations[:, ::-1], self.actions[:, ::-1])

    def signal_differences(self) -> npt.NDArray[np.float64]:
        """Sum of the signals over the right segment minus that over the left one, (N, S)."""
        sums = self.signals.sum(axis=2, dtype=np.float64)
        difference: npt.NDArray[np.float64] = sums[:, RIGHT] - sums[:, LEFT]
        return difference
