"""Drinking: the arm brings a cup to the mouth of a seated person and tips it until the water has been drunk."""

import math
from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np

from worker.modes import ApproachModes, Axis
from worker.sim.arm import Start, Tool, start_postures
from worker.sim.assistive import (
    ARM,
    HEAD,
    MOTOR_FORCE_NM,
    PERSON,
    POSITION_GAIN,
    AssistiveEnv,
    FloatArray,
    Motion,
    Reward,
)
from worker.sim.bullet import Bullet, rotation_of
from worker.sim.human import Impairment
from worker.sim.jaco import JACO, PI
from worker.sim.measures import Outcome, StepMeasures, TaskReward
from worker.sim.water import CUP_LAYER, IMMOVABLE_LAYER, WATER_LAYER, Cup, Water, heap
from worker.spaces import SHARED_FIELDS, Field, Space
from worker.tasks import Task
from worker.trajectory import BODIES

OBSERVATION = Space(
    (
        *SHARED_FIELDS,
        Field("water_in_cup", 1, "1", 0.0, 1.0, "share of the water that is in the cup"),
        Field("water_drunk", 1, "1", 0.0, 1.0, "share of the water that has been drunk"),
    )
)

DRINKING = Task(
    name="drinking",
    title="Drinking",
    observation=OBSERVATION,
    modes=ApproachModes(
        OBSERVATION,
        (
            Axis("speed_far", -0.8, 0.4, "log of the speed factor while the cup is far from the mouth"),
            Axis("speed_near", -0.8, 0.5, "log of the speed factor close to the mouth"),
        ),
    ),
    calibrated_speed_weight=1.0,
    episode_steps=130,
)

CUP_BASE_RADIUS_M, CUP_RIM_RADIUS_M, CUP_HEIGHT_M = 0.028, 0.040, 0.080
"""Inside of the cup."""
PELLETS = 32
PELLET_RADIUS_M = 0.0085
"""of the default number; together they fill half of the cup"""
WALL_FRICTION = 0.1
WATER_NEEDED = 0.75
HELD_BEFORE_HAND_M = 0.035
"""the cup's axis is so far beyond the origin of the hand's frame"""

_CUP = Cup(CUP_BASE_RADIUS_M, CUP_RIM_RADIUS_M, CUP_HEIGHT_M)
_SIDES, _SEEN_WALL_M, _FELT_WALL_M = 10, 0.004, 0.008
_INSIDE = "inside"
SETTLING_SUBSTEPS = 100

CUP = Tool(
    "cup",
    origin_m=(CUP_HEIGHT_M / 2, -CUP_RIM_RADIUS_M, HELD_BEFORE_HAND_M),
    rpy=(-PI / 2, 0.0, -PI / 2),
    shapes=_CUP.walls(_SEEN_WALL_M, _SIDES),
    mass_kg=0.1,
)
"""Its frame has its origin at the point of the rim that is drunk from, x out of the cup through that point, z up out of
the cup; the cup's axis lies along the hand's x axis and is tipped about the hand's own axis, which is joint 7's."""

_TURNED_IN_RAD = 0.4
"""The cup comes a little from the person's left front, so that the arm, on the right, can reach round to tip it."""

START = Start(
    centre_m=(-0.16, -0.44, 1.10),
    range_m=0.05,
    tool_axes=(
        (-math.sin(_TURNED_IN_RAD), math.cos(_TURNED_IN_RAD), 0.0),
        (-math.cos(_TURNED_IN_RAD), -math.sin(_TURNED_IN_RAD), 0.0),
        (0.0, 0.0, 1.0),
    ),
    posture_rad=(2.7592, 2.4632, -3.2043, 5.3421, 1.5324, 4.6913, -1.6185),
)


class DrinkingEnv(AssistiveEnv):
    """Success: at least three quarters of the water have been drunk, as in the benchmark."""

    task = DRINKING
    tool = CUP
    start = START

    def __init__(
        self,
        reward: Reward | None = None,
        bodies: Sequence[str] = BODIES,
        impairments: Sequence[Impairment] = ("none",),
        pellets: int = PELLETS,
    ) -> None:
        """``pellets``: into how many pieces the cup's content is divided, 16 to 64; see AssistiveEnv for the others."""
        if not 16 <= pellets <= 64:
            raise ValueError(f"pellets must be from 16 to 64; got {pellets}.")
        self._pellets = pellets
        self._driven_to = np.zeros(len(self.robot.joints))
        super().__init__(reward or self._pouring_reward, bodies, impairments)

    @property
    def success(self) -> bool:
        """Whether at least three quarters of the water have been drunk."""
        return self._water.drunk >= WATER_NEEDED * self._pellets

    @property
    def particles(self) -> FloatArray:
        """(P, 3) m in the world, NaN once drunk or fallen to the floor."""
        return self._water.positions

    def _lay_out(self, rng: np.random.Generator) -> None:
        # Links are not among the immovable by themselves, and the lining must not touch the head.
        self._world.set_layer(PERSON, HEAD, IMMOVABLE_LAYER, ~IMMOVABLE_LAYER)
        _line_cup(self._world)
        places = self._tool + resting_places_m(self._pellets) @ self._tool_rotation.T
        self._water = Water(self._world, _CUP, pellet_radius_m(self._pellets), places)
        self._driven_from = self._driven_to = self._command

    def _drive(self) -> None:
        super()._drive()
        self._driven_from, self._driven_to = self._driven_to, self._command

    def _before_substep(self, share: float) -> None:
        super()._before_substep(share)
        # A target that jumps once per control step would shake the cup ten times per second.
        target = self._driven_from + share * (self._driven_to - self._driven_from)
        self._world.drive_joints(ARM, target, POSITION_GAIN, MOTOR_FORCE_NM)
        cup_m, quaternion = self._world.carry(_INSIDE, ARM, CUP.name)
        self._water.drink(self._target, cup_m, rotation_of(quaternion))

    def _outcome(self, motion: Motion) -> Outcome:
        self._water.drink(self._target, self._tool, self._tool_rotation)
        return self._water.update(self._tool, self._tool_rotation, motion.touching)

    def _own_observation(self) -> dict[str, Any]:
        return {
            "water_in_cup": [self._water.in_cup / self._pellets],
            "water_drunk": [self._water.drunk / self._pellets],
        }

    def _pouring_reward(self, step: StepMeasures) -> float:
        """What the reference policy is trained for. Tipping pays at the mouth only and costs away from it.

        Having drunk pays as much per step as tipping a full cup does, or pouring would not be worth its end.
        """
        share = 16.0 / self._pellets
        basic = TaskReward(per_delivered=share, per_spilled=-0.5 * share, force_per_n=-0.05)(step)
        left, drunk = self._water.in_cup / self._pellets, self._water.drunk / self._pellets
        tilt = min(step.tilt_rad, 1.8)
        tipping = 0.12 if step.distance_m < 0.035 else -0.10 if step.distance_m > 0.07 else 0.0
        reward: float = basic + tipping * tilt * left + 0.25 * drunk
        return reward


def pellet_radius_m(pellets: int) -> float:
    """The same amount of water in any number of pellets."""
    return PELLET_RADIUS_M * (PELLETS / pellets) ** (1 / 3)


def _line_cup(world: Bullet) -> None:
    """Put plain walls into the cup: with plain bodies the engine resolves the water's contacts three times as fast.

    They are thicker than the cup that is seen, so that no pellet passes them within one physics step.
    """
    cup_m, quaternion = world.link_pose(ARM, CUP.name)
    world.add_carrier(_INSIDE, _CUP.walls(_FELT_WALL_M, _SIDES), cup_m, quaternion)
    world.set_material(_INSIDE, friction=WALL_FRICTION)
    world.set_layer(_INSIDE, None, IMMOVABLE_LAYER, WATER_LAYER)
    world.set_layer(ARM, CUP.name, CUP_LAYER, 0)


@cache
def resting_places_m(pellets: int) -> FloatArray:
    """(pellets, 3) in the cup's frame: where the water comes to rest in a level cup."""
    world = Bullet()
    JACO.add_to(world, CUP)
    posture = start_postures(JACO, CUP, START)[0]
    world.set_joints(ARM, posture)
    world.drive_joints(ARM, posture, POSITION_GAIN, MOTOR_FORCE_NM)
    cup_m, quaternion = world.link_pose(ARM, CUP.name)
    rotation = rotation_of(quaternion)
    _line_cup(world)
    radius = pellet_radius_m(pellets)
    water = Water(world, _CUP, radius, cup_m + heap(_CUP, pellets, radius) @ rotation.T)
    for _ in range(SETTLING_SUBSTEPS):
        world.carry(_INSIDE, ARM, CUP.name)
        world.step()
    water.update(cup_m, rotation, set())
    places: FloatArray = (water.positions - cup_m) @ rotation
    world.close()
    places.flags.writeable = False
    return places
