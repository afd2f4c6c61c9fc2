"""Feeding: the arm brings eight balls of food on a spoon to the mouth of a seated person."""

from functools import cache
from typing import Any, ClassVar

import numpy as np

from worker.domain.modes import ApproachModes, Axis
from worker.domain.spaces import SHARED_FIELDS, Field, Space
from worker.domain.task import Task
from worker.domain.type_aliases import FloatArray
from worker.sim.arm import Start, Tool, start_postures
from worker.sim.assistive import ARM, AssistiveEnv, Reward, StepMotion
from worker.sim.bullet import Bullet
from worker.sim.geometry import Shape, rotation_of
from worker.sim.jaco import JACO, PI
from worker.sim.measures import StepOutcome, TaskReward
from worker.tasks.feeding.food import BALL_RADIUS_M, BALLS, PORTION_NEEDED, Portion

OBSERVATION = Space(
    (
        *SHARED_FIELDS,
        Field("food_on_spoon", 1, "1", 0.0, 1.0, "share of the portion still on the spoon"),
        Field("food_eaten", 1, "1", 0.0, 1.0, "share of the portion eaten"),
    )
)

FEEDING = Task(
    name="feeding",
    title="Feeding",
    observation=OBSERVATION,
    modes=ApproachModes(
        OBSERVATION,
        (
            Axis("speed_far", -0.5, 0.45, "log of the speed factor while the spoon is far from the mouth"),
            Axis("speed_near", -0.6, 0.5, "log of the speed factor close to the mouth"),
            Axis("from_below", -0.6, 0.5, "how far below (+) or above (-) the mouth the approach passes"),
            Axis("to_side", -0.6, 0.6, "how far to the person's left (+) or right (-) the approach swings"),
            Axis("press", -0.4, 0.4, "how deep the spoon goes into the mouth: gentle (-) or pressing (+)"),
        ),
    ),
    calibrated_speed_weight=1.56,
)

SPOON_LENGTH_M, SPOON_WIDTH_M, SPOON_DEPTH_M, SPOON_WALL_M = 0.050, 0.038, 0.011, 0.003
HANDLE_LENGTH_M, HANDLE_WIDTH_M, HANDLE_HEIGHT_M = 0.11, 0.008, 0.005
SETTLING_SUBSTEPS = 50


def _spoon_boxes() -> tuple[Shape, ...]:
    length, width, depth, wall = SPOON_LENGTH_M, SPOON_WIDTH_M, SPOON_DEPTH_M, SPOON_WALL_M
    rim = depth / 2 - wall / 2
    handle = (-length / 2 - HANDLE_LENGTH_M / 2, 0.0, depth / 2)
    return (
        Shape.box((0, 0, -wall / 2), (length, width, wall)),
        Shape.box((length / 2, 0, rim), (wall, width, depth)),
        Shape.box((-length / 2, 0, rim), (wall, width, depth)),
        Shape.box((0, width / 2, rim), (length, wall, depth)),
        Shape.box((0, -width / 2, rim), (length, wall, depth)),
        Shape.box(handle, (HANDLE_LENGTH_M, HANDLE_WIDTH_M, HANDLE_HEIGHT_M)),
    )


SPOON = Tool("spoon", origin_m=(0.13, 0, 0), rpy=(-PI / 2, 0, 0), shapes=_spoon_boxes(), mass_kg=0.03)
"""Its frame has its origin at the centre of the bowl, x towards the tip, z up out of the bowl."""

START = Start(
    centre_m=(-0.18, -0.50, 1.05),
    range_m=0.05,
    tool_axes=((0.0, 1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
    posture_rad=(-3.0969, 4.2217, 0.0, 5.3567, 1.5520, 1.6114, 0.4361),
)
"""The spoon level, its tip towards the person; joint 3 turned back by one whole turn."""


class FeedingEnv(AssistiveEnv):
    """Success: at least six of the eight balls have been eaten, the benchmark's three quarters."""

    task = FEEDING
    tool = SPOON
    start = START
    task_reward: ClassVar[Reward] = TaskReward(per_delivered=2.0, per_spilled=-1.0, tilt=-0.3)

    @property
    def success(self) -> bool:
        """Whether at least six of the eight balls have been eaten."""
        return self._portion.eaten >= PORTION_NEEDED * BALLS

    @property
    def particles(self) -> FloatArray:
        """(8, 3) m in the world, NaN once eaten or fallen to the floor."""
        return self._portion.positions()

    def _new_world(self) -> Bullet:
        return Bullet(forgetful=True)

    def _build(self) -> None:
        self._build_person_only(self._add_food, lambda: self._portion.put_away())

    def _add_food(self) -> None:
        self._portion: Portion = Portion(self._world)

    def _lay_out(self, rng: np.random.Generator) -> None:
        self._portion.serve(self._tool + resting_places_m() @ self._tool_rotation.T)

    def _outcome(self, motion: StepMotion) -> StepOutcome:
        return self._portion.update(self._tool, self._target, motion.touching)

    def _own_observation(self) -> dict[str, Any]:
        return {
            "food_on_spoon": [len(self._portion.on_spoon) / BALLS],
            "food_eaten": [self._portion.eaten / BALLS],
        }


@cache
def resting_places_m() -> FloatArray:
    """(8, 3) in the spoon's frame: where the balls come to rest on a level spoon."""
    world = Bullet()
    JACO.add_to(world, SPOON)
    posture = start_postures(JACO, SPOON, START)[0]
    world.set_joints(ARM, posture)
    world.drive_joints(ARM, posture, 0.5, 200.0)
    spoon, quaternion = world.link_pose(ARM, SPOON.name)
    rotation = rotation_of(quaternion)
    pitch, height = 2.05 * BALL_RADIUS_M, BALL_RADIUS_M + 0.002
    grid = np.array([((column - 1.5) * pitch, (row - 0.5) * pitch, height) for row in (0, 1) for column in range(4)])
    portion = Portion(world)
    portion.serve(spoon + grid @ rotation.T)
    for _ in range(SETTLING_SUBSTEPS):
        world.step()
    places: FloatArray = (portion.positions() - spoon) @ rotation
    world.close()
    places.flags.writeable = False
    return places
