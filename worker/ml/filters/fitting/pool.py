"""A study's pool of episodes, with the ways in which they were done."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from worker.domain.modes import ModeFamily
from worker.domain.trajectory import Trajectory
from worker.domain.type_aliases import FloatArray


@dataclass(frozen=True)
class Pool:
    """N rollouts of many behaviours. Raises ValueError when there are not as many descriptions."""

    rollouts: Sequence[Trajectory] = ()
    described: Sequence[Mapping[str, Any]] = ()
    """as stored with each: what differed from the reference policy"""

    def __post_init__(self) -> None:
        if len(self.rollouts) != len(self.described):
            raise ValueError(f"{len(self.rollouts)} rollouts need as many descriptions, got {len(self.described)}.")

    def in_modes(self, family: ModeFamily) -> tuple[FloatArray, list[Trajectory]]:
        """(M, A) modes and the rollouts in which nothing but the mode differed. What is no mode of this family, as of
        another version or from an archive that somebody has changed, is left out."""
        plain = [
            (family.vector(described.get("mode", {})), rollout)
            for described, rollout in zip(self.described, self.rollouts, strict=True)
            if not described.keys() - {"mode"} and _is_of(family, described.get("mode", {}))
        ]
        modes = np.array([mode for mode, _ in plain], np.float64).reshape(len(plain), len(family.axes))
        return modes, [rollout for _, rollout in plain]


def _is_of(family: ModeFamily, mode: Any) -> bool:
    ranges = {axis.name: (axis.low, axis.high) for axis in family.axes}
    return isinstance(mode, Mapping) and all(
        name in ranges and isinstance(value, int | float) and ranges[name][0] <= value <= ranges[name][1]
        for name, value in mode.items()
    )
