"""How the chair looks: a padded wheelchair, drawn in the world frame."""

import numpy as np

from worker.sim.human import BodyShape
from worker.sim.render.meshes.colours import Palette
from worker.sim.render.meshes.distance_fields import DistanceField, box, mirrored, union
from worker.sim.render.meshes.mesh import Mesh, joined, softly_lit, surface, tube, turned


def rest_top_m(body: BodyShape) -> float:
    """How high the armrests are set, so that this body's resting forearms lie on them."""
    return body.shoulder_m[2] - 0.995 * body.upper_arm_length_m - body.forearm_radius_m


def chair(body: BodyShape) -> DistanceField:
    """Seat, back and armrests of the wheelchair, without its wheels."""
    top = rest_top_m(body)
    seat = box((0, 0.02, 0.425), (0.23, 0.25, 0.035), 0.02)
    back = box((0, 0.235, 0.80), (0.215, 0.035, 0.33), 0.030, turned((1, 0, 0), 0.10))
    rest = mirrored(box((body.shoulder_m[0] + 0.012, -0.02, top - 0.018), (0.034, 0.235, 0.018), 0.016))
    return union(seat, back, rest)


def chair_mesh(body: BodyShape, palette: Palette, around: DistanceField) -> Mesh:
    """The chair as one mesh; `around` is the person who sits in it."""
    solid = chair(body)
    whole = union(solid, around)
    padding = surface(solid, (-0.27, -0.28, 0.36), (0.27, 0.33, 1.17), 0.021, palette.at("cushion"))
    padding = softly_lit(whole, padding, 0.08)
    metal, rest, under = palette.at("chair"), body.shoulder_m[0] + 0.016, rest_top_m(body) - 0.02
    parts = [padding]
    for side in (-1.0, 1.0):
        for start, end in (
            ((0.235, 0.19, 0.45), (rest, 0.19, under)),
            ((0.235, -0.17, 0.45), (rest, -0.17, under)),
            ((0.235, -0.20, 0.42), (0.235, 0.22, 0.42)),
            ((0.200, 0.27, 0.60), (0.195, 0.30, 1.06)),
        ):
            path = np.array([start, end]) * [side, 1, 1]
            parts.append(tube(path, np.array([0.013, 0.013]), 12, np.array([metal, metal])))
        parts += _wheel(palette, side)
    return joined(*parts)


def _wheel(palette: Palette, side: float) -> list[Mesh]:
    centre, radius = np.array([side * 0.315, 0.15, 0.29]), 0.275
    angle = np.linspace(0, 2 * np.pi, 33)
    circle = np.stack([0 * angle, np.cos(angle), np.sin(angle)], axis=1)
    tyre = tube(centre + radius * circle, np.full(33, 0.014), 8, np.full(33, palette.at("tyre")), closed_ends=False)
    hand_rim = tube(
        centre + [side * 0.02, 0, 0] + 0.235 * circle,
        np.full(33, 0.007),
        7,
        np.full(33, palette.at("metal", 0.6)),
        closed_ends=False,
    )
    spokes = [
        tube(np.stack([centre, centre + radius * point]), np.full(2, 0.003), 5, np.full(2, palette.at("metal", 0.2)))
        for point in circle[:-1:3]
    ]
    return [tyre, hand_rim, *spokes]
