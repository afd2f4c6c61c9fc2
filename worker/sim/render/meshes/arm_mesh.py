"""How robot arms look: the Jaco with smooth dark links and light rings, any other arm as drawn from its data.

Meshes are in the frames of arm.py: each link's own, z along its joint's axis.
"""

from dataclasses import dataclass

import numpy as np

from worker.domain.type_aliases import FloatArray
from worker.sim.arm import Joint, RobotArm, rotation
from worker.sim.render.meshes.colours import Palette
from worker.sim.render.meshes.mesh import Mesh, joined, tube


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


@dataclass(frozen=True)
class Grip:
    """How the fingers close around the tool, which runs along the hand's x axis."""

    half_width_m: float
    """half the thickness of what they hold"""
    spread_m: float = 0.018
    """how far the two fingers on one side stand from the middle"""
    ahead_m: float = 0.0
    """how far beyond the hand's origin the middle of what they hold lies"""


def arm_meshes(detail: Detail, robot: RobotArm, grip: Grip) -> dict[str, Mesh]:
    """One mesh per moving link, in the link's own frame."""
    if robot.name == "jaco":
        return _jaco_meshes(detail, robot, grip)
    return {joint.link: _plain_link(detail, joint) for joint in robot.joints}


def _plain_link(detail: Detail, joint: Joint) -> Mesh:
    """A link of a robot without a designed look: its collision capsule with a light ring."""
    return _limb(detail, np.zeros(3), np.array(joint.end_m, float), joint.radius_m, joint.radius_m)


def _jaco_meshes(detail: Detail, robot: RobotArm, grip: Grip) -> dict[str, Mesh]:
    return {
        "link_1": _limb(detail, np.zeros(3), np.array([0.0, 0.0, -0.118]), 0.045, 0.044),
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
        "link_7": joined(_palm(detail), *_fingers(detail, robot.hand_origin_m[2], grip)),
    }


def base_mesh(detail: Detail, robot: RobotArm) -> Mesh:
    """The fixed base of the arm in the world, with the stand down to the floor."""
    floor = -robot.mount_m[2]
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
    return _turned_profile(detail, heights, radii, names).moved(rotation(robot.mount_rpy), robot.mount_m)


def _limb(
    detail: Detail, start: FloatArray, end: FloatArray, start_radius: float, end_radius: float, ring: bool = True
) -> Mesh:
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


def _fingers(detail: Detail, pinch_m: float, grip: Grip) -> list[Mesh]:
    """Two fingers on one side of what is held and a thumb on the other."""
    half, spread = grip.half_width_m, grip.spread_m
    meshes = []
    for x, side in ((spread, -1.0), (-spread, -1.0), (0.0, 1.0)):
        root = np.array([1.1 * x, side * 0.0265, -0.072])
        knuckle = np.array([1.05 * x, side * max(0.046, half + 0.020), -0.117 - 0.2 * grip.ahead_m])
        tip = np.array([0.95 * x, side * (half + 0.0085), pinch_m - 0.004 - grip.ahead_m])
        meshes.append(_segment(detail, root, knuckle, 0.0125, 0.0112, "arm"))
        meshes.append(_segment(detail, knuckle, tip, 0.0112, 0.0082, "arm"))
        meshes.append(_knuckle(detail, knuckle))
    return meshes


def _segment(
    detail: Detail, start: FloatArray, end: FloatArray, start_radius: float, end_radius: float, name: str
) -> Mesh:
    length = float(np.linalg.norm(end - start))
    ahead = (end - start) / length
    stops = [(-start_radius * np.sin(a), start_radius * np.cos(a)) for a in np.radians([80, 45])]
    stops += [(0.0, start_radius), (length, end_radius)]
    stops += [(length + end_radius * np.sin(a), end_radius * np.cos(a)) for a in np.radians([35, 65, 84])]
    path = start + np.array([stop[0] for stop in stops])[:, None] * ahead
    return tube(
        path, np.array([stop[1] for stop in stops]), detail.finger_sides, np.full(len(stops) - 1, detail.at(name, 0.7))
    )


def _knuckle(detail: Detail, centre: FloatArray) -> Mesh:
    """A light disc across the finger joint."""
    half, radius = 0.0118, 0.0075
    path = centre + np.array([-half, -half + 0.001, half - 0.001, half])[:, None] * np.array([1.0, 0.0, 0.0])
    radii = np.array([radius * 0.8, radius, radius, radius * 0.8])
    return tube(path, radii, detail.finger_sides, np.full(3, detail.at("ring")))
