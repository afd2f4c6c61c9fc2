"""How the Jaco arm, its hand and the spoon look: smooth dark links with light rings, drawn in the frames of jaco.py."""

from dataclasses import dataclass

import numpy as np

from worker.sim import jaco
from worker.sim.colours import Palette
from worker.sim.meshes import Mesh, curve, joined, surface, tube, turned
from worker.sim.solids import Array, ellipsoid


@dataclass(frozen=True)
class Detail:
    """The palette and how many sides round things have."""

    palette: Palette
    sides: int = 16

    @property
    def finger_sides(self) -> int:
        return self.sides // 2

    def at(self, name: str, share: float = 0.0) -> float:
        return self.palette.at(name, share)


UPWARDS = np.array([0.0, 0.0, 1.0])


def arm_meshes(detail: Detail) -> dict[str, Mesh]:
    """One mesh per moving link, in the link's own frame; the last one is the spoon."""
    return {
        "link_1": joined(
            _limb(detail, np.zeros(3), np.array([0.0, 0.0, -0.118]), 0.045, 0.044),
        ),
        "link_2": joined(
            _drum(detail, 0.047, 0.051),
            _limb(detail, np.zeros(3), np.array([0.0, -0.203, 0.0]), 0.043, 0.040, ring=False),
        ),
        "link_3": _limb(detail, np.zeros(3), np.array([0.0, 0.0, -0.205]), 0.040, 0.038),
        "link_4": joined(
            _drum(detail, 0.042, 0.046),
            _limb(detail, np.zeros(3), np.array([0.0, 0.2060, -0.0114]), 0.038, 0.033, ring=False),
        ),
        "link_5": _limb(detail, np.zeros(3), np.array([0.0, 0.0, -0.10375]), 0.033, 0.032),
        "link_6": joined(
            _drum(detail, 0.036, 0.039),
            _limb(detail, np.zeros(3), np.array([0.0, 0.1020, 0.0]), 0.033, 0.032, ring=False),
        ),
        "link_7": joined(_palm(detail), *_fingers(detail)),
        "spoon": spoon(detail),
    }


def base_mesh(detail: Detail) -> Mesh:
    """The fixed base of the arm in its own frame, with the stand down to the floor."""
    floor = -jaco.ROBOT_BASE_M[2]
    heights = [
        floor,
        floor + 0.02,
        floor + 0.03,
        floor + 0.03,
        -0.03,
        -0.03,
        -0.005,
        0.0,
        0.0,
        0.012,
        0.135,
        0.15,
        0.154,
    ]
    radii = [0.17, 0.17, 0.16, 0.040, 0.036, 0.085, 0.085, 0.08, 0.066, 0.058, 0.049, 0.047, 0.044]
    names = ["metal"] * 4 + ["metal"] * 3 + ["metal", "arm", "arm", "arm", "arm"]
    return _turned_profile(detail, heights, radii, names)


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
            np.broadcast_to((rim - depth * (1 - shares[:, None] ** 3.0)), (rings + 1, sides)),
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


def _limb(detail: Detail, start: Array, end: Array, start_radius: float, end_radius: float, ring: bool = True) -> Mesh:
    """A link along a line; a light ring marks the start of links that roll about their own length."""
    length = float(np.linalg.norm(end - start))
    ahead = (end - start) / length
    waist = min(start_radius, end_radius) * 0.94
    stops = (
        [
            (0.000, start_radius * 0.99, "ring"),
            (0.002, start_radius * 1.07, "ring"),
            (0.014, start_radius * 1.07, "ring"),
            (0.016, start_radius * 0.99, "arm"),
        ]
        if ring
        else [(0.0, start_radius, "arm")]
    )
    stops += [
        (0.35 * length, (start_radius + waist) / 2, "arm"),
        (0.60 * length, waist, "arm"),
        (0.85 * length, end_radius * 0.98, "arm"),
        (length, end_radius, "arm"),
    ]
    # A round end fills the joint that follows.
    stops += [(length + end_radius * np.sin(a), end_radius * np.cos(a), "arm") for a in np.radians([25, 50, 72, 86])]
    path = start + np.array([stop[0] for stop in stops])[:, None] * ahead
    colours = np.array([detail.at(stop[2], 0.3) for stop in stops[:-1]])
    return tube(path, np.array([stop[1] for stop in stops]), detail.sides, colours)


def _drum(detail: Detail, radius: float, half_height: float) -> Mesh:
    """The housing of a joint that bends: a short drum about z with light caps."""
    edge = 0.006
    heights = [0.0, 0.0, 0.004, 0.004, 0.004 + edge * 0.3, 0.004 + edge]
    radii = [radius * 0.62, radius * 0.70, radius * 0.74, radius - edge, radius - edge * 0.3, radius]
    full = 2 * half_height
    heights = heights + [full - value for value in reversed(heights)]
    radii = radii + radii[::-1]
    names = ["ring", "ring", "arm", "arm", "arm", "arm", "arm", "arm", "arm", "ring", "ring"]
    return _turned_profile(detail, [value - half_height for value in heights], radii, names)


def _turned_profile(detail: Detail, heights: list[float], radii: list[float], names: list[str]) -> Mesh:
    path = np.array(heights)[:, None] * UPWARDS
    return tube(path, np.array(radii), detail.sides, np.array([detail.at(name, 0.3) for name in names]))


def _palm(detail: Detail) -> Mesh:
    stops = [
        (0.000, 0.0330, 0.0330, "ring"),
        (-0.002, 0.0355, 0.0355, "ring"),
        (-0.013, 0.0355, 0.0355, "ring"),
        (-0.015, 0.0330, 0.0330, "arm"),
        (-0.040, 0.0355, 0.0345, "arm"),
        (-0.065, 0.0380, 0.0350, "arm"),
        (-0.084, 0.0360, 0.0310, "arm"),
        (-0.094, 0.0290, 0.0240, "arm"),
        (-0.098, 0.0170, 0.0140, "arm"),
    ]
    path = np.array([stop[0] for stop in stops])[:, None] * UPWARDS
    radii = np.array([stop[1:3] for stop in stops], dtype=float)
    return tube(path, radii, detail.sides, np.array([detail.at(str(stop[3]), 0.3) for stop in stops[:-1]]))


def _fingers(detail: Detail) -> list[Mesh]:
    """Two fingers above the handle and a thumb below; the handle runs along x through the hand's frame."""
    pinch = jaco.HAND_ORIGIN_M[2]
    roots = [(0.020, -0.026), (-0.020, -0.026), (0.0, 0.027)]
    meshes = []
    for x, y in roots:
        side = np.sign(y)
        root = np.array([x, y, -0.072])
        knuckle = np.array([x * 0.95, side * 0.046, -0.117])
        tip = np.array([x * 0.85, side * 0.0128, pinch - 0.004])
        meshes.append(_segment(detail, root, knuckle, 0.0125, 0.0112, "arm"))
        meshes.append(_segment(detail, knuckle, tip, 0.0112, 0.0082, "arm"))
        meshes.append(_knuckle(detail, knuckle))
    return meshes


def _segment(detail: Detail, start: Array, end: Array, start_radius: float, end_radius: float, name: str) -> Mesh:
    length = float(np.linalg.norm(end - start))
    ahead = (end - start) / length
    stops = [(-start_radius * np.sin(a), start_radius * np.cos(a)) for a in np.radians([80, 45])]
    stops += [(0.0, start_radius), (length, end_radius)]
    stops += [(length + end_radius * np.sin(a), end_radius * np.cos(a)) for a in np.radians([35, 65, 84])]
    path = start + np.array([stop[0] for stop in stops])[:, None] * ahead
    return tube(
        path, np.array([stop[1] for stop in stops]), detail.finger_sides, np.full(len(stops) - 1, detail.at(name, 0.7))
    )


def _knuckle(detail: Detail, centre: Array) -> Mesh:
    """A light disc across the finger joint."""
    half, radius = 0.0118, 0.0075
    path = centre + np.array([-half, -half + 0.001, half - 0.001, half])[:, None] * np.array([1.0, 0.0, 0.0])
    radii = np.array([radius * 0.8, radius, radius, radius * 0.8])
    return tube(path, radii, detail.finger_sides, np.full(3, detail.at("ring")))


def food_mesh(detail: Detail, name: str, radius_m: float) -> Mesh:
    """One piece of food around the origin."""
    size = (radius_m, radius_m, radius_m)
    margin = radius_m * 1.4
    return surface(ellipsoid((0, 0, 0), size), (-margin,) * 3, (margin,) * 3, radius_m / 2.6, detail.at(name))


def base_turn() -> Array:
    """Orientation (3, 3) of the arm's base in the world."""
    return turned((0, 0, 1), jaco.ROBOT_BASE_RPY[2])
