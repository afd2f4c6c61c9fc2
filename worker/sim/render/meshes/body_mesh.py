"""How the person's trunk and legs look, sitting relaxed. World frame and sizes as in human.py."""

from dataclasses import dataclass

import numpy as np

from worker.sim import human
from worker.sim.human import BodyShape
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
    sphere,
    torus,
    union,
)
from worker.sim.render.meshes.limb_mesh import placed, rest_frames, sleeve, upper_arm
from worker.sim.render.meshes.mesh import Mesh, joined, softly_lit, surface, turned


@dataclass(frozen=True)
class Build:
    """What of a body human.py leaves open: half widths and half depths of the trunk, and its clothes."""

    chest_m: tuple[float, float]
    waist_m: tuple[float, float]
    hips_m: float
    neckline_m: tuple[float, float]
    """how wide the neck of the shirt is, and how high above the shoulder joints"""
    shoulders_m: tuple[float, float]
    """height of the shoulders' ridge beside the neck above the shoulder joints, and its radius"""
    neck_radius_m: float
    cloth: str
    """ramp of the shirt; its trim's ends in _trim"""


BUILDS = {
    "broad": Build((0.158, 0.102), (0.140, 0.104), 0.165, (0.0605, 0.092), (0.043, 0.054), 0.0525, "shirt"),
    "slim": Build((0.137, 0.090), (0.116, 0.087), 0.158, (0.0560, 0.082), (0.031, 0.047), 0.0440, "blouse"),
}


@dataclass(frozen=True)
class Region:
    """The box in which a surface is looked for, and how finely."""

    lower: tuple[float, float, float]
    upper: tuple[float, float, float]
    cell_m: float


def shirt(body: BodyShape) -> DistanceField:
    """The shirt without its sleeves, whose shoulders are balls around the joints that the sleeves turn about."""
    build, (x, y, z) = BUILDS[body.name], body.shoulder_m
    ridge, thick = build.shoulders_m
    torso = union(
        ellipsoid((0, 0.058, z - 0.070), (*build.chest_m, 0.150)),
        ellipsoid((0, 0.052, 0.730), (*build.waist_m, 0.170)),
        ellipsoid((0, 0.060, 0.655), (build.hips_m + 0.016, 0.128, 0.062)),
        mirrored(cone((0.02, 0.064, z + ridge), (0.70 * x, 0.060, z + 0.24 * ridge), thick, thick)),
        blend=0.075,
    )
    if body.name == "slim":
        torso = union(torso, mirrored(ellipsoid((0.054, -0.004, z - 0.110), (0.050, 0.032, 0.046))), blend=0.060)
    joint = sphere((x - 0.004, y, z), body.upper_arm_radius_m + 0.0115)
    solid = union(torso, mirrored(joint), blend=0.055)
    width, height = build.neckline_m
    bottom = z + height - 0.017
    collar_hole = cone((0, 0.052, bottom), (0, 0.030, bottom + 0.125), width - 0.0125, 0.075)
    return carve(solid, collar_hole, blend=0.006)


def collar(body: BodyShape) -> DistanceField:
    """The seam around the neck."""
    (width, height), turn = BUILDS[body.name].neckline_m, turned((1, 0, 0), np.pi / 2 + 0.30)
    return torus((0.0, 0.046, body.shoulder_m[2] + height), (width, width + 0.0005), 0.0095, turn)


def neck(body: BodyShape) -> DistanceField:
    """The neck up to the chin."""
    radius, pivot = BUILDS[body.name].neck_radius_m, body.neck_pivot_m[2]
    return cone((0, 0.062, pivot - 0.12), (0, 0.036, pivot - 0.007), radius + 0.0075, radius)


def trousers(body: BodyShape) -> DistanceField:
    """Thighs as thick as in human.py, shins hanging down."""
    hips = BUILDS[body.name].hips_m
    leg = chain(
        [(0.080, 0.080, 0.550), (0.112, -0.390, 0.545), (0.112, -0.450, 0.500), (0.112, -0.470, 0.100)],
        [0.098, 0.076, 0.072, 0.052],
    )
    return union(mirrored(leg), ellipsoid((0, 0.08, 0.57), (hips, 0.14, 0.10)), blend=0.03)


def shoes() -> DistanceField:
    """Both shoes, flat on the floor."""
    shoe = union(
        ellipsoid((0.115, -0.535, 0.060), (0.044, 0.105, 0.042)),
        cone((0.112, -0.475, 0.07), (0.112, -0.475, 0.13), 0.045),
        blend=0.03,
    )
    return mirrored(common(shoe, half_space((0, 0, 0.02), (0, 0, -1)), blend=0.01))


def trunk(body: BodyShape) -> DistanceField:
    """Everything that this module draws of the person but the shoes."""
    return union(shirt(body), neck(body), trousers(body), collar(body))


def trunk_mesh(body: BodyShape, palette: Palette, around: DistanceField) -> Mesh:
    """Shirt, trousers and shoes as one mesh; `around` is what else keeps light away (the chair)."""
    origins, turns = rest_frames(body, human.LEFT)
    arm = placed(union(sleeve(body), upper_arm(body)), turns[0], origins[0])
    whole = union(trunk(body), mirrored(arm), around)
    cloth, z = BUILDS[body.name].cloth, body.shoulder_m[2]
    parts: list[tuple[DistanceField, Region, str]] = [
        (shirt(body), Region((-0.29, -0.10, 0.56), (0.29, 0.20, z + 0.13), 0.015), cloth),
        (collar(body), Region((-0.08, -0.04, z + 0.04), (0.08, 0.13, z + 0.15), 0.0055), f"{cloth}_trim"),
        (trousers(body), Region((-0.22, -0.56, 0.04), (0.22, 0.24, 0.68), 0.028), "trousers"),
        (shoes(), Region((-0.18, -0.66, 0.0), (0.18, -0.40, 0.20), 0.024), "shoe"),
    ]
    meshes = []
    for field, region, name in parts:
        mesh = surface(field, region.lower, region.upper, region.cell_m, palette.at(name))
        meshes.append(softly_lit(whole, mesh, 0.07))
    return joined(*meshes)


def neck_mesh(body: BodyShape, palette: Palette) -> Mesh:
    """The neck, which stands still but is drawn with the head so that no shadow edge lies between the two."""
    pivot = body.neck_pivot_m[2]
    chin = sphere((0, -0.030, pivot + 0.015), 0.055)
    whole = union(neck(body), chin, collar(body))
    lower, upper = (-0.075, -0.04, pivot - 0.10), (0.075, 0.14, pivot + 0.085)
    return softly_lit(whole, surface(neck(body), lower, upper, 0.007, palette.at("skin", 0.02)), 0.06, 0.9)
