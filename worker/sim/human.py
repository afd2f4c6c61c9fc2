"""The seated person: two body shapes, where their parts are, and who sits there in a scenario.

Collision and pictures share these numbers. World frame, metres: z up, the person faces -y, the person's left is +x, the
floor is z = 0. Sizes follow the benchmark's male and female adults (facts sheet of Assistive Gym v1.0), simplified to
capsules and spheres.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from worker.domain.trajectory import BODIES, SKIN_TONES
from worker.domain.type_aliases import FloatArray
from worker.sim.geometry import quaternion_of_euler

Point = tuple[float, float, float]
Impairment = Literal["none", "tremor", "weakness", "limits"]
IMPAIRMENTS: tuple[Impairment, ...] = ("none", "tremor", "weakness", "limits")

FACE_IN_HEAD: Point = (0.0, -1.0, 0.0)
"""Unit vector out of the face in the head's frame."""
HEAD_RANGE_DEG = 30.0
"""The head is held at a random Euler angle of up to this much about each axis."""


class Limb(NamedTuple):
    """A capsule from start to end."""

    name: str
    start_m: Point
    end_m: Point
    radius_m: float


class Ball(NamedTuple):
    """A sphere in the head's frame."""

    name: str
    centre_m: Point
    radius_m: float


@dataclass(frozen=True)
class BodyShape:
    """The sizes of one body. Trunk and legs are in the world frame, the head's balls in the head's."""

    name: str
    neck_pivot_m: Point
    """the head turns about this point"""
    mouth_from_neck_m: Point
    """centre of the mouth in the head's frame"""
    head_scale: float
    """size of the head relative to the broad body's"""
    shoulder_m: Point
    """of the left arm; the right one is its mirror image"""
    upper_arm_length_m: float
    forearm_length_m: float
    hand_length_m: float
    """from the wrist to the middle of the hand"""
    upper_arm_radius_m: float
    forearm_radius_m: float
    hand_radius_m: float
    trunk: tuple[Limb, ...]
    legs: tuple[Limb, ...]
    head: tuple[Ball, ...]
    """spheres with a gap at the mouth, so that a tool can enter"""


_LEGS = (
    Limb("right_thigh", (-0.09, 0.05, 0.53), (-0.11, -0.40, 0.53), 0.072),
    Limb("left_thigh", (0.09, 0.05, 0.53), (0.11, -0.40, 0.53), 0.072),
)

BROAD = BodyShape(
    name="broad",
    neck_pivot_m=(0.0, 0.03, 1.15),
    mouth_from_neck_m=(0.0, -0.095, 0.05),
    head_scale=1.0,
    shoulder_m=(0.20, 0.05, 1.00),
    upper_arm_length_m=0.28,
    forearm_length_m=0.25,
    hand_length_m=0.07,
    upper_arm_radius_m=0.045,
    forearm_radius_m=0.036,
    hand_radius_m=0.040,
    trunk=(
        Limb("torso", (0.0, 0.06, 0.67), (0.0, 0.06, 0.97), 0.12),
        Limb("shoulders", (-0.12, 0.06, 1.00), (0.12, 0.06, 1.00), 0.085),
        Limb("neck", (0.0, 0.05, 1.08), (0.0, 0.05, 1.16), 0.05),
    ),
    legs=_LEGS,
    head=(Ball("skull", (0.0, -0.01, 0.125), 0.088), Ball("chin", (0.0, -0.058, 0.0), 0.030)),
)

SLIM = BodyShape(
    name="slim",
    neck_pivot_m=(0.0, 0.03, 1.09),
    mouth_from_neck_m=(0.0, -0.089, 0.046),
    head_scale=0.93,
    shoulder_m=(0.175, 0.05, 0.968),
    upper_arm_length_m=0.262,
    forearm_length_m=0.234,
    hand_length_m=0.064,
    upper_arm_radius_m=0.037,
    forearm_radius_m=0.029,
    hand_radius_m=0.034,
    trunk=(
        Limb("torso", (0.0, 0.06, 0.67), (0.0, 0.06, 0.93), 0.105),
        Limb("shoulders", (-0.11, 0.06, 0.965), (0.11, 0.06, 0.965), 0.068),
        Limb("neck", (0.0, 0.05, 1.03), (0.0, 0.05, 1.10), 0.042),
    ),
    legs=_LEGS,
    head=(Ball("skull", (0.0, -0.01, 0.116), 0.082), Ball("chin", (0.0, -0.054, 0.0), 0.028)),
)

BODY_SHAPES = {body.name: body for body in (BROAD, SLIM)}

ARM_JOINTS = ("shoulder_flexion", "shoulder_abduction", "shoulder_rotation", "elbow_flexion")
RIGHT, LEFT = 0, 1


class ArmRange(NamedTuple):
    """Where a resting arm may be, in degrees, in the order of ARM_JOINTS; the elbow counts from a level forearm."""

    low_deg: tuple[float, float, float, float]
    high_deg: tuple[float, float, float, float]


ARMREST = ArmRange((0.0, 0.0, 0.0, 0.0), (12.0, 8.0, 22.0, 8.0))


@dataclass(frozen=True)
class Person:
    """Who sits in the chair during one scenario."""

    body: BodyShape
    skin_tone: int
    head_euler_rad: tuple[float, float, float]
    arms_rad: FloatArray
    """(2, 4) right and left arm at rest, in the order of ARM_JOINTS"""
    impairment: Impairment
    strength: float
    """share of the normal force with which joints are held; below 1 for weakness"""
    head_tremor_rad: tuple[float, float, float]
    arm_tremor_rad: tuple[float, float, float, float]
    """of the right arm"""


def draw_person(
    rng: np.random.Generator,
    bodies: Sequence[str] = BODIES,
    impairments: Sequence[Impairment] = ("none",),
    head_range_deg: float = HEAD_RANGE_DEG,
    right_arm: ArmRange = ARMREST,
) -> Person:
    """A random person. The same draws are made whatever the options, so that an option changes nothing else.

    The impairments' ranges are the benchmark's. Limits: range of motion scaled by U(.5, 1). Weakness: strength
    U(.25, 1). Tremor: up to 20 degrees at the head and 10 at the arm, to alternate sides in every control step.
    """
    body, tone, impaired = rng.random(3)
    head, arms, tremor = rng.uniform(-1, 1, 3), rng.random((2, 4)), rng.uniform(-1, 1, 7)
    narrowing, strength = rng.uniform(0.5, 1.0), rng.uniform(0.25, 1.0)
    impairment = impairments[int(impaired * len(impairments))]
    reach = narrowing if impairment == "limits" else 1.0
    shaking = np.radians(tremor) if impairment == "tremor" else np.zeros(7)
    ranges = (right_arm, ARMREST)
    return Person(
        body=BODY_SHAPES[bodies[int(body * len(bodies))]],
        skin_tone=int(tone * SKIN_TONES),
        head_euler_rad=_three(np.radians(head_range_deg) * reach * head),
        arms_rad=np.array([_arm_rad(each, reach * share) for each, share in zip(ranges, arms, strict=True)]),
        impairment=impairment,
        strength=strength if impairment == "weakness" else 1.0,
        head_tremor_rad=_three(20.0 * shaking[:3]),
        arm_tremor_rad=(*_three(10.0 * shaking[3:6]), float(10.0 * shaking[6])),
    )


def _three(values: FloatArray) -> Point:
    return float(values[0]), float(values[1]), float(values[2])


def _arm_rad(within: ArmRange, share: FloatArray) -> FloatArray:
    degrees = np.array(within.low_deg) + share * (np.array(within.high_deg) - within.low_deg)
    degrees[3] += 90.0 - degrees[0]  # a forearm at elbow 0 is level, however far the upper arm points forward
    return np.radians(degrees)


def head_quaternion(person: Person, tremor: float = 0.0) -> tuple[float, float, float, float]:
    """xyzw in the world; ``tremor`` in [-1, 1] is where within its tremor the head is."""
    euler = np.array(person.head_euler_rad) + tremor * np.array(person.head_tremor_rad)
    return quaternion_of_euler(euler)


def upper_arm_rotation(arm_rad: FloatArray, side: int) -> FloatArray:
    """(3, 3) of the upper arm, whose bone runs along its -z, in the world. ``side`` is RIGHT or LEFT."""
    flexion, abduction, rotation, _ = arm_rad
    outwards = 1.0 if side == RIGHT else -1.0
    return _about_y(outwards * abduction) @ _about_x(-flexion) @ _about_z(outwards * rotation)


def forearm_rotation(arm_rad: FloatArray, side: int) -> FloatArray:
    """(3, 3) of the forearm, whose bone runs along its -z, in the world."""
    turned: FloatArray = upper_arm_rotation(arm_rad, side) @ _about_x(-arm_rad[3])
    return turned


def arm_points_m(body: BodyShape, arm_rad: FloatArray, side: int) -> FloatArray:
    """(4, 3) shoulder, elbow, wrist and middle of the hand in the world."""
    return np.array(_arm_points(body, arm_rad, side))


def arm_limbs(body: BodyShape, arm_rad: FloatArray, side: int) -> tuple[Limb, Limb, Limb]:
    """Upper arm, forearm and hand as capsules in the world."""
    shoulder, elbow, wrist, hand = _arm_points(body, arm_rad, side)
    name = ("right", "left")[side]
    return (
        Limb(f"{name}_upper_arm", shoulder, elbow, body.upper_arm_radius_m),
        Limb(f"{name}_forearm", elbow, wrist, body.forearm_radius_m),
        Limb(f"{name}_hand", wrist, hand, body.hand_radius_m),
    )


def _arm_points(body: BodyShape, arm_rad: FloatArray, side: int) -> tuple[Point, Point, Point, Point]:
    """Written out for speed: minus the third columns of upper_arm_rotation and forearm_rotation are the bones."""
    flexion, abduction, rotation, elbow_flexion = arm_rad.tolist()
    right = side == RIGHT
    sin_f, cos_f = math.sin(flexion), math.cos(flexion)
    sin_a, cos_a = math.sin(abduction if right else -abduction), math.cos(abduction)
    sin_r, cos_r = math.sin(rotation if right else -rotation), math.cos(rotation)
    sin_e, cos_e = math.sin(elbow_flexion), math.cos(elbow_flexion)
    upper = (-cos_f * sin_a, -sin_f, -cos_f * cos_a)
    # The forearm before the shoulder's abduction ...
    x, y, z = sin_r * sin_e, -cos_r * sin_e * cos_f - cos_e * sin_f, cos_r * sin_e * sin_f - cos_e * cos_f
    # ... and after it.
    forearm = (cos_a * x + sin_a * z, y, -sin_a * x + cos_a * z)
    shoulder = (-body.shoulder_m[0] if right else body.shoulder_m[0], body.shoulder_m[1], body.shoulder_m[2])
    elbow = _further(shoulder, upper, body.upper_arm_length_m)
    wrist = _further(elbow, forearm, body.forearm_length_m)
    return shoulder, elbow, wrist, _further(wrist, forearm, body.hand_length_m)


def _further(start_m: Point, direction: Point, length_m: float) -> Point:
    return (
        start_m[0] + length_m * direction[0],
        start_m[1] + length_m * direction[1],
        start_m[2] + length_m * direction[2],
    )


def _about_x(angle: float) -> FloatArray:
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.array([[1, 0, 0], [0, cosine, -sine], [0, sine, cosine]])


def _about_y(angle: float) -> FloatArray:
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.array([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]])


def _about_z(angle: float) -> FloatArray:
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])
