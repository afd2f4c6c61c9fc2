"""Feeding: a Jaco arm brings eight balls of food on a spoon to the mouth of a seated person. Gymnasium, 10 Hz.

World frame: see human.py. Observations are in the robot base frame, see worker/spaces.py.
"""

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass
from functools import cache
from itertools import chain
from typing import Any, NamedTuple

import gymnasium
import numpy as np
import numpy.typing as npt

from worker.sim import human, jaco
from worker.sim.bullet import IDENTITY, Bullet, Shape, capsule_between, quaternion_of_euler, rotation_of
from worker.sim.food import BALL_RADIUS_M, BALLS, PORTION_NEEDED, Portion
from worker.sim.measures import StepMeasures, TaskReward
from worker.spaces import CONTROL_STEP_S, FEEDING_OBSERVATION, JOINT_ACTION, Space
from worker.trajectory import COSTS, SIGNALS

Array = npt.NDArray[np.float32]
FloatArray = npt.NDArray[np.float64]

EPISODE_STEPS = 100
SUBSTEPS = 5
SETTLING_SUBSTEPS = 50
ACTION_UNIT_RAD = 0.05
LEAD_RAD = 0.15
"""The commanded target never runs further ahead of the measured joints than this."""
POSITION_GAIN, MOTOR_FORCE_NM = 0.5, 200.0

AT_TARGET_WITHIN_M = 0.06
"""Contacts this close to the mouth press on the target; all others press elsewhere on the person."""

START_CENTRE_M = (-0.18, -0.50, 1.05)
START_RANGE_M = 0.05
START_POSTURE_RAD = (-3.0969, 4.2217, 0.0, 5.3567, 1.5520, 1.6114, 0.4361)
"""Found by tests/benchmarks/start_posture.py, with joint 3 turned back by one whole turn."""
START_COUNT = 256

BASE_ROTATION = jaco.rotation(jaco.ROBOT_BASE_RPY)
LEVEL_TOWARDS_PERSON = BASE_ROTATION.T @ np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""Spoon orientation (3, 3) in the base frame: tip towards the person (+y of the world), bowl level."""

PERSON_PARTS = ("body", "legs", "head")


def in_base_frame(points_m: FloatArray) -> FloatArray:
    """World points (..., 3) as seen from the robot's base."""
    seen: FloatArray = (points_m - np.array(jaco.ROBOT_BASE_M)) @ BASE_ROTATION
    return seen


def add_person(world: Bullet, head_quaternion: Sequence[float] = IDENTITY) -> None:
    """Add the seated person's collision shapes as immovable bodies, PERSON_PARTS."""
    body, legs, head = _person_shapes()
    world.add_body("body", body)
    world.add_body("legs", legs)
    world.add_body("head", head, human.NECK_PIVOT_M, head_quaternion)


@cache
def _person_shapes() -> tuple[list[Shape], list[Shape], list[Shape]]:
    body, legs = ([capsule_between(*limb[1:]) for limb in limbs] for limbs in (human.BODY, human.LEGS))
    return body, legs, [Shape("sphere", ball.radius_m, position_m=ball.centre_m) for ball in human.HEAD]


def _box(space: Space) -> gymnasium.spaces.Box:
    low = np.concatenate([np.full(field.size, field.low, np.float32) for field in space.fields])
    high = np.concatenate([np.full(field.size, field.high, np.float32) for field in space.fields])
    return gymnasium.spaces.Box(low, high, dtype=np.float32)


_OBSERVATIONS, _ACTIONS = _box(FEEDING_OBSERVATION), _box(JOINT_ACTION)


class _Motion(NamedTuple):
    """Sums over the sub-steps of one control step, already divided by their number."""

    speed_m_s: float
    speed_squared: float
    force_at_target_n: float
    force_away_n: float
    balls_touching: set[str]


@dataclass(frozen=True)
class EpisodeState:
    """A moment of an episode: its scenario and every action since its start."""

    scenario: int
    actions: tuple[Array, ...]


class FeedingEnv(gymnasium.Env[Any, Any]):
    """One person, one arm, one spoon of food; a private physics client per instance.

    Everything random in an episode derives from its scenario number, which is the seed given to reset(), or drawn
    from the environment's own generator when none is given. Episodes last 100 control steps and end by truncation.
    """

    metadata = {"render_modes": []}  # noqa: RUF012 (gymnasium's own declaration)

    def __init__(self, reward: TaskReward | None = None) -> None:
        self.observation_space = deepcopy(_OBSERVATIONS)
        self.action_space = deepcopy(_ACTIONS)
        self.reward = reward or TaskReward()
        self._world = Bullet()
        self._scenario: int | None = None
        self._history: list[Array] = []

    # Gymnasium

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """Start the scenario ``seed``, or a random one."""
        super().reset(seed=seed)
        scenario = int(self.np_random.integers(2**31)) if seed is None else seed
        self._begin(scenario)
        return self._observe(), {"scenario": scenario}

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Move for 0.1 s. ``info`` holds this step's unweighted costs and signals and the counts so far."""
        if self._scenario is None:
            raise gymnasium.error.ResetNeeded("Call reset() before step().")
        executed = np.clip(np.asarray(action, np.float32), -1.0, 1.0)
        measures = self._advance(executed)
        self._history.append(executed)
        force = measures.force_at_target_n + measures.force_away_n
        info = {
            "costs": dict(zip(COSTS, measures.costs().tolist(), strict=True)),
            "signals": dict(zip(SIGNALS, measures.signals().tolist(), strict=True)),
            "success": self.success,
            "eaten": self._portion.eaten,
            "spilled": self._portion.spilled,
            "contact_force_n": force,
        }
        truncated = len(self._history) >= EPISODE_STEPS
        return self._observe(), self.reward.of(measures), False, truncated, info

    def close(self) -> None:
        """Free the physics client."""
        self._world.close()

    # What a trajectory records beyond observations

    @property
    def success(self) -> bool:
        """Whether at least six of the eight balls have been eaten."""
        return self._portion.eaten >= PORTION_NEEDED * BALLS

    @property
    def joint_positions(self) -> FloatArray:
        """(7,) rad"""
        return self._joints.copy()

    @property
    def particles(self) -> FloatArray:
        """(8, 3) m in the world, NaN once eaten or fallen to the floor."""
        return self._portion.positions()

    @property
    def head_quaternion(self) -> tuple[float, float, float, float]:
        """xyzw in the world, fixed within an episode."""
        return self._head_quaternion

    # Going back in time

    def save_state(self) -> EpisodeState:
        """This moment of the episode, valid in any instance and process."""
        if self._scenario is None:
            raise gymnasium.error.ResetNeeded("Call reset() before save_state().")
        return EpisodeState(self._scenario, tuple(self._history))

    def restore_state(self, state: EpisodeState) -> Array:
        """Return to a saved moment and give its observation; what follows is bit-identical.

        The engine's own snapshots forget the order of contact points and drift apart, so the episode is replayed:
        this takes as long as its steps did.
        """
        self._begin(state.scenario)
        for action in state.actions:
            self._advance(action)
        self._history = list(state.actions)
        return self._observe()

    # Private

    def _begin(self, scenario: int) -> None:
        """Build the world anew: an engine with a past replays an episode only almost identically."""
        rng = np.random.default_rng(scenario)
        limit = np.radians(human.HEAD_RANGE_DEG)
        self._head_quaternion = quaternion_of_euler(rng.uniform(-limit, limit, 3))
        head = rotation_of(self._head_quaternion)
        self._neck_to_mouth = head @ human.MOUTH_FROM_NECK_M
        self._mouth = np.array(human.NECK_PIVOT_M) + self._neck_to_mouth
        self._face = head @ human.FACE_IN_HEAD
        self._command = start_postures()[rng.integers(START_COUNT)].copy()
        self._world.clear()
        add_person(self._world, self._head_quaternion)
        _add_arm(self._world, self._command)
        self._read_arm()
        places = self._spoon + resting_places_m() @ self._spoon_rotation.T
        self._portion = Portion(self._world, places)
        self._scenario = scenario
        self._history = []
        self._previous_action = np.zeros(len(jaco.JOINTS))
        self._previous_velocity = np.zeros(3)
        self._force = 0.0

    def _advance(self, executed: Array) -> StepMeasures:
        action = executed.astype(np.float64)
        target = np.clip(self._command + action * ACTION_UNIT_RAD, self._joints - LEAD_RAD, self._joints + LEAD_RAD)
        self._command = np.clip(target, jaco.LOWER_RAD, jaco.UPPER_RAD)
        _drive(self._world, self._command)
        spoon_before = self._spoon
        motion = self._simulate()
        self._read_arm()
        food = self._portion.update(self._spoon, self._mouth, motion.balls_touching)
        velocity = (self._spoon - spoon_before) / CONTROL_STEP_S
        measures = StepMeasures(
            spoon_m=self._spoon,
            spoon_up=self._spoon_rotation[:, 2],
            mouth_m=self._mouth,
            face=self._face,
            speed_m_s=motion.speed_m_s,
            speed_squared_m2_s2=motion.speed_squared,
            acceleration_m_s2=(velocity - self._previous_velocity) / CONTROL_STEP_S,
            force_at_target_n=motion.force_at_target_n,
            force_away_n=motion.force_away_n,
            action=action,
            previous_action=self._previous_action,
            eaten=food.eaten,
            intake_speed_m_s=food.intake_speed_m_s,
            spilled=food.spilled,
            on_person=food.on_person,
            undelivered=not self.success,
        )
        self._previous_action, self._previous_velocity = action, velocity
        self._force = motion.force_at_target_n + motion.force_away_n
        return measures

    def _simulate(self) -> _Motion:
        speed = speed_squared = at_target = away = 0.0
        touching: set[str] = set()
        mouth_x, mouth_y, mouth_z = self._mouth.tolist()
        for _ in range(SUBSTEPS):
            self._world.step()
            x, y, z = self._world.link_velocity("arm", jaco.SPOON_LINK)
            squared = x * x + y * y + z * z
            speed_squared += squared
            speed += squared**0.5
            for contact in chain.from_iterable(map(self._world.contacts, PERSON_PARTS)):
                if contact.other != "arm":
                    touching.add(contact.other)
                    continue
                x, y, z = contact.position_m
                gap_squared = (x - mouth_x) ** 2 + (y - mouth_y) ** 2 + (z - mouth_z) ** 2
                if gap_squared < AT_TARGET_WITHIN_M**2:
                    at_target += contact.normal_force_n
                else:
                    away += contact.normal_force_n
        share = 1.0 / SUBSTEPS
        return _Motion(speed * share, speed_squared * share, at_target * share, away * share, touching)

    def _observe(self) -> Array:
        parts = {
            "spoon_position_m": in_base_frame(self._spoon),
            "spoon_forward": self._spoon_rotation[:, 0] @ BASE_ROTATION,
            "spoon_up": self._spoon_rotation[:, 2] @ BASE_ROTATION,
            "spoon_to_mouth_m": (self._mouth - self._spoon) @ BASE_ROTATION,
            "joint_positions_rad": self._joints,
            "neck_to_mouth_m": self._neck_to_mouth @ BASE_ROTATION,
            "face_direction": self._face @ BASE_ROTATION,
            "force_on_person_n": [self._force],
            "food_on_spoon": [len(self._portion.on_spoon) / BALLS],
            "food_eaten": [self._portion.eaten / BALLS],
        }
        vector = np.concatenate([parts[field.name] for field in FEEDING_OBSERVATION.fields]).astype(np.float32)
        clipped: Array = np.clip(vector, _OBSERVATIONS.low, _OBSERVATIONS.high)
        return clipped

    def _read_arm(self) -> None:
        self._joints = self._world.joints("arm", len(jaco.JOINTS))
        self._spoon, quaternion = self._world.link_pose("arm", jaco.SPOON_LINK)
        self._spoon_rotation = rotation_of(quaternion)

    def _drive(self) -> None:
        self._world.drive_joints("arm", self._command, POSITION_GAIN, MOTOR_FORCE_NM)


def _drive(world: Bullet, command_rad: FloatArray) -> None:
    world.drive_joints("arm", command_rad, POSITION_GAIN, MOTOR_FORCE_NM)


def _add_arm(world: Bullet, posture_rad: FloatArray) -> None:
    jaco.add_to(world)
    world.set_damping("arm", 0.0, 0.0)
    world.set_material("arm", jaco.SPOON_LINK)
    world.set_joints("arm", posture_rad)
    _drive(world, posture_rad)


@cache
def resting_places_m() -> FloatArray:
    """(8, 3) in the spoon's frame: where the balls come to rest on a level spoon."""
    world = Bullet()
    _add_arm(world, start_postures()[0])
    spoon, quaternion = world.link_pose("arm", jaco.SPOON_LINK)
    rotation = rotation_of(quaternion)
    pitch, height = 2.05 * BALL_RADIUS_M, BALL_RADIUS_M + 0.002
    grid = np.array([((column - 1.5) * pitch, (row - 0.5) * pitch, height) for row in (0, 1) for column in range(4)])
    portion = Portion(world, spoon + grid @ rotation.T)
    for _ in range(SETTLING_SUBSTEPS):
        world.step()
    places: FloatArray = (portion.positions() - spoon) @ rotation
    world.close()
    places.flags.writeable = False
    return places


@cache
def start_postures() -> FloatArray:
    """(256, 7) rad: arm postures with the level spoon within 5 cm of the start, all in one elbow configuration."""
    rng = np.random.default_rng(1)
    offsets = rng.uniform(-START_RANGE_M, START_RANGE_M, (START_COUNT, 3))
    goals = in_base_frame(np.array(START_CENTRE_M) + offsets)
    first = np.tile(START_POSTURE_RAD, (START_COUNT, 1))
    postures, errors = jaco.solve_spoon_pose(first, goals, LEVEL_TOWARDS_PERSON)
    if errors.max() > 1e-3:
        raise RuntimeError(f"A start posture misses its goal by {errors.max():.4f}.")
    postures.flags.writeable = False
    return postures
