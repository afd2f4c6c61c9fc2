"""Execution modes: a small space of ways to do a task, applied on top of the frozen policy.

A mode is a point in a handful of interpretable axes. It changes how fast the arm goes far from and near the person, by
which path it comes, how deep it presses, without changing the policy's weights: the policy is shown a target that the
mode has moved, and its action is scaled. The same functions serve the simulator (NumPy, one state) and the exported
filter (torch, a batch), so that what is trained is what is shipped.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt

from worker.domain.spaces import Space


@dataclass(frozen=True)
class Axis:
    """One way in which executions differ; 0 is the reference policy's own way."""

    name: str
    low: float
    high: float
    meaning: str


@dataclass(frozen=True)
class ModeFamily(ABC):
    """The modes of one task. Observations are (..., D), modes (..., A); ``xp`` is numpy or torch."""

    observation: Space
    axes: tuple[Axis, ...]
    _column: MappingProxyType[str, int] = field(init=False, repr=False, compare=False)
    _place: MappingProxyType[str, slice] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        columns = {axis.name: index for index, axis in enumerate(self.axes)}
        places = {each.name: place for each, place in self.observation.slices()}
        object.__setattr__(self, "_column", MappingProxyType(columns))
        object.__setattr__(self, "_place", MappingProxyType(places))

    def __reduce__(self) -> tuple[Any, ...]:
        """Families travel between processes; what is derived from the fields is derived again."""
        return type(self), tuple(getattr(self, name) for name in self.__dataclass_fields__ if not name.startswith("_"))

    @property
    def reference(self) -> npt.NDArray[np.float64]:
        """(A,) the frozen policy's own way."""
        return np.zeros(len(self.axes))

    @property
    def names(self) -> tuple[str, ...]:
        """The axes' names, in order."""
        return tuple(axis.name for axis in self.axes)

    def vector(self, mode: Mapping[str, float]) -> list[float]:
        """A mode by the names of its axes -> its A coordinates; axes that are not named are 0.

        Raises ValueError for a name that is none of this family's axes.
        """
        unknown = sorted(set(mode) - set(self.names))
        if unknown:
            raise ValueError(f"This task has no mode axis {', '.join(unknown)}; it has {', '.join(self.names)}.")
        return [float(mode.get(name, 0.0)) for name in self.names]

    def named(self, mode: npt.ArrayLike) -> dict[str, float]:
        """The A coordinates of a mode by the names of their axes."""
        return dict(zip(self.names, np.asarray(mode, float).tolist(), strict=True))

    def sample(self, count: int, rng: np.random.Generator) -> npt.NDArray[np.float64]:
        """Random modes, (count, A): uniform in each axis' range, each axis left at 0 with probability 1/4."""
        low, high = (np.array([getattr(axis, end) for axis in self.axes]) for end in ("low", "high"))
        modes = rng.uniform(low, high, (count, len(self.axes)))
        kept: npt.NDArray[np.float64] = modes * (rng.random(modes.shape) < 0.75)
        return kept

    def policy(self, mode: npt.ArrayLike) -> str:
        """Name of the policy that a mode (A,) is executed by; empty: the frozen one."""
        return ""

    @abstractmethod
    def perceived(self, observation: Any, mode: Any, xp: Any = np) -> Any:
        """The observation (..., D) as the policy should see it in this mode."""

    def speed_factor(self, observation: Any, mode: Any, xp: Any = np) -> Any:
        """The factor on the policy's mean action, (..., 1) or (..., 7)."""
        return 1.0

    def executed(self, observation: Any, mode: Any, action: Any, xp: Any = np) -> Any:
        """The action (..., A) that becomes of the policy's in this mode; not clipped."""
        return self.speed_factor(observation, mode, xp) * action

    # For subclasses

    def _of(self, mode: Any, name: str) -> Any:
        """One axis of a mode, (..., 1); 0 when this family has no such axis."""
        column = self._column.get(name)
        return 0.0 if column is None else mode[..., column : column + 1]

    def _field(self, observation: Any, name: str) -> Any:
        return observation[..., self._place[name]]

    def _replaced(self, observation: Any, xp: Any, **fields: Any) -> Any:
        """The observation with whole fields replaced."""
        parts, start = [], 0
        for name, place in sorted(((name, self._place[name]) for name in fields), key=lambda item: item[1].start):
            parts += [observation[..., start : place.start], fields[name]]
            start = place.stop
        return xp.concatenate([*parts, observation[..., start:]], -1)


@dataclass(frozen=True)
class ApproachModes(ModeFamily):
    """Modes of any task that brings a tool to a target: how fast, by which way, how deep.

    Understands the axes speed_far, speed_near, from_below, to_side, press and hesitate; a family may leave some out.
    """

    detour_m: float = 0.14
    """how far from_below or to_side = 1 moves the perceived target while the tool is away from it"""
    press_m: float = 0.07
    """how far press = 1 moves the perceived target into the person once the tool is there"""
    level_rad: float | None = 0.65
    """beyond this tilt the arm is not slowed: it would stretch a spill. None: tilt does not matter"""
    hesitation_m: float = 0.12
    """hesitate slows the arm around this distance from the target"""
    same_speed_share: float = 0.6
    """share of random modes that are as quick near the person as far away: people disagree most about plain speed"""

    def sample(self, count: int, rng: np.random.Generator) -> npt.NDArray[np.float64]:
        """As for every family, but many modes are equally quick all the way."""
        modes = super().sample(count, rng)
        same = rng.random(count) < self.same_speed_share
        if "speed_far" in self.names and "speed_near" in self.names:
            far, near = self.names.index("speed_far"), self.names.index("speed_near")
            same &= modes[:, far] != 0.0
            modes[same, near] = np.clip(modes[same, far], self.axes[near].low, self.axes[near].high)
        return modes

    def perceived(self, observation: Any, mode: Any, xp: Any = np) -> Any:
        """The target moved to where this mode wants the tool to go."""
        shift = self.shift(observation, mode, xp)
        return self._replaced(
            observation,
            xp,
            tool_to_target_m=self._field(observation, "tool_to_target_m") + shift,
            body_to_target_m=self._field(observation, "body_to_target_m") + shift,
        )

    def shift(self, observation: Any, mode: Any, xp: Any = np) -> Any:
        """How far the perceived target lies from the true one, (..., 3), in the base frame."""
        outward, distance = self._field(observation, "target_outward"), self._distance(observation, xp)
        away = xp.clip((distance - 0.05) / 0.15, 0.0, 1.0)
        there = xp.clip((0.09 - distance) / 0.05, 0.0, 1.0)
        up = xp.zeros_like(outward) + xp.asarray([0.0, 0.0, 1.0], dtype=outward.dtype)
        side = xp.stack([-outward[..., 1], outward[..., 0], xp.zeros_like(outward[..., 0])], -1)
        return (
            -self.detour_m * away * self._of(mode, "from_below") * up
            + self.detour_m * away * self._of(mode, "to_side") * side
            - self.press_m * there * self._of(mode, "press") * outward
        )

    def speed_factor(self, observation: Any, mode: Any, xp: Any = np) -> Any:
        """Far and near speeds blended by the distance to the target, (..., 1)."""
        distance = self._distance(observation, xp)
        far = xp.clip((distance - 0.12) / 0.12, 0.0, 1.0)
        slow_band = xp.clip(1.0 - ((distance - self.hesitation_m) / 0.05) ** 2, 0.0, 1.0)
        factor = xp.exp(
            self._of(mode, "speed_far") * far
            + self._of(mode, "speed_near") * (1.0 - far)
            - self._of(mode, "hesitate") * slow_band
        )
        if self.level_rad is None:
            return factor
        tilt = xp.arccos(xp.clip(self._field(observation, "tool_up")[..., 2:3], -1.0, 1.0))
        level = xp.clip((self.level_rad - tilt) / 0.15, 0.0, 1.0)
        return xp.where(factor < 1.0, 1.0 + (factor - 1.0) * level, factor)

    def _distance(self, observation: Any, xp: Any) -> Any:
        to_target = self._field(observation, "tool_to_target_m")
        return xp.sqrt((to_target * to_target).sum(-1))[..., None]
