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
        """(M, A) modes and the rollouts in which nothing but the mode differed; not those of axes that are no more."""
        plain = [
            (family.vector(described.get("mode", {})), rollout)
            for described, rollout in zip(self.described, self.rollouts, strict=True)
            if not described.keys() - {"mode"} and {*described.get("mode", {})} <= {*family.names}
        ]
        modes = np.array([mode for mode, _ in plain], np.float64).reshape(len(plain), len(family.axes))
        return modes, [rollout for _, rollout in plain]
