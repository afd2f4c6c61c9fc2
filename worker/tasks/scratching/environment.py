"""Itch Scratching: the arm scratches an itch on the right arm of a seated person, which gives way."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from worker.domain.modes import ApproachModes, Axis
from worker.domain.spaces import SHARED_FIELDS, Field, Space
from worker.domain.task import Task
from worker.domain.trajectory import BODIES
from worker.domain.type_aliases import FloatArray
from worker.sim import human
from worker.sim.arm import Start, Tool
from worker.sim.assistive import ARM, MOTOR_FORCE_NM, POSITION_GAIN, AssistiveEnv, Reward, StepMotion
from worker.sim.bullet import Bullet, Contact
from worker.sim.geometry import Shape, capsule_between, rotation_of
from worker.sim.human import ArmRange, Impairment
from worker.sim.jaco import PI
from worker.sim.measures import HIGH_FORCE_N, StepMeasures, StepOutcome, TaskReward
from worker.sim.seated_person import PERSON
from worker.tasks.scratching.yielding_arm import FOREARM, UPPER_ARM, YieldingArm, add_placeholder

OBSERVATION = Space(
    (
        *SHARED_FIELDS,
        Field(
            "tip_to_last_stroke_m",
            3,
            "m",
            -1.5,
            1.5,
            "place of the last counted stroke minus tip, base frame; 0 before",
        ),
        Field("limb_direction", 3, "1", -1.0, 1.0, "unit vector along the itching limb towards the hand, base frame"),
        Field("strokes", 1, "1", 0.0, 1.0, "share of the strokes needed that have been made"),
    )
)


@dataclass(frozen=True)
class ScratchingModes(ApproachModes):
    """Adds how quickly the tip goes over the skin; and who presses firmly also feels less of it."""

    press_m: float = 0.012
    level_rad: float | None = None
    hesitation_m: float = 0.10
    skin_m: float = 0.05
    """closer than this the speed is that of the strokes"""
    same_speed_share: float = 0.9
    stroke_share: float = 0.3
    """in modes that are as quick near the person as far away, strokes differ in speed by this power of the factor"""
    feeling: float = 1.0
    """log of the factor by which press = 1 lessens the force that is felt"""

    def sample(self, count: int, rng: np.random.Generator) -> FloatArray:
        """As for any approach; modes that are as quick near as far are brisker or calmer on the skin, too."""
        modes = super().sample(count, rng)
        far, near, stroke = (self.names.index(name) for name in ("speed_far", "speed_near", "stroke_speed"))
        same = (modes[:, far] != 0.0) & (modes[:, far] == modes[:, near])
        modes[same, stroke] = self.stroke_share * modes[same, far]
        return modes

    def perceived(self, observation: Any, mode: Any, xp: Any = np) -> Any:
        """As for any approach; the policy, which keeps its force in hand, is shown a smaller one to press firmly."""
        seen = super().perceived(observation, mode, xp)
        felt = self._field(observation, "force_on_person_n") * xp.exp(-self.feeling * self._of(mode, "press"))
        return self._replaced(seen, xp, force_on_person_n=felt)

    def speed_factor(self, observation: Any, mode: Any, xp: Any = np) -> Any:
        """The approach's factor, and on the skin the strokes' own."""
        on_skin = xp.clip((self.skin_m + 0.03 - self._distance(observation, xp)) / 0.03, 0.0, 1.0)
        approach = super().speed_factor(observation, mode, xp)
        return approach ** (1.0 - on_skin) * xp.exp(self._of(mode, "stroke_speed") * on_skin)


SCRATCHING = Task(
    name="scratching",
    title="Scratching",
    observation=OBSERVATION,
    modes=ScratchingModes(
        OBSERVATION,
        (
            Axis("speed_far", -1.0, 0.4, "log of the speed factor while the scratcher is far from the arm"),
            Axis("speed_near", -1.0, 0.5, "log of the speed factor close to the arm"),
            Axis("stroke_speed", -0.8, 0.4, "log of the speed factor on the skin: calm (-) or brisk (+) strokes"),
            Axis("press", -1.0, 1.0, "how firmly the tip is pressed on the skin: gentle (-) or firm (+)"),
            Axis("from_below", -0.4, 0.4, "how far below (+) or above (-) the itch the approach passes"),
            Axis("to_side", -0.4, 0.4, "to which side of the itch the approach swings"),
            Axis("hesitate", 0.0, 0.8, "how long the tip waits before it touches the skin"),
        ),
    ),
    calibrated_speed_weight=1.41,
    speed_counts_near=False,
    can_spill=False,
    printed_betas=(1.0, 1.0, 0.1, 1.0),
)
"""Strokes are what the person asked for, so only the approach's speed is a cost. With strokes counted, no weight made
paper's users differ: quick strokes take the tip away from the itch, and all three wanted the same slow ones. The weight
makes the reference person content with the speed of the approach (speed_far and speed_near scaled together).
"""

SCRATCHER_LENGTH_M = 0.20
"""from the tip to the end of the handle"""
HANDLE_RADIUS_M = 0.005
HANDLE_RISE_M = 0.006
"""The handle lies so far above the tip's middle."""
TIP_RADIUS_M = 0.010

SCRATCHER = Tool(
    "scratcher",
    origin_m=(0.13, 0.0, 0.0),
    rpy=(-PI / 2, 0.0, 0.0),
    shapes=(
        Shape("sphere", TIP_RADIUS_M),
        capsule_between((-SCRATCHER_LENGTH_M, 0, HANDLE_RISE_M), (-0.008, 0, HANDLE_RISE_M), HANDLE_RADIUS_M),
    ),
    mass_kg=0.03,
)
"""Its frame has its origin at the middle of the round tip, the handle along -x, z up: the side away from the teeth."""

START = Start(
    centre_m=(-0.42, -0.40, 0.98),
    range_m=0.05,
    tool_axes=((0.5003, 0.8004, -0.3302), (-0.8480, 0.5300, 0.0), (0.1750, 0.2800, 0.9439)),
    posture_rad=(1.8157, 1.6510, -0.3733, 1.2735, -2.8111, 1.8111, 1.4327),
)

RAISED_ARM = ArmRange((10.0, 0.0, 0.0, -5.0), (35.0, 12.0, 20.0, 15.0))
"""The benchmark's person also raises the right arm, by 30 degrees."""

STROKES_NEEDED = 25
STROKE_LENGTH_M = 0.01
AT_ITCH_M = 0.025
"""As in the benchmark: so many strokes, counted after such a way, within so much of the itch."""
FELT_N = 0.3

BARE_SKIN = {UPPER_ARM: (0.62, 0.92), FOREARM: (0.12, 0.80)}
"""Shares of a limb's length, from its joint; the sleeve ends above the elbow."""
ROBOT_SIDE = (-0.62, -0.67, 0.41)
"""from the person's arm to where the robot comes from"""
SIDE_RANGE_RAD = 1.05


class Itch(NamedTuple):
    """A place on the skin in its limb's frame."""

    limb: str
    place_m: FloatArray
    outward: FloatArray


class Scratch:
    """Counts strokes as the benchmark does: the contact has moved by more than 1 cm since the last counted one.

    The skin itself must have been rubbed, so places are in the limb's frame. A touch must be felt (.3 N, the weight of
    a letter or two) and gentle (less than the benchmark's 10 N).
    """

    def __init__(self) -> None:
        self.strokes = 0
        self.last_m: FloatArray | None = None
        self.peak_force_n = 0.0
        self.progress_m = 0.0
        """towards the next stroke in this control step; less than 0 when the tip came back"""
        self._since_last_m = 0.0

    def rub(self, place_m: FloatArray | None, force_n: float) -> bool:
        """One control step: where the tip last touched the skin, if it did, and the mean force; a new stroke?"""
        self.peak_force_n = max(self.peak_force_n, force_n)
        self.progress_m = 0.0
        if place_m is None or not FELT_N <= force_n < HIGH_FORCE_N:
            return False
        moved = STROKE_LENGTH_M if self.last_m is None else math.dist(place_m, self.last_m)
        self.progress_m = min(moved, STROKE_LENGTH_M) - self._since_last_m
        counts = self.last_m is None or moved > STROKE_LENGTH_M
        self._since_last_m = 0.0 if counts else moved
        if counts:
            self.last_m = place_m
            self.strokes += 1
        return counts


class ScratchingEnv(AssistiveEnv):
    """Success: at least 25 strokes, the benchmark's number, and never 10 N or more at the itch in a control step.

    10 N is where the benchmark's high-force cost begins; here it also ends the hope of success, so that scratching has
    to be gentle and not only frequent. On this skin 10 N are a tip pushed in by 2 cm: a scripted robot that rubs 5 mm
    deep makes 20 to 40 strokes at 2.5 N, one that rubs 2 cm deep reaches 9 to 14 N. The shipped policy (mean force 1.9
    N, mean peak 4.3 N) succeeds in 99 % of scenarios; it would in 93 % with a limit of 6 N, 86 % with 5 N, 47 % with
    4 N. What is left between its force and the limit is for people who want it firmer.
    """

    task = SCRATCHING
    tool = SCRATCHER
    start = START
    right_arm = RAISED_ARM
    at_target_within_m = AT_ITCH_M

    def __init__(
        self,
        reward: Reward | None = None,
        bodies: Sequence[str] = BODIES,
        impairments: Sequence[Impairment] = ("none",),
    ) -> None:
        """See AssistiveEnv."""
        super().__init__(reward or self._gentle_rubbing, bodies, impairments)

    @property
    def success(self) -> bool:
        """Whether there have been enough strokes and none too hard."""
        return self._scratch.strokes >= STROKES_NEEDED and self._scratch.peak_force_n < HIGH_FORCE_N

    @property
    def arm_positions_rad(self) -> FloatArray:
        """(2, 4) the person's right arm as it has given way, and the left one."""
        return np.stack([self._arm.angles_rad(), self.person.arms_rad[human.LEFT]])

    def _new_world(self) -> Bullet:
        return Bullet(gravity_m_s2=0.0, forgetful=True)

    def _build(self) -> None:
        """Build the arm once. Removing a chain reverses the order of its links in the engine; twice restores it."""
        if self._world.littered:
            self._world.clear()
        if self._world.has(PERSON):
            self._world.remove(PERSON)
            add_placeholder(self._world)
            self._world.remove(PERSON)
        else:
            self.robot.add_to(self._world, self.tool)
        self._world.step()
        self._arm = YieldingArm(self._world, self.person)

    def _lay_out(self, rng: np.random.Generator) -> None:
        self._itch = self._draw_itch(rng)
        self._scratch = Scratch()
        self._touch_m: tuple[float, float, float] | None = None
        self._driven_from = self._command

    def _draw_itch(self, rng: np.random.Generator) -> Itch:
        limb = (UPPER_ARM, FOREARM)[rng.integers(2)]
        _, quaternion = self._world.link_pose(PERSON, limb)
        x, y, _ = np.array(ROBOT_SIDE) @ rotation_of(quaternion)
        angle = math.atan2(y, x) + rng.uniform(-SIDE_RANGE_RAD, SIDE_RANGE_RAD)
        outward = np.array([math.cos(angle), math.sin(angle), 0.0])
        along = -rng.uniform(*BARE_SKIN[limb]) * self._arm.length_m(limb)
        return Itch(limb, self._arm.radius_m(limb) * outward + [0.0, 0.0, along], outward)

    def _read_target(self) -> None:
        self._joint_m, quaternion = self._world.link_pose(PERSON, self._itch.limb)
        self._limb = rotation_of(quaternion)
        self._body_to_target = self._limb @ self._itch.place_m
        self._target = self._joint_m + self._body_to_target
        self._outward = self._limb @ self._itch.outward

    def _before_substep(self, share: float) -> None:
        if self.person.impairment == "tremor":
            self._arm.hold(1.0 if len(self._history) % 2 else -1.0)
            self._read_target()
        # A target that jumps once per control step would hammer on the skin ten times per second.
        driven_to = self._driven_from + share * (self._command - self._driven_from)
        self._world.drive_joints(ARM, driven_to, POSITION_GAIN, MOTOR_FORCE_NM)

    def _touched_target(self, contact: Contact) -> None:
        self._touch_m = contact.position_m

    def _outcome(self, motion: StepMotion) -> StepOutcome:
        touch, self._touch_m, self._driven_from = self._touch_m, None, self._command
        by_the_tip = touch is not None and math.dist(touch, self._tool) < 2 * TIP_RADIUS_M
        place = (np.array(touch) - self._joint_m) @ self._limb if by_the_tip else None
        return StepOutcome(strokes=int(self._scratch.rub(place, motion.force_at_target_n)))

    def _own_observation(self) -> dict[str, Any]:
        base, last = self.robot.mount_rotation, self._scratch.last_m
        since = np.zeros(3) if last is None else self._joint_m + self._limb @ last - self._tool
        return {
            "tip_to_last_stroke_m": since @ base,
            "limb_direction": -self._limb[:, 2] @ base,
            "strokes": [min(1.0, self._scratch.strokes / STROKES_NEEDED)],
        }

    def _gentle_rubbing(self, step: StepMeasures) -> float:
        """What the reference policy is trained for: rubbing pays, and from 1.5 N on pressing costs more and more."""
        change = step.action - step.previous_action
        too_hard = 0.06 * max(0.0, step.force_at_target_n - 1.5) ** 2 + 0.05 * step.force_away_n
        rubbed = 0.5 * step.outcome.strokes + self._scratch.progress_m / STROKE_LENGTH_M
        facing = 0.1 * min(0.5, float(step.outward @ step.tool_up))
        touching = 0.2 * min(1.0, step.force_at_target_n / 0.5)
        return _NEARBY(step) + touching + rubbed + facing - too_hard - 0.05 * float(change @ change)


_NEARBY = TaskReward(speed_per_m_s=0.0, force_per_n=0.0)
