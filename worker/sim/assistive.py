"""What every task shares: a robot arm with a tool, a seated person, and measuring what the one does to the other.

A task subclasses `AssistiveEnv` and says where its target is, what lies around, and what counts (see worker/tasks
and docs/new_task.md). World frame: see human.py. Observations are in the robot base frame, see worker/domain/spaces.py.
"""

from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import gymnasium
import numpy as np

from worker.domain.spaces import CONTROL_STEP_S, JOINT_ACTION, Space
from worker.domain.task import Task
from worker.domain.trajectory import BODIES
from worker.domain.type_aliases import Float32Array, FloatArray
from worker.sim import human
from worker.sim.arm import RobotArm, Start, Tool, start_postures
from worker.sim.bullet import Bullet, Contact
from worker.sim.geometry import rotation_of
from worker.sim.human import Impairment, Person
from worker.sim.jaco import JACO
from worker.sim.measures import StepMeasures, StepOutcome, TaskReward
from worker.sim.seated_person import HEAD, PERSON, add_person

Reward = Callable[[StepMeasures], float]

ACTION_UNIT_RAD = 0.05
LEAD_RAD = 0.15
"""The commanded target never runs further ahead of the measured joints than this."""
POSITION_GAIN, MOTOR_FORCE_NM = 0.5, 200.0

TREMOR_RESPONSE = 0.3
"""Share of the way to the tremor's other side that a heavy head covers in one control step."""

ARM = "arm"


class StepMotion(NamedTuple):
    """What the physics of one control step was like: means over its sub-steps."""

    speed_m_s: float
    speed_squared_m2_s2: float
    force_at_target_n: float
    force_squared_n2: float
    force_away_n: float
    touching: set[str]
    """bodies other than the robot that touched the person"""


@dataclass(frozen=True)
class EpisodeState:
    """A moment of an episode: its scenario and every action since its start."""

    scenario: int
    actions: tuple[Float32Array, ...]


class AssistiveEnv(gymnasium.Env[Any, Any]):
    """One person, one arm, one tool; a private physics client per instance.

    Everything random in an episode derives from its scenario number, which is the seed given to reset(), or drawn from
    the environment's own generator when none is given. Episodes end by truncation.
    """

    metadata = {"render_modes": []}  # noqa: RUF012 (gymnasium's own declaration)

    task: ClassVar[Task]
    tool: ClassVar[Tool]
    start: ClassVar[Start]
    robot: ClassVar[RobotArm] = JACO
    task_reward: ClassVar[Reward] = TaskReward()
    head_range_deg: ClassVar[float] = human.HEAD_RANGE_DEG
    right_arm: ClassVar[human.ArmRange] = human.ARMREST
    at_target_within_m: ClassVar[float] = 0.06
    """Contacts this close to the target press on it; all others press elsewhere on the person."""
    substeps: ClassVar[int] = 5
    robot_parts: ClassVar[frozenset[str]] = frozenset({ARM})
    """bodies whose pressing on the person counts as force"""
    person_parts: ClassVar[tuple[str, ...]] = (PERSON, HEAD)
    """the person's bodies, as far as they exist, on which forces are measured"""

    person: Person
    _head_quaternion: tuple[float, float, float, float]
    _tremor: float
    _tremor_before: float

    def __init__(
        self,
        reward: Reward | None = None,
        bodies: Sequence[str] = BODIES,
        impairments: Sequence[Impairment] = ("none",),
    ) -> None:
        """``bodies`` and ``impairments`` are what scenarios draw from, each entry equally often."""
        _require_known("bodies", bodies, BODIES)
        _require_known("impairments", impairments, human.IMPAIRMENTS)
        self.observation_space = self._limits = _box(self.task.observation)
        self.action_space = _box(JOINT_ACTION)
        self.reward: Reward = reward or type(self).task_reward
        self._bodies, self._impairments = tuple(bodies), tuple(impairments)
        self._starts = start_postures(self.robot, self.tool, self.start)
        self._world = self._new_world()
        self._scenario: int | None = None
        self._history: list[Float32Array] = []

    # What a task says

    @abstractmethod
    def _lay_out(self, rng: np.random.Generator) -> None:
        """Place whatever the task needs besides person and arm, which are already there. The target is read next."""

    @abstractmethod
    def _outcome(self, motion: StepMotion) -> StepOutcome:
        """What happened to the task's objects during the control step that has just been simulated."""

    @abstractmethod
    def _own_observation(self) -> dict[str, Any]:
        """The task's own fields of the observation, by name."""

    @property
    @abstractmethod
    def success(self) -> bool:
        """Whether the task has succeeded so far."""

    @property
    def particles(self) -> FloatArray:
        """(P, 3) m in the world of food or water, NaN once swallowed or on the floor."""
        return np.empty((0, 3))

    def _new_world(self) -> Bullet:
        return Bullet()

    def _build(self) -> None:
        """Put this scenario's person and the arm into the world.

        The default builds it anew: an engine with a past replays an episode only almost identically.
        """
        self._world.clear()
        self._add_person()
        self.robot.add_to(self._world, self.tool)

    def _build_person_only(self, furnish: Callable[[], None], put_away: Callable[[], None]) -> None:
        """Instead: arm and objects are built once, which takes longer than the rest of a reset; for forgetful worlds.

        ``furnish`` adds what the task brings along, out of the way, and ``put_away`` moves it there again.
        """
        if self._world.littered:
            self._world.clear()
        if self._world.has(PERSON):
            self._world.remove(HEAD)
            self._world.remove(PERSON)
            put_away()
        else:
            self.robot.add_to(self._world, self.tool)
            furnish()
        self._world.step()
        # A head of its own and the last bodies: only so does removing them leave the order of all others as it was.
        add_person(self._world, self.person, head_apart=True)

    def _add_person(self) -> None:
        """Add the person as bodies named as in person_parts."""
        add_person(self._world, self.person)

    def _read_target(self) -> None:
        """Where the target is now. The default is the mouth, which moves with the head."""
        head = rotation_of(self._head_quaternion)
        self._body_to_target = head @ self.person.body.mouth_from_neck_m
        self._target = np.array(self.person.body.neck_pivot_m) + self._body_to_target
        self._outward = head @ human.FACE_IN_HEAD

    def _before_substep(self, share: float) -> None:
        """Called before each physics step with the share of the control step that will then be over."""
        if self.person.impairment == "tremor":
            tremor = self._tremor_before + share * (self._tremor - self._tremor_before)
            self._head_quaternion = human.head_quaternion(self.person, tremor)
            self._world.set_pose(HEAD, self.person.body.neck_pivot_m, self._head_quaternion)
            self._read_target()

    # Gymnasium

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Float32Array, dict[str, Any]]:
        """Start the scenario ``seed``, or a random one."""
        super().reset(seed=seed)
        scenario = int(self.np_random.integers(2**31)) if seed is None else seed
        self._begin(scenario)
        return self._observe(), {"scenario": scenario}

    def step(self, action: Float32Array) -> tuple[Float32Array, float, bool, bool, dict[str, Any]]:
        """Move for 0.1 s. ``info`` holds this step's unweighted costs and signals and the counts so far."""
        if self._scenario is None:
            raise gymnasium.error.ResetNeeded("Call reset() before step().")
        executed = np.clip(np.asarray(action, np.float32), -1.0, 1.0)
        measures = self._advance(executed)
        self._history.append(executed)
        info = {
            "costs": measures.costs(),
            "signals": measures.signals(),
            "success": self.success,
            "delivered": self._delivered,
            "spilled": self._spilled,
            "strokes": self._strokes,
            "contact_force_n": self._force,
        }
        truncated = len(self._history) >= self.task.episode_steps
        return self._observe(), float(self.reward(measures)), False, truncated, info

    def close(self) -> None:
        """Free the physics client."""
        self._world.close()

    # What a trajectory records beyond observations

    @property
    def joint_positions(self) -> FloatArray:
        """(7,) rad"""
        return self._joints.copy()

    @property
    def head_quaternion(self) -> tuple[float, float, float, float]:
        """xyzw in the world."""
        return self._head_quaternion

    @property
    def arm_positions_rad(self) -> FloatArray:
        """(2, 4) the person's right and left arm, in the order of human.ARM_JOINTS."""
        return self.person.arms_rad

    @property
    def target_m(self) -> FloatArray:
        """(3,) in the world."""
        return self._target.copy()

    # Going back in time

    def save_state(self) -> EpisodeState:
        """This moment of the episode, valid in any instance and process."""
        if self._scenario is None:
            raise gymnasium.error.ResetNeeded("Call reset() before save_state().")
        return EpisodeState(self._scenario, tuple(self._history))

    def restore_state(self, state: EpisodeState) -> Float32Array:
        """Return to a saved moment and give its observation; what follows is bit-identical.

        The engine's own snapshots forget the order of contact points and drift apart, so the episode is replayed:
        this takes as long as its steps did.
        """
        self._begin(state.scenario)
        for action in state.actions:
            self._advance(action)
            self._history.append(action)
        return self._observe()

    # Private

    def _begin(self, scenario: int) -> None:
        rng = np.random.default_rng(scenario)
        self.person = human.draw_person(rng, self._bodies, self._impairments, self.head_range_deg, self.right_arm)
        self._head_quaternion = human.head_quaternion(self.person)
        self._tremor = self._tremor_before = 0.0
        self._command = self._starts[rng.integers(len(self._starts))].copy()
        self._history = []
        self._delivered = self._spilled = self._strokes = 0
        self._previous_action = np.zeros(len(self.robot.joints))
        self._previous_velocity = np.zeros(3)
        self._force = 0.0
        self._build()
        self._touchable = [part for part in self.person_parts if self._world.has(part)]
        self._world.set_joints(ARM, self._command)
        self._drive()
        self._read_arm()
        self._lay_out(rng)
        self._read_target()
        self._scenario = scenario

    def _advance(self, executed: Float32Array) -> StepMeasures:
        action = executed.astype(np.float64)
        target = np.clip(self._command + action * ACTION_UNIT_RAD, self._joints - LEAD_RAD, self._joints + LEAD_RAD)
        self._command = np.clip(target, self.robot.lower_rad, self.robot.upper_rad)
        self._drive()
        tool_before, rotation_before = self._tool, self._tool_rotation
        motion = self._simulate()
        self._read_arm()
        self._read_target()
        outcome = self._outcome(motion)
        self._delivered += outcome.delivered
        self._spilled += outcome.spilled
        self._strokes += outcome.strokes
        velocity = (self._tool - tool_before) / CONTROL_STEP_S
        # The Frobenius norm of a change of rotation is sqrt(2) times its angle, for the small angles of one step.
        turned = float(((self._tool_rotation - rotation_before) ** 2).sum() / 2) ** 0.5
        measures = StepMeasures(
            tool_m=self._tool,
            tool_up=self._tool_rotation[:, 2],
            target_m=self._target,
            outward=self._outward,
            speed_m_s=motion.speed_m_s,
            speed_squared_m2_s2=motion.speed_squared_m2_s2,
            acceleration_m_s2=(velocity - self._previous_velocity) / CONTROL_STEP_S,
            turn_speed_rad_s=turned / CONTROL_STEP_S,
            force_at_target_n=motion.force_at_target_n,
            force_squared_n2=motion.force_squared_n2,
            force_away_n=motion.force_away_n,
            action=action,
            previous_action=self._previous_action,
            outcome=outcome,
            undelivered=not self.success,
        )
        self._previous_action, self._previous_velocity = action, velocity
        self._force = motion.force_at_target_n + motion.force_away_n
        return measures

    def _simulate(self) -> StepMotion:
        side = 1.0 if len(self._history) % 2 else -1.0
        self._tremor_before = self._tremor
        self._tremor += TREMOR_RESPONSE * (side - self._tremor)
        speed = speed_squared = at_target = squared = away = 0.0
        touching: set[str] = set()
        share = 1.0 / self.substeps
        for index in range(self.substeps):
            self._before_substep((index + 1) * share)
            self._world.step()
            x, y, z = self._world.link_velocity(ARM, self.tool.name)
            square = x * x + y * y + z * z
            speed_squared += square
            speed += square**0.5
            on_target, elsewhere = self._forces(touching)
            at_target += on_target
            squared += on_target * on_target
            away += elsewhere
        return StepMotion(
            speed * share, speed_squared * share, at_target * share, squared * share, away * share, touching
        )

    def _forces(self, touching: set[str]) -> tuple[float, float]:
        """Normal force on the person at the target and elsewhere, N; adds to ``touching`` who else touches them."""
        at_target = away = 0.0
        target_x, target_y, target_z = self._target.tolist()
        limit = self.at_target_within_m**2
        for part in self._touchable:
            for contact in self._world.contacts(part):
                if contact.other not in self.robot_parts:
                    touching.add(contact.other)
                    continue
                x, y, z = contact.position_m
                if (x - target_x) ** 2 + (y - target_y) ** 2 + (z - target_z) ** 2 < limit:
                    at_target += contact.normal_force_n
                    self._touched_target(contact)
                else:
                    away += contact.normal_force_n
        return at_target, away

    def _touched_target(self, contact: Contact) -> None:
        """Called for every contact of the robot near the target, in every physics step."""

    def _observe(self) -> Float32Array:
        base = self.robot.mount_rotation
        shared = (
            self.robot.in_base_frame(self._tool),
            self._tool_rotation[:, 0] @ base,
            self._tool_rotation[:, 2] @ base,
            (self._target - self._tool) @ base,
            self._joints,
            self._body_to_target @ base,
            self._outward @ base,
            [self._force],
        )
        own = self._own_observation()
        fields = self.task.observation.fields[len(shared) :]
        vector = np.concatenate([*shared, *(own[each.name] for each in fields)]).astype(np.float32)
        clipped: Float32Array = np.clip(vector, self._limits.low, self._limits.high)
        return clipped

    def _read_arm(self) -> None:
        self._joints = self._world.joints(ARM, len(self.robot.joints))
        self._tool, quaternion = self._world.link_pose(ARM, self.tool.name)
        self._tool_rotation = rotation_of(quaternion)

    def _drive(self) -> None:
        self._world.drive_joints(ARM, self._command, POSITION_GAIN, MOTOR_FORCE_NM)


def _box(space: Space) -> gymnasium.spaces.Box:
    low = np.concatenate([np.full(field.size, field.low, np.float32) for field in space.fields])
    high = np.concatenate([np.full(field.size, field.high, np.float32) for field in space.fields])
    return gymnasium.spaces.Box(low, high, dtype=np.float32)


def _require_known(what: str, given: Sequence[str], known: Sequence[str]) -> None:
    unknown = [each for each in given if each not in known]
    if unknown or not given:
        raise ValueError(f"{what} must name at least one of {', '.join(known)}; got {', '.join(unknown) or 'nothing'}.")
