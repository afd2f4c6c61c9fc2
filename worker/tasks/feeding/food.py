"""The portion of food: eight balls on a spoon, each on it, eaten, fallen, or resting on the person."""

import numpy as np

from worker.domain.type_aliases import FloatArray
from worker.sim.bullet import Bullet
from worker.sim.measures import StepOutcome

BALLS = 8
BALL_RADIUS_M, BALL_MASS_KG = 0.006, 0.001
EATEN_WITHIN_M = 0.03
SPILLED_BEYOND_M = 0.06
PORTION_NEEDED = 0.75
FLOOR_M = 0.0
_OUT_OF_THE_WAY_M = np.array([(5.0 + 0.1 * index, 5.0, 5.0) for index in range(BALLS)])
"""Balls that have been eaten fall from here unseen."""


class Portion:
    """Eight balls of food and what has become of them."""

    names = tuple(f"ball_{index}" for index in range(BALLS))

    def __init__(self, world: Bullet) -> None:
        """Add the balls to a world, out of the way; serve() brings them onto the spoon."""
        self._world = world
        world.add_balls(self.names, BALL_RADIUS_M, BALL_MASS_KG, _OUT_OF_THE_WAY_M)

    def put_away(self) -> None:
        """Move every ball out of the way, none near another."""
        for name, place in zip(self.names, _OUT_OF_THE_WAY_M.tolist(), strict=True):
            self._world.set_pose(name, place)

    def serve(self, positions_m: FloatArray) -> None:
        """Begin with the balls at rest in these places, (8, 3) in the world."""
        for name, place in zip(self.names, positions_m.tolist(), strict=True):
            self._world.set_pose(name, place)
        self.on_spoon = set(self.names)
        self.present = set(self.names)
        self.touched: set[str] = set()
        self.eaten = self.spilled = 0

    def positions(self) -> FloatArray:
        """(8, 3) in the world; NaN for balls that were eaten or fell to the floor."""
        nowhere = (np.nan, np.nan, np.nan)
        return np.array([self._world.position(name) if name in self.present else nowhere for name in self.names])

    def update(self, spoon_m: FloatArray, mouth_m: FloatArray, touching: set[str]) -> StepOutcome:
        """Count what was eaten, spilled or fell on the person during the last control step."""
        newly_touching = touching - self.touched
        self.touched |= newly_touching
        eaten, spilled, intake = 0, 0, 0.0
        for name in self.names:
            if name not in self.present:
                continue
            place = np.array(self._world.position(name))
            if name in self.on_spoon and _length(place - mouth_m) < EATEN_WITHIN_M:
                eaten += 1
                intake += _length(np.array(self._world.velocity(name)))
                self._remove(name)
            elif name in self.on_spoon and _length(place - spoon_m) > SPILLED_BEYOND_M:
                spilled += 1
                self.on_spoon.discard(name)
            elif place[2] < FLOOR_M:
                self._remove(name)
        self.eaten += eaten
        self.spilled += spilled
        return StepOutcome(eaten, intake, spilled, len(newly_touching))

    def _remove(self, name: str) -> None:
        self.on_spoon.discard(name)
        self.present.discard(name)
        self._world.set_pose(name, _OUT_OF_THE_WAY_M[self.names.index(name)].tolist())


def _length(vector: FloatArray) -> float:
    return float(np.sqrt(vector @ vector))
