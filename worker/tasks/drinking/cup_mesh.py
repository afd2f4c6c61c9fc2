"""How the cup looks, in its own frame: a glass in an opaque and a transparent part."""

from dataclasses import replace

import numpy as np

from worker.domain.type_aliases import FloatArray
from worker.sim.render.meshes.arm_mesh import Detail, Grip
from worker.sim.render.meshes.distance_fields import smooth_step
from worker.sim.render.meshes.mesh import Mesh, joined, tube
from worker.tasks.drinking.environment import CUP_BASE_RADIUS_M, CUP_HEIGHT_M, CUP_RIM_RADIUS_M, HELD_BEFORE_HAND_M

CUP_OUTSIDE_M = 0.0040
"""Thickness of the drawn glass."""
CUP_GRIP = Grip((CUP_BASE_RADIUS_M + CUP_RIM_RADIUS_M) / 2 + CUP_OUTSIDE_M, 0.018, HELD_BEFORE_HAND_M)
CUP_CENTRE_M = (-CUP_RIM_RADIUS_M, 0.0, 0.0)
"""The middle of the rim: the tool's origin is the point of the rim that is drunk from."""


def _wall(detail: Detail, heights: FloatArray, radii: FloatArray, colours: FloatArray, inwards: bool = False) -> Mesh:
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


def _cup_radius_m(height_m: FloatArray) -> FloatArray:
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
