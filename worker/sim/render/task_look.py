"""How each task is filmed: from where, what the inset shows, and what its particles look like.

A task that is not listed is filmed like Feeding, its particles as balls of its own size.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

from worker.sim.render.meshes.colours import FOOD, WATER
from worker.sim.render.meshes.head_mesh import CLOSED, EATING, SIPPING, Mouth
from worker.tasks.drinking.environment import pellet_radius_m
from worker.tasks.feeding.food import BALL_RADIUS_M

Point = tuple[float, float, float]


@dataclass(frozen=True)
class TaskLook:
    """The film of one task."""

    eye_m: Point
    target_m: Point
    field_of_view_deg: float
    inset_from: Point
    """from where the inset looks: in the head's frame (x to the person's left, the face along -y, z up); for an itch

    in shares of away from the robot, out of the skin, and up"""
    inset_span_m: float
    """height of what the inset shows"""
    inset_offset_m: Point = (0.0, 0.0, 0.0)
    """from the target to the middle of the inset, in the same frame"""
    inset_on_right: bool = False
    """whether the inset is in the right upper corner instead of the left one"""
    particle_colours: tuple[str, ...] = FOOD
    particle_radius_m: Callable[[int], float] = lambda count: BALL_RADIUS_M
    """of each when there are so many"""
    particle_scale: float = 1.2
    """how much larger they are drawn than simulated, so that pieces are seen and water holds together"""
    water: bool = False
    """whether the particles run together"""
    itch: bool = False
    """whether the target is marked as a red spot on the skin"""
    mouth: Mouth = EATING


# From the person's left front, so that the arm never hides the mouth.
FEEDING_LOOK = TaskLook(
    (0.86, -1.02, 1.50), (-0.20, -0.26, 1.115), 38.0, (0.62, -1.0, 0.12), 0.155, inset_offset_m=(-0.01, -0.03, 0.0)
)
LOOKS = {
    "feeding": FEEDING_LOOK,
    "drinking": replace(
        FEEDING_LOOK,
        inset_from=(1.0, -0.72, 0.10),
        inset_span_m=0.19,
        inset_offset_m=(0.0, -0.03, 0.02),
        particle_colours=WATER,
        particle_radius_m=pellet_radius_m,
        particle_scale=1.22,
        water=True,
        mouth=SIPPING,
    ),
    # From the person's right, where the itch is; the robot comes from the person's front.
    "scratching": TaskLook(
        (-1.62, -0.12, 1.58),
        (-0.22, -0.33, 0.96),
        38.0,
        (0.5, 0.85, 0.45),
        0.20,
        inset_on_right=True,
        itch=True,
        mouth=CLOSED,
    ),
}


def task_look(name: str) -> TaskLook:
    """The look of a task, known by name or not."""
    return LOOKS.get(name, FEEDING_LOOK)
