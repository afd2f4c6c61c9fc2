"""How the spoon looks, in its own frame: origin at the centre of the bowl, x towards the tip, z up."""

import numpy as np

from worker.domain.type_aliases import FloatArray
from worker.sim.render.meshes.arm_mesh import Detail
from worker.sim.render.meshes.mesh import Mesh, curve, joined, tube


def spoon(detail: Detail) -> Mesh:
    """The whole spoon, with a coloured grip."""
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


def _sheet(grid: FloatArray, colour: float, upwards: bool) -> Mesh:
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
