"""How the person's body looks, sitting relaxed with both arms on the armrests. World frame, as in human.py."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from worker.sim.colours import Palette
from worker.sim.meshes import Mesh, joined, softly_lit, surface, turned
from worker.sim.solids import (
    Array,
    Field,
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


@dataclass(frozen=True)
class Region:
    """The box in which a surface is looked for, and how finely."""

    lower: tuple[float, float, float]
    upper: tuple[float, float, float]
    cell_m: float


SLEEVE_END, SLEEVE_AXIS = (0.21, 0.050, 0.838), (0.22, -0.05, -1.0)
NECKLINE = np.array([0.0, 0.046, 1.092])


def shirt() -> Field:
    torso = union(
        ellipsoid((0, 0.058, 0.930), (0.158, 0.102, 0.150)),
        ellipsoid((0, 0.052, 0.730), (0.140, 0.104, 0.170)),
        mirrored(cone((0.02, 0.064, 1.040), (0.145, 0.062, 1.006), 0.056, 0.058)),
        blend=0.075,
    )
    sleeve = cone((0.166, 0.060, 1.002), (0.213, 0.050, 0.795), 0.058, 0.057)
    sleeve = common(sleeve, half_space(SLEEVE_END, SLEEVE_AXIS), blend=0.012)
    solid = union(torso, mirrored(sleeve), blend=0.028)
    collar_hole = cone((0, 0.052, 1.075), (0, 0.030, 1.20), 0.048, 0.075)
    return carve(solid, collar_hole, blend=0.006)


def collar() -> Field:
    turn = turned((1, 0, 0), np.pi / 2 + 0.30)
    return torus(tuple(NECKLINE), (0.0605, 0.0610), 0.0095, turn)


def arms() -> Field:
    arm = chain(
        [
            (0.2105, 0.051, 0.825),
            (0.211, 0.050, 0.765),
            (0.207, 0.020, 0.733),
            (0.201, -0.085, 0.728),
            (0.197, -0.195, 0.724),
        ],
        [0.0405, 0.0400, 0.0400, 0.0385, 0.0265],
    )
    return mirrored(union(_softened(arm), hand(), blend=0.022))


def _softened(field: Field) -> Field:
    return lambda points: field(points) - 0.001


def hand() -> Field:
    """The left hand, lying relaxed over the end of the armrest."""
    palm = union(
        ellipsoid((0.196, -0.238, 0.7230), (0.038, 0.047, 0.0165)),
        cone((0.196, -0.195, 0.7230), (0.196, -0.240, 0.7240), 0.024, 0.021),
        blend=0.02,
    )
    solid = palm
    for offset, length in ((0.027, 0.90), (0.0090, 1.03), (-0.0095, 1.0), (-0.0275, 0.80)):
        x = 0.195 - offset
        start = (x, -0.268, 0.7240)
        middle = (x - offset * 0.18, -0.268 - 0.034 * length, 0.7170)
        end = (x - offset * 0.25, -0.268 - 0.052 * length, 0.7000 - 0.006 * length)
        solid = union(solid, chain([start, middle, end], [0.0096, 0.0089, 0.0078]), blend=0.006)
    thumb = chain([(0.168, -0.212, 0.720), (0.151, -0.245, 0.716), (0.150, -0.270, 0.710)], [0.0125, 0.0108, 0.0088])
    return union(solid, thumb, blend=0.012)


def neck() -> Field:
    return cone((0, 0.062, 1.030), (0, 0.036, 1.143), 0.060, 0.0525)


def trousers() -> Field:
    leg = chain(
        [(0.080, 0.080, 0.550), (0.112, -0.390, 0.545), (0.112, -0.450, 0.500), (0.112, -0.470, 0.100)],
        [0.098, 0.076, 0.072, 0.052],
    )
    return union(mirrored(leg), ellipsoid((0, 0.08, 0.57), (0.165, 0.14, 0.10)), blend=0.03)


def shoes() -> Field:
    shoe = union(
        ellipsoid((0.115, -0.535, 0.060), (0.044, 0.105, 0.042)),
        cone((0.112, -0.475, 0.07), (0.112, -0.475, 0.13), 0.045),
        blend=0.03,
    )
    return mirrored(common(shoe, half_space((0, 0, 0.02), (0, 0, -1)), blend=0.01))


def _hem(points: Array) -> Array:
    """1 in a narrow band at the end of the sleeves, 0 elsewhere (N,)."""
    beyond = half_space(SLEEVE_END, SLEEVE_AXIS)(np.abs(points) * [1, 0, 1] + points * [0, 1, 0])
    return smooth_step(beyond, -0.017, -0.014) * smooth_step(np.abs(points[:, 0]), 0.145, 0.15)


def _paint(palette: Palette, name: str, share: float | Callable[[Array], Array]) -> float | Callable[[Array], Array]:
    """One colour, or a colour per point of a ramp."""
    if callable(share):
        return lambda points: palette.along(name, share(points))
    return palette.at(name, share)


def body_mesh(palette: Palette, around: Field) -> Mesh:
    """Everything of the person but the head, as one mesh; `around` is what else keeps light away (the chair)."""
    whole = union(shirt(), arms(), neck(), trousers(), collar(), around)
    parts: list[tuple[Field, Region, str, float | Callable[[Array], Array]]] = [
        (shirt(), Region((-0.29, -0.09, 0.56), (0.29, 0.20, 1.13), 0.011), "shirt", _hem),
        (collar(), Region((-0.08, -0.04, 1.04), (0.08, 0.13, 1.14), 0.0045), "shirt_trim", 0.0),
        (arms(), Region((-0.26, -0.345, 0.67), (0.26, 0.11, 0.86), 0.0062), "skin", 0.02),
        (trousers(), Region((-0.22, -0.56, 0.04), (0.22, 0.24, 0.68), 0.019), "trousers", 0.0),
        (shoes(), Region((-0.18, -0.66, 0.0), (0.18, -0.40, 0.20), 0.017), "shoe", 0.0),
    ]
    meshes = []
    for field, region, name, share in parts:
        mesh = surface(field, region.lower, region.upper, region.cell_m, _paint(palette, name, share))
        meshes.append(softly_lit(whole, mesh, 0.07))
    return joined(*meshes)


def neck_mesh(palette: Palette) -> Mesh:
    """The neck, which stands still but is drawn with the head so that no shadow edge lies between the two."""
    chin = sphere((0, -0.030, 1.165), 0.055)
    whole = union(neck(), chin, collar())
    mesh = surface(neck(), (-0.075, -0.04, 1.05), (0.075, 0.14, 1.235), 0.006, palette.at("skin", 0.02))
    return softly_lit(whole, mesh, 0.06, 0.9)
