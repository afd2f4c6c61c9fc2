"""How a tool looks, in the tool's frame: as its task draws it, or just the collision shapes."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from worker.sim.geometry import Shape, rotation_of
from worker.sim.render.meshes.arm_mesh import Detail, Grip
from worker.sim.render.meshes.distance_fields import box
from worker.sim.render.meshes.mesh import Mesh, joined, surface, tube


class ToolLook(NamedTuple):
    """How one tool is drawn and held."""

    solid: Callable[[Detail], Mesh]
    grip: Grip
    glass: Callable[[Detail], Mesh] | None = None
    """what one sees through; only for tools that carry water"""


def plain_look(shapes: tuple[Shape, ...]) -> ToolLook:
    """A tool nobody has designed a look for: its collision shapes, held as a thin handle is."""
    return ToolLook(lambda detail: plain(detail, shapes), Grip(0.006))


def plain(detail: Detail, shapes: tuple[Shape, ...]) -> Mesh:
    """Boxes, capsules and balls."""
    turns = [rotation_of(shape.quaternion) for shape in shapes]
    placed = zip(shapes, turns, strict=True)
    return joined(*(_plain_shape(detail, shape).moved(turn, shape.position_m) for shape, turn in placed))


def _plain_shape(detail: Detail, shape: Shape) -> Mesh:
    colour = detail.at("tool")
    if shape.kind == "box":
        rounding = 0.3 * min(shape.half_extents_m)
        margin = np.array(shape.half_extents_m) + 0.004
        solid = box((0, 0, 0), shape.half_extents_m, rounding)
        return surface(solid, (-margin).tolist(), margin.tolist(), 0.003, colour)
    half, radius = shape.length_m / 2, shape.radius_m
    turn = np.radians([-86, -60, -30, 0, 30, 60, 86])
    heights = radius * np.sin(turn) + np.where(turn > 0, half, -half)
    heights, around = np.insert(heights, 4, half), np.insert(radius * np.cos(turn), 4, radius)
    return tube(heights[:, None] * np.array([0.0, 0.0, 1.0]), around, detail.sides, np.full(len(heights) - 1, colour))
