"""Drinking: the arm brings a cup to the mouth of a seated person and tips it until the water has been drunk."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from worker.domain.modes import ApproachModes, Axis
from worker.domain.spaces import SHARED_FIELDS, Field, Space
from worker.domain.task import Task
from worker.domain.trajectory import BODIES
from worker.domain.type_aliases import FloatArray
from worker.sim.arm import Start, Tool, start_postures
from worker.sim.assistive import ARM, MOTOR_FORCE_NM, POSITION_GAIN, AssistiveEnv, Reward, StepMotion
from worker.sim.bullet import Bullet
from worker.sim.geometry import IDENTITY, Vector, rotation_of
from worker.sim.human import Impairment
from worker.sim.jaco import JACO, PI
from worker.sim.measures import StepMeasures, StepOutcome, TaskReward
from worker.tasks.drinking.water import CUP_LAYER, IMMOVABLE_LAYER, WATER_LAYER, Cup, Water, heap

OBSERVATION = Space(
    (
        *SHARED_FIELDS,
        Field("water_in_cup", 1, "1", 0.0, 1.0, "share of the water that is in the cup"),
        Field("water_drunk", 1, "1", 0.0, 1.0, "share of the water that has been drunk"),
    )
)


@dataclass(frozen=True)
class PouringModes(ApproachModes):
    """Ways to bring a cup and to pour. Adds the axes tip_early, pour_angle and pour_haste."""

    level_rad: float | None = None

    def perceived(self, observation: Any, mode: Any, xp: Any = np) -> Any:
        """As for every approach, with the cup seen less tipped than it is by what this mode wants in addition."""
        moved = super().perceived(observation, mode, xp)
        at_mouth = self._at_mouth(observation, xp)
        extra = self._of(mode, "tip_early") * (1.0 - at_mouth) + self._of(mode, "pour_angle") * at_mouth
        forward, up = self._field(observation, "tool_forward"), self._field(observation, "tool_up")
        joints = self._field(observation, "joint_positions_rad")
        return self._replaced(
            moved,
            xp,
            tool_forward=xp.cos(extra) * forward + xp.sin(extra) * up,
            tool_up=xp.cos(extra) * up - xp.sin(extra) * forward,
            joint_positions_rad=xp.concatenate([joints[..., :6], joints[..., 6:] - extra], -1),
        )

    def speed_factor(self, observation: Any, mode: Any, xp: Any = np) -> Any:
        """As for every approach until the cup is at the mouth; there pour_haste alone says how fast it is tipped."""
        at_mouth = self._at_mouth(observation, xp)
        haste = xp.exp(self._of(mode, "pour_haste") * at_mouth)
        return super().speed_factor(observation, mode, xp) ** (1.0 - at_mouth) * haste

    def _at_mouth(self, observation: Any, xp: Any) -> Any:
        return xp.clip((0.09 - self._distance(observation, xp)) / 0.05, 0.0, 1.0)


PELLETS = 32

DRINKING = Task(
    name="drinking",
    title="Drinking",
    observation=OBSERVATION,
    modes=PouringModes(
        OBSERVATION,
        (
            Axis("speed_far", -0.6, 0.5, "log of the speed factor while the cup is far from the mouth"),
            Axis("speed_near", -0.6, 0.5, "log of the speed factor close to the mouth, before the cup is tipped"),
            Axis("from_below", -0.35, 0.35, "how far below (+) or above (-) the mouth the approach passes"),
            Axis("to_side", -0.4, 0.4, "how far to the person's left (+) or right (-) the approach swings"),
            Axis("hesitate", 0, 0.6, "how much the cup lingers a hand's breadth before the mouth"),
            Axis("tip_early", -0.2, 0.15, "how much further (+) or less (-) the cup is tipped on its way, in rad"),
            Axis("pour_angle", -0.05, 0.06, "how much further (+) or less (-) the cup is tipped at the mouth, in rad"),
            Axis("pour_haste", -0.4, 0.3, "log of the factor on how fast the cup is tipped at the mouth"),
        ),
    ),
    # From distance alone: how fast the water comes in already speaks against haste, and would make this negative.
    calibrated_speed_weight=1.21,
    episode_steps=130,
    pieces=PELLETS,
)

CUP_BASE_RADIUS_M, CUP_RIM_RADIUS_M, CUP_HEIGHT_M = 0.028, 0.040, 0.080
"""Inside of the cup."""
PELLET_RADIUS_M = 0.0085
"""of the default number; together they fill half of the cup"""
WALL_FRICTION = 0.1
WATER_NEEDED = 0.75
HELD_BEFORE_HAND_M = 0.035
"""the cup's axis is so far beyond the origin of the hand's frame"""

_CUP = Cup(CUP_BASE_RADIUS_M, CUP_RIM_RADIUS_M, CUP_HEIGHT_M)
_SIDES, _SEEN_WALL_M, _FELT_WALL_M = 10, 0.004, 0.008
_INSIDE, _LINING = "inside", _CUP.walls(_FELT_WALL_M, _SIDES)
SETTLING_SUBSTEPS = 100
ELSEWHERE_M = (60.0, 0.0, 50.0)

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
        self._water: Water
        super().__init__(reward or self._pouring_reward, bodies, impairments)

    @property
    def success(self) -> bool:
        """Whether at least three quarters of the water have been drunk."""
        return self._water.drunk >= WATER_NEEDED * self._pellets

    @property
    def particles(self) -> FloatArray:
        """(P, 3) m in the world, NaN once drunk or fallen to the floor."""
        return self._water.positions

    def _new_world(self) -> Bullet:
        return Bullet(forgetful=True)

    def _build(self) -> None:
        self._build_person_only(self._add_water, self._put_water_away)

    def _add_water(self) -> None:
        _line_cup(self._world, ELSEWHERE_M)
        self._water = Water(self._world, _CUP, pellet_radius_m(self._pellets), self._pellets)

    def _put_water_away(self) -> None:
        self._water.put_away()
        self._world.set_pose(_INSIDE, ELSEWHERE_M)

    def _lay_out(self, rng: np.random.Generator) -> None:
        self._world.carry(_INSIDE, ARM, CUP.name)
        self._water.fill(self._tool + resting_places_m(self._pellets) @ self._tool_rotation.T)
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
        if reached := self._water.at_mouth(self._target):
            self._water.drink(reached, self._target, cup_m, rotation_of(quaternion))

    def _outcome(self, motion: StepMotion) -> StepOutcome:
        self._water.drink(self._water.at_mouth(self._target), self._target, self._tool, self._tool_rotation)
        return self._water.update(self._tool, self._tool_rotation, motion.touching)

    def _own_observation(self) -> dict[str, Any]:
        return {
            "water_in_cup": [self._water.in_cup / self._pellets],
            "water_drunk": [self._water.drunk / self._pellets],
        }

    def _pouring_reward(self, step: StepMeasures) -> float:
        """What the reference policy is trained for. Tipping pays at the mouth only and costs away from it.

        Having drunk pays more per step than tipping a full cup does, or pouring would not be worth its end; it pays
        little more, or the policy hurries and tips the cup on its way.
        """
        basic = TaskReward(
            per_delivered=24.0 / self._pellets, per_spilled=-12.0 / self._pellets, speed_per_m_s=-0.2, force_per_n=-0.04
        )(step)
        left, drunk = self._water.in_cup / self._pellets, self._water.drunk / self._pellets
        tilt = min(step.tilt_rad, 1.8)
        tipping = 0.0
        if step.distance_m < 0.035:
            tipping = 0.12 * tilt
        elif step.distance_m > 0.06:
            tipping = -0.10 * tilt - 0.5 * max(0.0, tilt - 0.6)
        return float(basic + tipping * left + 0.22 * drunk)


def pellet_radius_m(pellets: int) -> float:
    """The same amount of water in any number of pellets."""
    return PELLET_RADIUS_M * math.cbrt(PELLETS / pellets)


def _line_cup(world: Bullet, place_m: Vector) -> None:
    """Add plain walls for the cup: with plain bodies the engine resolves the water's contacts three times as fast.

    They are thicker than the cup that is seen, so that no pellet passes them within one physics step.
    """
    world.add_carrier(_INSIDE, _LINING, place_m, IDENTITY)
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
    _line_cup(world, cup_m)
    radius = pellet_radius_m(pellets)
    water = Water(world, _CUP, radius, pellets)
    water.fill(cup_m + heap(_CUP, pellets, radius) @ rotation.T)
    for _ in range(SETTLING_SUBSTEPS):
        world.carry(_INSIDE, ARM, CUP.name)
        world.step()
    water.update(cup_m, rotation, set())
    places: FloatArray = (water.positions - cup_m) @ rotation
    world.close()
    places.flags.writeable = False
    return places
