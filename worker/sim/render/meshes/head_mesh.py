"""How the person's head looks: a calm face, its mouth as open as a task wants it. Landmarks come from human.py.

Head frame: origin at the neck pivot, z up, the face looks along -y. Heads are made at the broad body's size and scaled.
"""

from dataclasses import dataclass

import numpy as np

from worker.domain.type_aliases import FloatArray
from worker.sim.human import BROAD, BodyShape
from worker.sim.render.meshes.colours import Palette
from worker.sim.render.meshes.distance_fields import (
    DistanceField,
    carve,
    chain,
    common,
    cone,
    ellipsoid,
    half_space,
    mirrored,
    smooth_step,
    sphere,
    torus,
    union,
)
from worker.sim.render.meshes.hair_mesh import bun, short_hair, strands
from worker.sim.render.meshes.mesh import (
    Mesh,
    curve,
    gradient,
    joined,
    softly_lit,
    surface,
    tube,
    turned,
    without_hidden,
)

MOUTH = np.asarray(BROAD.mouth_from_neck_m)
LIPS = MOUTH + np.array([0.0, -0.0005, 0.0])


@dataclass(frozen=True)
class Mouth:
    """How far the lips are apart: half the width and half the height of the line along their middle, in metres."""

    name: str
    half_width_m: float
    half_height_m: float


EATING = Mouth("eating", 0.0265, 0.0125)
SIPPING = Mouth("sipping", 0.0250, 0.0070)
CLOSED = Mouth("closed", 0.0265, 0.0034)

EYE = np.array([0.0325, -0.0735, 0.1155])
EYE_RADIUS = 0.0165
GAZE = np.array([-0.16, -1.0, -0.16])


LOWER, UPPER, CELL_M = (-0.105, -0.135, -0.065), (0.105, 0.135, 0.245), 0.0054
"""The box that holds the head, and how finely its surface is drawn."""


@dataclass(frozen=True)
class Features:
    """What makes one face differ from another, in metres."""

    cheekbones: float = 0.0665
    jaw: float = 0.0510
    chin: float = 0.0180
    nose: float = 1.0
    """thickness of the nose, relative"""
    brows: float = 1.0
    lashes: float = 1.0
    neck: tuple[float, float] = (0.0465, 0.050)
    """its radius where it enters the head"""


FEATURES = {
    "broad": Features(),
    "slim": Features(0.0660, jaw=0.0445, chin=0.0150, nose=0.84, brows=0.68, lashes=1.5, neck=(0.042, 0.044)),
}
HAIR = {"broad": short_hair, "slim": bun}


def skull(features: Features) -> DistanceField:
    """The smooth mass of the head, without features."""
    return union(
        ellipsoid((0, 0.012, 0.138), (0.077, 0.097, 0.084)),
        ellipsoid((0, -0.030, 0.088), (features.cheekbones, 0.0650, 0.080)),
        ellipsoid((0, -0.040, 0.030), (features.jaw, 0.0480, 0.044)),
        blend=0.045,
    )


def face(features: Features, mouth: Mouth) -> DistanceField:
    """The skin of the head with nose, ears, lips and what is behind them."""
    solid = union(
        skull(features),
        sphere((0, -0.0715, 0.0020), features.chin),
        mirrored(ellipsoid((0.0370, -0.0640, 0.0740), (0.024, 0.0225, 0.024))),
        blend=0.032,
    )
    solid = carve(solid, mirrored(ellipsoid((0.0335, -0.1045, 0.1150), (0.0220, 0.0165, 0.0150))), blend=0.026)
    solid = union(solid, _nose(features.nose), blend=0.012)
    solid = union(solid, cone((0, 0.006, -0.004), (0, 0.006, 0.070), *features.neck), blend=0.022)
    solid = union(solid, mirrored(_ear()), blend=0.007)
    solid = union(solid, _lips(mouth), blend=0.009)
    return carve(solid, mouth_cavity(mouth), blend=0.004)


def mouth_cavity(mouth: Mouth) -> DistanceField:
    """What is carved out between the lips."""
    x, y, z = LIPS
    radii = (mouth.half_width_m - 0.0022, 0.050, mouth.half_height_m - 0.0020)
    return _smiling(ellipsoid((x, y + 0.022, z), radii))


def _lips(mouth: Mouth) -> DistanceField:
    """The upper lip dips in the middle and is thinner than the lower one."""
    ring = torus((LIPS[0], LIPS[1], LIPS[2]), (mouth.half_width_m, mouth.half_height_m), 0.0)

    def distance(points: FloatArray) -> FloatArray:
        height = points[:, 2] - LIPS[2]
        dip = np.exp(-((points[:, 0] / 0.0045) ** 2)) * smooth_step(height, 0.0, 0.012)
        thickness = 0.0074 - 0.0012 * smooth_step(height, -0.008, 0.008) - 0.0012 * dip
        corner = smooth_step(np.abs(points[:, 0]), 0.014, mouth.half_width_m)
        return np.asarray(ring(points) - thickness * (1 - 0.35 * corner))

    return _smiling(distance)


def _smiling(field: DistanceField) -> DistanceField:
    """The same with the corners of the mouth lifted and drawn back around the face."""

    def distance(points: FloatArray) -> FloatArray:
        bend = points[:, 0] ** 2
        return field(points - np.column_stack([0 * bend, 4.5 * bend, 9.0 * bend]))

    return distance


def _nose(thick: float) -> DistanceField:
    bridge = [(0, -0.0870, 0.1230), (0, -0.0985, 0.1000), (0, -0.1075, 0.0865)]
    return union(
        chain(bridge, [0.0055 * thick, 0.0072 * thick, 0.0102 * thick]),
        mirrored(sphere((0.0098 * thick, -0.0965, 0.0825), 0.0072 * thick)),
        blend=0.011,
    )


def _ear() -> DistanceField:
    turn = turned((0, 0, 1), 0.35) @ turned((1, 0, 0), -0.18)
    lobe = ellipsoid((0.0790, 0.0150, 0.1000), (0.0065, 0.0185, 0.0300), turn)
    return carve(lobe, ellipsoid((0.0870, 0.0110, 0.1010), (0.0065, 0.0110, 0.0190), turn), blend=0.006)


def head_mesh(body: BodyShape, mouth: Mouth, palette: Palette) -> Mesh:
    """The whole head as one mesh."""
    features = FEATURES[body.name]
    skin_field, hair_field = face(features, mouth), HAIR[body.name]()
    whole = union(skin_field, hair_field)
    skin = surface(skin_field, LOWER, UPPER, CELL_M, lambda points: palette.along("skin", _complexion(points, mouth)))
    skin = softly_lit(whole, without_hidden(skin, hair_field, 0.002), 0.020)
    skin = skin.shaded(_cavity_light(skin.vertices, mouth) * skin.paint[:, 1])
    locks = surface(
        hair_field,
        LOWER,
        UPPER,
        CELL_M,
        lambda points: palette.along("hair", 0.40 + 0.16 * strands(points) + 1.6 * (points[:, 2] - 0.15)),
    )
    locks = softly_lit(whole, without_hidden(locks, skin_field, 0.002), 0.02)
    eyes = _eyes(palette, features.lashes)
    parts = [skin, locks, *eyes, *_brows(palette, features, mouth), *_inside_mouth(palette, mouth)]
    return joined(*parts).scaled(body.head_scale)


def _complexion(points: FloatArray, mouth: Mouth) -> FloatArray:
    """Where each point of the skin lies on the ramp from skin over blush and lips to the inside of the mouth (N,)."""
    lips = 0.66 * (1.0 - smooth_step(_lips(mouth)(points), 0.0012, 0.0032))
    depth = points[:, 1] - LIPS[1] - 4.5 * points[:, 0] ** 2
    inside = smooth_step(-mouth_cavity(mouth)(points), -0.0018, 0.0) * smooth_step(depth, -0.003, 0.003)
    cheek = _spot(np.abs(points) * [1, -1, 1], (0.041, -0.068, 0.074), 0.024)
    nose = _spot(points, (0, -0.114, 0.086), 0.014)
    ear = smooth_step(np.abs(points[:, 0]), 0.076, 0.088)
    blush = 0.34 * np.clip(cheek + 0.5 * nose + 0.6 * ear, 0, 1)
    return np.asarray(np.maximum(np.maximum(blush, lips), inside))


def _spot(points: FloatArray, centre: tuple[float, float, float], radius: float) -> FloatArray:
    """A soft round spot (N,)."""
    return np.asarray(np.exp(-(((points - np.array(centre)) ** 2).sum(axis=1)) / radius**2))


def _cavity_light(points: FloatArray, mouth: Mouth) -> FloatArray:
    """The mouth gets dark with depth (N,)."""
    depth = smooth_step(points[:, 1], LIPS[1] - 0.001, LIPS[1] + 0.022)
    return np.where(mouth_cavity(mouth)(points) < 0.004, 1.0 - 0.8 * depth, 1.0)


def _inside_mouth(palette: Palette, mouth: Mouth) -> list[Mesh]:
    """Upper teeth and tongue, where they can be seen."""
    if mouth.half_height_m < EATING.half_height_m:
        return []
    x, y, z = LIPS
    upper, lower = z + mouth.half_height_m - 0.0031, z - mouth.half_height_m - 0.0010
    arch = [(x + 0.0195 * np.sin(a), y + 0.022 - 0.0175 * np.cos(a), upper) for a in np.linspace(-1.25, 1.25, 13)]
    path = np.array(arch)
    teeth = tube(path, np.full(len(path), 0.0034), 8, np.full(len(path), palette.at("teeth")))
    tongue = surface(
        ellipsoid((x, y + 0.029, lower), (0.0160, 0.023, 0.0068)),
        (-0.03, y - 0.01, lower - 0.0135),
        (0.03, y + 0.06, lower + 0.0265),
        0.003,
        palette.at("tongue", 0.3),
    )
    light = 1.0 - 0.75 * smooth_step(tongue.vertices[:, 1], LIPS[1] + 0.004, LIPS[1] + 0.032)
    return [teeth.shaded(np.full(len(teeth.vertices), 0.86)), tongue.shaded(light)]


def _eyes(palette: Palette, lashes: float) -> list[Mesh]:
    meshes = []
    for side in (-1.0, 1.0):
        centre = EYE * [side, 1, 1]
        gaze = GAZE + np.array([-0.05 * side, 0, 0])
        meshes += [_eyeball(palette, centre, gaze / np.linalg.norm(gaze)), *_lid(palette, centre, lashes)]
    return meshes


def _eyeball(palette: Palette, centre: FloatArray, gaze: FloatArray) -> Mesh:
    angles = np.radians([178, 120, 80, 60, 45, 34, 32, 25, 20, 14.5, 13.5, 8, 2])
    names = ["eye"] * 6 + ["iris"] * 4 + ["pupil"] * 2
    shares = [0.0] * 6 + [1.0, 0.6, 0.3, 0.1] + [0.0] * 2
    path = centre + EYE_RADIUS * np.cos(angles)[:, None] * gaze
    colours = np.array([palette.at(name, share) for name, share in zip(names, shares, strict=True)])
    ball = tube(path, EYE_RADIUS * np.sin(angles), 20, colours)
    glint = centre + EYE_RADIUS * 1.0 * _unit(gaze + np.array([0.16, 0.0, 0.20]))
    dot = surface(sphere(tuple(glint), 0.0017), tuple(glint - 0.003), tuple(glint + 0.003), 0.0008, palette.at("teeth"))
    upper = smooth_step(ball.vertices[:, 2] - centre[2], 0.010, 0.003)
    return joined(ball.shaded(0.55 + 0.45 * upper), dot)


UPPER_LID = (np.array([0.0, 0.34, -1.0]), 0.0046)
"""Outward normal of the plane that ends the lid, and how far above the middle of the eye's front it lies."""


def _lid(palette: Palette, centre: FloatArray, lashes: float) -> list[Mesh]:
    """The upper lid as a cap of a slightly larger ball, and the line of the lashes along its edge."""
    direction, height = UPPER_LID
    normal, radius = _unit(direction), EYE_RADIUS + 0.0015
    front = centre + np.array([0.0, -radius, height])
    margin = radius + 0.003
    lid = common(sphere(tuple(centre), radius), half_space(tuple(front), tuple(normal)), blend=0.003)
    cap = surface(lid, tuple(centre - margin), tuple(centre + margin), 0.0016, palette.at("skin", 0.18))
    cap = cap.shaded(np.full(len(cap.vertices), 0.86))
    return [cap, _lashes(palette, centre, normal, float((front - centre) @ normal) - 0.0006, radius, lashes)]


def _lashes(
    palette: Palette, centre: FloatArray, normal: FloatArray, offset: float, radius: float, thick: float
) -> Mesh:
    """A dark line along the circle in which a plane cuts the eye."""
    across = _unit(np.cross(normal, [0, 1.0, 0]))
    front = _unit(np.cross(across, normal))
    front = front if front[1] < 0 else -front
    sweep = np.linspace(-1.25, 1.25, 17)
    circle = np.sin(sweep)[:, None] * across + np.cos(sweep)[:, None] * front
    line = centre + normal * offset + np.sqrt(radius**2 - offset**2) * circle
    return tube(line, thick * (0.0013 * np.cos(sweep) + 0.0005), 6, np.full(len(line), palette.at("hair", 0.0)))


def _brows(palette: Palette, features: Features, mouth: Mouth) -> list[Mesh]:
    field = face(features, mouth)
    meshes = []
    for side in (-1.0, 1.0):
        points = curve(
            [
                (side * x, -0.095, z)
                for x, z in ((0.0170, 0.1384), (0.0290, 0.1420), (0.0420, 0.1418), (0.0545, 0.1365))
            ],
            14,
        )
        points = _onto(field, points)
        width = np.interp(np.linspace(0, 1, 14), [0, 0.2, 0.6, 1], [0.0024, 0.0033, 0.0030, 0.0010])
        width *= features.brows
        # Thick along the skin, thin out of it.
        meshes.append(tube(points, np.column_stack([width * 0.62, width]), 8, np.full(14, palette.at("hair", 0.25))))
    return meshes


def _onto(field: DistanceField, points: FloatArray) -> FloatArray:
    for _ in range(6):
        points = points - field(points)[:, None] * gradient(field, points)
    return points


def _unit(vector: FloatArray) -> FloatArray:
    return np.asarray(vector / np.linalg.norm(vector))
