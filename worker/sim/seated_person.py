"""The seated person as bodies of the physics engine: trunk and legs that never move, a head, arms at rest."""

from worker.sim import human
from worker.sim.bullet import Bullet, Link
from worker.sim.geometry import Shape, capsule_between
from worker.sim.human import Person

PERSON, HEAD = "person", "head"


def add_person(world: Bullet, person: Person, *arms: int, head_apart: bool = False) -> None:
    """Add the seated person with the arms named (both by default) as an immovable body.

    The head is a link of it, for one body less makes a faster reset, unless it trembles or is wanted apart.
    """
    still = (*STILL_SHAPES[person.body.name], *arm_shapes(person, *(arms or (human.RIGHT, human.LEFT))))
    pivot, turn, head = person.body.neck_pivot_m, human.head_quaternion(person), HEAD_SHAPES[person.body.name]
    if head_apart or person.impairment == "tremor":
        world.add_body(PERSON, still)
        world.add_body(HEAD, head, pivot, turn)
    else:
        world.add_chain(PERSON, still, [Link(HEAD, pivot, turn, 0.0, head, "fixed")])


def arm_shapes(person: Person, *sides: int) -> tuple[Shape, ...]:
    """Collision shapes of the person's arms at rest, in the world."""
    limbs = (limb for side in sides for limb in human.arm_limbs(person.body, person.arms_rad[side], side))
    return tuple(capsule_between(*limb[1:]) for limb in limbs)


STILL_SHAPES = {
    body.name: tuple(capsule_between(*limb[1:]) for limb in (*body.trunk, *body.legs))
    for body in human.BODY_SHAPES.values()
}
HEAD_SHAPES = {
    body.name: tuple(Shape("sphere", ball.radius_m, position_m=ball.centre_m) for ball in body.head)
    for body in human.BODY_SHAPES.values()
}
