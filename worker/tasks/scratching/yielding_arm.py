"""The person's right arm as a passive chain: it gives way to what pushes it and comes back.

Three shoulder joints and the elbow are held by damped springs, and the skin is soft. The benchmark holds such joints by
motors of at most 1 N m, which here behaved like dry friction: at 2 N nothing moves, at 5 N the arm runs away. Springs
give way in proportion, so that one sees how hard the tool presses. There must be no gravity in a world with such an
arm, for the springs do not carry its weight.
"""

import math
from functools import cache

import numpy as np

from worker.domain.type_aliases import FloatArray
from worker.sim import human
from worker.sim.bullet import Bullet, Link
from worker.sim.geometry import IDENTITY, Shape, capsule_between, compose
from worker.sim.human import BODY_SHAPES, Person
from worker.sim.seated_person import HEAD_SHAPES, PERSON, STILL_SHAPES, arm_shapes

UPPER_ARM, FOREARM = "right_upper_arm", "right_forearm"
UPPER_ARM_MASS_KG, FOREARM_MASS_KG, JOINT_MASS_KG = 2.1, 1.7, 0.05
STIFFNESS_NM_RAD, DAMPING_NM_S_RAD, TORQUE_NM = 15.0, 1.2, 6.0
"""2 N across the wrist move it by 1 to 2.5 cm; it is back after half a second."""
SKIN_STIFFNESS_N_M, SKIN_DAMPING_N_S_M = 600.0, 30.0


class YieldingArm:
    """The right arm of a person who sits in a world."""

    def __init__(self, world: Bullet, person: Person) -> None:
        """Add the person, all in one body; only the right arm can move."""
        self._world, self._person = world, person
        world.add_chain(PERSON, _still_shapes(person), _links(person.body.name))
        for limb in (UPPER_ARM, FOREARM):
            world.soften(PERSON, limb, SKIN_STIFFNESS_N_M, SKIN_DAMPING_N_S_M)
        rest = _in_chain_order(person.arms_rad[human.RIGHT])
        world.set_joints(PERSON, rest)
        world.release_joints(PERSON, len(rest))
        self.hold(0.0)

    def hold(self, tremor: float) -> None:
        """Let the springs rest where the arm is at this moment of its tremor, in [-1, 1]."""
        person = self._person
        rest = person.arms_rad[human.RIGHT] + tremor * np.array(person.arm_tremor_rad)
        strength = person.strength
        damping = math.sqrt(strength) * DAMPING_NM_S_RAD
        self._world.spring_joints(
            PERSON, _in_chain_order(rest), strength * STIFFNESS_NM_RAD, damping, strength * TORQUE_NM
        )

    def length_m(self, limb: str) -> float:
        """Of UPPER_ARM or FOREARM."""
        body = self._person.body
        return body.upper_arm_length_m if limb == UPPER_ARM else body.forearm_length_m

    def radius_m(self, limb: str) -> float:
        """Of UPPER_ARM or FOREARM."""
        body = self._person.body
        return body.upper_arm_radius_m if limb == UPPER_ARM else body.forearm_radius_m

    def angles_rad(self) -> FloatArray:
        """(4,) in the order of human.ARM_JOINTS."""
        abduction, flexion, rotation, elbow = self._world.joints(PERSON, len(human.ARM_JOINTS))
        return np.array([flexion, abduction, rotation, elbow])


def add_placeholder(world: Bullet) -> None:
    """Add a chain of as many links in the person's stead."""
    speck = (Shape("sphere", 0.001),)
    still, moving = Link("", (0, 0, 0), IDENTITY, 0.1, ()), Link("", (0, 0, 0), IDENTITY, 0.1, speck)
    world.add_chain(PERSON, speck, (still, still, moving, moving))


def _in_chain_order(arm_rad: FloatArray) -> list[float]:
    flexion, abduction, rotation, elbow = arm_rad.tolist()
    return [abduction, flexion, rotation, elbow]


def _still_shapes(person: Person) -> tuple[Shape, ...]:
    pivot, turn = person.body.neck_pivot_m, human.head_quaternion(person)
    head = tuple(
        Shape("sphere", ball.radius_m, position_m=compose(pivot, turn, ball.position_m, IDENTITY)[0])
        for ball in HEAD_SHAPES[person.body.name]
    )
    return (*STILL_SHAPES[person.body.name], *arm_shapes(person, human.LEFT), *head)


@cache
def _links(body_name: str) -> tuple[Link, ...]:
    """Joints turn in the order of human.upper_arm_rotation; bones run along their frames' -z."""
    body = BODY_SHAPES[body_name]
    x, y, z = body.shoulder_m
    elbow, wrist = (0.0, 0.0, -body.upper_arm_length_m), (0.0, 0.0, -body.forearm_length_m)
    hand = (0.0, 0.0, wrist[2] - body.hand_length_m)
    upper = (capsule_between((0, 0, 0), elbow, body.upper_arm_radius_m),)
    fore = (capsule_between((0, 0, 0), wrist, body.forearm_radius_m), capsule_between(wrist, hand, body.hand_radius_m))
    return (
        Link("abduction", (-x, y, z), IDENTITY, JOINT_MASS_KG, (), axis=(0, 1, 0)),
        Link("flexion", (0, 0, 0), IDENTITY, JOINT_MASS_KG, (), axis=(-1, 0, 0)),
        Link(UPPER_ARM, (0, 0, 0), IDENTITY, UPPER_ARM_MASS_KG, upper, centre_of_mass_m=(0, 0, elbow[2] / 2)),
        Link(FOREARM, elbow, IDENTITY, FOREARM_MASS_KG, fore, axis=(-1, 0, 0), centre_of_mass_m=(0, 0, hand[2] / 2)),
    )
