"""The water: round pellets in a conical cup, each of them in the cup, in flight, drunk, or spilled."""

import math
from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from worker.domain.type_aliases import FloatArray
from worker.sim.bullet import Bullet
from worker.sim.geometry import Shape, quaternion_of_euler
from worker.sim.measures import StepOutcome

PELLET_MASS_KG = 0.001
DRUNK_WITHIN_M = 0.03
SPILLED_BEYOND_M = 0.10
FLOOR_M = 0.0

_OUT_OF_THE_WAY_M, _SWALLOWED_M = np.array([50.0, 60.0, 50.0]), np.array([50.0, 40.0, 50.0])
"""Pellets fall from here unseen."""

IMMOVABLE_LAYER, CUP_LAYER, WATER_LAYER = 2, 4, 64
"""Water meets water, the cup's inner walls and the person; the cup that the hand holds meets the person alone."""


class Cup(NamedTuple):
    """A conical cup. Its frame's origin is the point of the rim that one drinks from, z is its axis, x points out."""

    base_radius_m: float
    rim_radius_m: float
    height_m: float

    def walls(self, thickness_m: float, sides: int) -> tuple[Shape, ...]:
        """A floor and a ring of boxes about the inside of the cup."""
        slope = math.atan2(self.rim_radius_m - self.base_radius_m, self.height_m)
        middle = (self.base_radius_m + self.rim_radius_m) / 2 + thickness_m / 2
        width = (self.rim_radius_m + thickness_m) * math.tan(math.pi / sides)
        half = (thickness_m / 2, width, self.height_m / math.cos(slope) / 2)
        across = 2 * (self.base_radius_m + thickness_m)
        floor = Shape.box((-self.rim_radius_m, 0.0, -self.height_m - thickness_m / 2), (across, across, thickness_m))
        angles = [2 * math.pi * side / sides for side in range(sides)]
        ring = [
            Shape(
                "box",
                half_extents_m=half,
                position_m=(
                    middle * math.cos(angle) - self.rim_radius_m,
                    middle * math.sin(angle),
                    -self.height_m / 2,
                ),
                quaternion=quaternion_of_euler((0.0, slope, angle)),
            )
            for angle in angles
        ]
        return (floor, *ring)

    def contains(self, local_m: FloatArray) -> npt.NDArray[np.bool_]:
        """Which points (..., 3) in the cup's frame are below its rim and within its cone, give or take a wall."""
        height = local_m[..., 2] + self.height_m
        growth = (self.rim_radius_m - self.base_radius_m) / self.height_m
        radius = np.hypot(local_m[..., 0] + self.rim_radius_m, local_m[..., 1])
        inside: npt.NDArray[np.bool_] = (
            (height > -0.005) & (height < self.height_m) & (radius < self.base_radius_m + growth * height + 0.005)
        )
        return inside

    def distance_m(self, local_m: FloatArray) -> FloatArray:
        """How far points (N, 3) in the cup's frame are from the cup, taken for a cylinder with round ends, (N,)."""
        along = np.clip(local_m[:, 2], -self.height_m, 0.0)
        axis = np.stack([np.full(len(local_m), -self.rim_radius_m), np.zeros(len(local_m)), along], 1)
        distance: FloatArray = np.linalg.norm(local_m - axis, axis=1) - self.rim_radius_m
        return distance


class Water:
    """P pellets and what has become of them. A cup's frame is given as its origin (3,) and rotation (3, 3)."""

    def __init__(self, world: Bullet, cup: Cup, radius_m: float, pellets: int) -> None:
        """Add the pellets to a world, out of the way; fill() brings them into the cup."""
        self._world, self._cup = world, cup
        self.names = tuple(f"pellet_{index}" for index in range(pellets))
        world.add_balls(self.names, radius_m, PELLET_MASS_KG, _OUT_OF_THE_WAY_M + _apart(pellets), plain=True)
        for name in self.names:
            world.set_layer(name, None, WATER_LAYER, WATER_LAYER | IMMOVABLE_LAYER)

    def put_away(self) -> None:
        """Move every pellet out of the way, none near another."""
        for name, place in zip(self.names, (_OUT_OF_THE_WAY_M + _apart(len(self.names))).tolist(), strict=True):
            self._world.set_pose(name, place)

    def fill(self, positions_m: FloatArray) -> None:
        """Begin with the pellets at rest in these places, (P, 3) in the world."""
        self._positions = np.array(positions_m)
        for name, place in zip(self.names, self._positions.tolist(), strict=True):
            self._world.set_pose(name, place)
        self._present = dict.fromkeys(self.names)
        self._to_drink = dict.fromkeys(self.names)
        """neither drunk nor spilled so far, in their order"""
        self._touched: set[str] = set()
        self._newly_drunk, self._intake_speed = 0, 0.0
        self.in_cup, self.drunk, self.spilled = len(self.names), 0, 0

    @property
    def positions(self) -> FloatArray:
        """(P, 3) m in the world after the last control step; NaN for pellets that were drunk or fell to the floor."""
        return self._positions.copy()

    def at_mouth(self, mouth_m: FloatArray) -> list[str]:
        """What may be close enough to be drunk. To be asked after every physics step: pellets are quick."""
        if not self._to_drink:
            return []
        reached = self._world.near(mouth_m.tolist(), DRUNK_WITHIN_M)
        return [name for name in self._to_drink if name in reached]

    def drink(self, names: Sequence[str], mouth_m: FloatArray, cup_m: FloatArray, rotation: FloatArray) -> None:
        """Take those of these pellets that are at the mouth and outside the cup."""
        for name in names:
            place = np.array(self._world.position(name))
            if math.dist(place, mouth_m) < DRUNK_WITHIN_M and not self._cup.contains((place - cup_m) @ rotation):
                self._newly_drunk += 1
                self._intake_speed += math.hypot(*self._world.velocity(name))
                del self._to_drink[name]
                self._remove(name)

    def update(self, cup_m: FloatArray, rotation: FloatArray, touching: set[str]) -> StepOutcome:
        """Count what was drunk, spilled or fell on the person during the last control step."""
        newly_touching = (touching - self._touched) & set(self.names)
        self._touched |= newly_touching
        spilled = self._look(cup_m, rotation)
        outcome = StepOutcome(self._newly_drunk, self._intake_speed, spilled, len(newly_touching))
        self.drunk += self._newly_drunk
        self.spilled += spilled
        self._newly_drunk, self._intake_speed = 0, 0.0
        return outcome

    def _look(self, cup_m: FloatArray, rotation: FloatArray) -> int:
        """Read where every pellet is; returns how many have left the cup for good."""
        if not self._present:
            self.in_cup = 0
            return 0
        self._positions = self._world.positions(self.names)
        self._positions[[name not in self._present for name in self.names]] = np.nan
        for index in np.flatnonzero(self._positions[:, 2] < FLOOR_M).tolist():
            self._remove(self.names[index])
        local = (self._positions - cup_m) @ rotation
        lost = [self.names[index] for index in np.flatnonzero(self._cup.distance_m(local) > SPILLED_BEYOND_M).tolist()]
        lost = [name for name in lost if name in self._to_drink]
        for name in lost:
            del self._to_drink[name]
        self.in_cup = int(self._cup.contains(local).sum())
        return len(lost)

    def _remove(self, name: str) -> None:
        index = self.names.index(name)
        del self._present[name]
        self._positions[index] = np.nan
        self._world.set_pose(name, (_SWALLOWED_M + _apart(len(self.names))[index]).tolist())


@cache
def _apart(pellets: int) -> FloatArray:
    """(pellets, 3) m: a row of places far from each other."""
    places: FloatArray = np.arange(pellets)[:, None] * np.array([1.0, 0.0, 0.0])
    return places


def heap(cup: Cup, count: int, radius_m: float) -> FloatArray:
    """(count, 3) in the cup's frame: pellets in loose layers from the floor up, not touching each other."""
    places: list[Sequence[float]] = []
    height = 0.001
    while len(places) < count:
        room = cup.base_radius_m - radius_m - 0.001
        turn = 37.0 * height
        rings = [room] if room < 3 * radius_m else [room - 2.1 * radius_m, room]
        for ring in rings:
            fitting = max(1, int(math.pi / math.asin(min(1.0, 1.03 * radius_m / ring))))
            for each in range(fitting):
                angle = 2 * math.pi * each / fitting + turn
                places.append((ring * math.cos(angle), ring * math.sin(angle), height + radius_m))
        height += 2.05 * radius_m
    return np.array(places[:count]) - (cup.rim_radius_m, 0.0, cup.height_m)
