"""How tools look, in the tool's frame: a spoon, a cup of glass, a back scratcher, or just the collision shapes."""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from worker.sim.arm import Tool
from worker.sim.geometry import Shape, rotation_of
from worker.sim.render.meshes.arm_mesh import Detail, Grip
from worker.sim.render.meshes.distance_fields import Array, box, smooth_step
from worker.sim.render.meshes.mesh import Mesh, curve, joined, surface, tube
from worker.tasks.drinking.environment import CUP_BASE_RADIUS_M, CUP_HEIGHT_M, CUP_RIM_RADIUS_M, HELD_BEFORE_HAND_M
from worker.tasks.scratching.environment import SCRATCHER_LENGTH_M, TIP_RADIUS_M

CUP_OUTSIDE_M = 0.0040
"""Thickness of the drawn glass."""
CUP_GRIP = Grip((CUP_BASE_RADIUS_M + CUP_RIM_RADIUS_M) / 2 + CUP_OUTSIDE_M, 0.018, HELD_BEFORE_HAND_M)
CUP_CENTRE_M = (-CUP_RIM_RADIUS_M, 0.0, 0.0)
"""The middle of the rim: the tool's origin is the point of the rim that is drunk from."""


class ToolLook(NamedTuple):
    """How one tool is drawn and held."""

    solid: Callable[[Detail], Mesh]
    grip: Grip
    glass: Callable[[Detail], Mesh] | None = None
    """what one sees through; only for tools that carry water"""


def tool_look(tool: Tool) -> ToolLook:
    """The designed look of a tool known by name, otherwise its collision shapes."""
    designed = _DESIGNED.get(tool.name)
    return designed or ToolLook(lambda detail: plain(detail, tool.shapes), Grip(0.006))


def spoon(detail: Detail) -> Mesh:
    """A spoon with a coloured grip: origin at the centre of the bowl, x towards the tip, z up."""
    bowl = _bowl(detail)
    line = curve(
        [
            (-0.022, 0, 0.0075),
            (-0.042, 0, 0.0120),
            (-0.070, 0, 0.0100),
            (-0.100, 0, 0.0045),
            (-0.130, 0, 0.0000),
            (-0.165, 0, -0.0030),
            (-0.195, 0, -0.0035),
        ],
        max(9, detail.sides + 2),
    )
    place = np.linspace(0, 1, len(line))
    grip = place > 0.36
    width = np.where(grip, np.interp(place, [0.36, 0.46, 0.8, 0.97, 1.0], [0.0042, 0.0062, 0.0075, 0.0062, 0.003]), 0)
    width = np.where(grip, width, np.interp(place, [0.0, 0.12, 0.36], [0.0065, 0.0036, 0.0034]))
    thickness = np.where(grip, width * 0.78, 0.0022)
    metal, soft = detail.at("spoon", 0.2), detail.at("grip")
    colours = np.where(grip[1:], soft, metal)
    return joined(bowl, tube(line, np.column_stack([width, thickness]), max(6, detail.sides // 2), colours))


def _bowl(detail: Detail) -> Mesh:
    """A roomy bowl, drawn on both sides; the collision shape is a box of the same size."""
    rings, sides = max(3, detail.sides // 3), max(10, detail.sides + 4)
    depth, rim = 0.0125, 0.0085
    angle = np.linspace(0, 2 * np.pi, sides, endpoint=False)
    shares = np.linspace(0.0, 1.0, rings + 1)
    # A superellipse: nearly as roomy as the box that holds the food in the simulation.
    cosine, sine = np.cos(angle), np.sin(angle)
    outline_x = 0.0278 * np.sign(cosine) * np.abs(cosine) ** 0.66 + 0.0005
    outline_y = 0.0212 * np.sign(sine) * np.abs(sine) ** 0.66 * (1.0 - 0.05 * cosine)
    grid = np.stack(
        [
            shares[:, None] * outline_x,
            shares[:, None] * outline_y,
            np.broadcast_to((rim - depth * (1 - shares[:, None] ** 4.5)), (rings + 1, sides)),
        ],
        axis=-1,
    )
    inside = _sheet(grid, detail.at("spoon", 0.5), upwards=True)
    outside = _sheet(grid - np.array([0, 0, 0.0016]), detail.at("spoon", 0.9), upwards=False)
    edge = tube(
        np.concatenate([grid[-1], grid[-1, :1]]), np.full(sides + 1, 0.0013), 6, np.full(sides, detail.at("spoon"))
    )
    return joined(inside, outside, edge)


def _sheet(grid: Array, colour: float, upwards: bool) -> Mesh:
    """A surface from rings (R, S, 3) around a centre, seen from above or from below."""
    around = np.roll(grid, -1, axis=1) - np.roll(grid, 1, axis=1)
    outwards = np.gradient(grid, axis=0)
    normals = np.cross(outwards, around)
    normals[0] = [0, 0, 1.0]
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
    rings, sides = grid.shape[:2]
    start = np.arange(rings - 1)[:, None] * sides
    here, after = np.arange(sides), (np.arange(sides) + 1) % sides
    a, b = (start + here).ravel(), (start + after).ravel()
    faces = np.concatenate([np.stack([a, a + sides, b + sides], 1), np.stack([a, b + sides, b], 1)])
    if not upwards:
        faces, normals = faces[:, ::-1], -normals
    count = rings * sides
    paint = np.column_stack([np.full(count, colour), np.ones(count)])
    return Mesh(grid.reshape(-1, 3), normals.reshape(-1, 3), paint, faces.astype(np.int32))


def _wall(detail: Detail, heights: Array, radii: Array, colours: Array, inwards: bool = False) -> Mesh:
    """A wall turned about z that is seen from one side only (R rings; colours (R - 1,))."""
    path = heights[:, None] * np.array([0.0, 0.0, 1.0])
    mesh = tube(path, radii, 2 * detail.sides - 8, colours, closed_ends=False)
    return Mesh(mesh.vertices, -mesh.normals, mesh.paint, mesh.faces[:, ::-1]) if inwards else mesh


NOSE_CUT_M = 0.034
"""How deep the rim is cut out opposite to where it is drunk from, as in cups for people who cannot tip their head back:

the nose has room, and the face stays in sight. The simulated wall is whole; water never reaches it there.
"""


def _cut_out(mesh: Mesh) -> Mesh:
    """A cup's part, around the z axis and drunk from at +x, with room for the nose at -x."""
    x, y, z = mesh.vertices.T
    side = -x / np.maximum(np.hypot(x, y), 1e-9)
    above = np.clip(1 + z / CUP_HEIGHT_M, 0.0, 1.0)
    lowered = z - above * NOSE_CUT_M * smooth_step(side, 0.0, 0.85)
    narrowed = _cup_radius_m(lowered) / _cup_radius_m(z)
    return replace(mesh, vertices=np.column_stack([x * narrowed, y * narrowed, lowered]))


def _cup_radius_m(height_m: Array) -> Array:
    """Of the wall at heights (N,) from -CUP_HEIGHT_M at the bottom to 0 at the rim."""
    return np.asarray(CUP_RIM_RADIUS_M + (CUP_RIM_RADIUS_M - CUP_BASE_RADIUS_M) * height_m / CUP_HEIGHT_M)


def cup(detail: Detail) -> Mesh:
    """The opaque part of a glass: its edges, and the far inner wall (the near one faces away and is not drawn)."""
    base, rim, height, wall = CUP_BASE_RADIUS_M, CUP_RIM_RADIUS_M, CUP_HEIGHT_M, CUP_OUTSIDE_M
    edge = detail.at("glass_rim")
    heights, radii = np.array([-height, -height / 2, 0.0]), np.array([base, (base + rim) / 2, rim])
    inside = _wall(detail, heights, radii, np.full(2, detail.at("glass", 0.6)), inwards=True)
    rings = [_ring(detail, rim + wall / 2, 0.0, 0.0019, edge), _ring(detail, base + wall, -height - wall, 0.0019, edge)]
    return _cut_out(joined(inside, *rings)).moved(np.eye(3), CUP_CENTRE_M)


def cup_glass(detail: Detail) -> Mesh:
    """The outer wall and the bottom, through which one sees the water."""
    below = -CUP_HEIGHT_M - CUP_OUTSIDE_M
    heights = np.array([below, below, -0.0005])
    radii = np.array([0.0005, CUP_BASE_RADIUS_M + CUP_OUTSIDE_M, CUP_RIM_RADIUS_M + CUP_OUTSIDE_M])
    colours = np.array([detail.at("glass", 0.0), detail.at("glass", 0.2)])
    return _cut_out(_wall(detail, heights, radii, colours)).moved(np.eye(3), CUP_CENTRE_M)


def _ring(detail: Detail, radius: float, height: float, thick: float, colour: float) -> Mesh:
    angle = np.linspace(0.0, 2 * np.pi, 2 * detail.sides - 7)
    circle = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(len(angle), height)], axis=1)
    return tube(circle, np.full(len(circle), thick), 6, np.full(len(circle) - 1, colour), closed_ends=False)


def scratcher(detail: Detail) -> Mesh:
    """A wooden stick with a soft grip and a little rake, whose round teeth end where the simulated ball touches."""
    end, up = -SCRATCHER_LENGTH_M, 0.006
    line = curve([(-0.016, 0, 0.009), (-0.034, 0, 0.011), (-0.07, 0, up), (-0.13, 0, up), (end, 0, up)], 13)
    place = np.linspace(0, 1, len(line))
    grip = place > 0.48
    width = np.where(grip, np.interp(place, [0.48, 0.56, 0.9, 1.0], [0.0046, 0.0062, 0.0066, 0.0036]), 0.0040)
    colours = np.where(grip[1:], detail.at("grip"), detail.at("bamboo", 0.3))
    parts = [tube(line, np.column_stack([1.15 * width, width]), max(6, detail.sides // 2), colours)]
    for y in (-0.0126, -0.0042, 0.0042, 0.0126):
        tip = (0.0035, y, -0.75 * TIP_RADIUS_M + 6.0 * y * y)
        bend = [(-0.024, 0.4 * y, 0.0105), (-0.008, 0.9 * y, 0.0095), (0.0025, y, 0.0035), tip]
        thick = np.array([0.0034, 0.0034, 0.0033, 0.0032, 0.0030, 0.0028, 0.0024])
        parts.append(tube(curve(bend, 7), thick, 6, np.full(6, detail.at("bamboo"))))
    return joined(*parts)


def plain(detail: Detail, shapes: tuple[Shape, ...]) -> Mesh:
    """A tool nobody has designed a look for: its boxes, capsules and balls."""
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


_DESIGNED = {
    "spoon": ToolLook(spoon, Grip(0.0043)),
    "cup": ToolLook(cup, CUP_GRIP, cup_glass),
    "scratcher": ToolLook(scratcher, Grip(0.0043)),
}
