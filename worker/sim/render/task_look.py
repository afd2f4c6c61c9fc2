"""How a task is filmed: from where, what the inset shows, and what tool and particles look like.

What a task says nothing about suits whatever a robot brings to a mouth.
"""

from collections.abc import Callable
from dataclasses import dataclass

from worker.sim.render.meshes.colours import FOOD
from worker.sim.render.meshes.head_mesh import EATING, Mouth
from worker.sim.render.meshes.tool_mesh import ToolLook

Point = tuple[float, float, float]


@dataclass(frozen=True)
class TaskLook:
    """The film of one task."""

    eye_m: Point = (0.86, -1.02, 1.50)
    """from the person's left front, so that the arm never hides the mouth"""
    target_m: Point = (-0.20, -0.26, 1.115)
    field_of_view_deg: float = 38.0
    inset_from: Point = (0.62, -1.0, 0.12)
    """from where the inset looks: in the head's frame (x to the person's left, the face along -y, z up); for an itch

    in shares of away from the robot, out of the skin, and up"""
    inset_span_m: float = 0.155
    """height of what the inset shows"""
    inset_offset_m: Point = (-0.01, -0.03, 0.0)
    """from the target to the middle of the inset, in the same frame"""
    inset_on_right: bool = False
    """whether the inset is in the right upper corner instead of the left one"""
    particle_colours: tuple[str, ...] = FOOD
    particle_radius_m: Callable[[int], float] = lambda count: 0.006
    """of each when there are so many"""
    particle_scale: float = 1.2
    """how much larger they are drawn than simulated, so that pieces are seen and water holds together"""
    water: bool = False
    """whether the particles run together"""
    itch: bool = False
    """whether the target is marked as a red spot on the skin"""
    mouth: Mouth = EATING
    tool: ToolLook | None = None
    """None: drawn from its collision shapes"""
