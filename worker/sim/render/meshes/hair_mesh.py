"""Two hairstyles as solids in the head's frame, at the broad body's size: short and swept, or tied in a bun."""

import numpy as np

from worker.domain.type_aliases import FloatArray
from worker.sim.render.meshes.distance_fields import (
    DistanceField,
    carve,
    chain,
    common,
    ellipsoid,
    half_space,
    mirrored,
    sphere,
    torus,
    union,
)
from worker.sim.render.meshes.mesh import turned


def short_hair() -> DistanceField:
    """Short hair with a side parting, swept over the forehead."""
    shell = union(
        ellipsoid((0, 0.018, 0.1480), (0.0825, 0.1005, 0.0870)),
        ellipsoid((0, 0.048, 0.0960), (0.0690, 0.0620, 0.0720)),
        blend=0.03,
    )
    shell = carve(shell, ellipsoid((0.0, -0.1080, 0.0940), (0.0760, 0.0790, 0.0850)), blend=0.008)
    shell = carve(shell, mirrored(ellipsoid((0.0930, -0.0080, 0.0760), (0.0300, 0.0340, 0.0480))), blend=0.008)
    shell = common(shell, half_space((0, 0.06, 0.030), (0, 0.42, -1)), blend=0.016)
    sweep = union(
        chain(
            [(0.050, -0.040, 0.202), (0.022, -0.066, 0.208), (-0.018, -0.074, 0.200), (-0.058, -0.050, 0.174)],
            [0.010, 0.019, 0.020, 0.009],
        ),
        chain(
            [(0.046, -0.010, 0.216), (0.015, -0.036, 0.225), (-0.026, -0.040, 0.217), (-0.064, -0.020, 0.186)],
            [0.012, 0.020, 0.021, 0.012],
        ),
        blend=0.030,
    )
    return _combed(union(shell, sweep, blend=0.026))


def _combed(field: DistanceField) -> DistanceField:
    """Shallow grooves along the strands."""

    def distance(points: FloatArray) -> FloatArray:
        return np.asarray(field(points) + 0.0009 * strands(points))

    return distance


def strands(points: FloatArray) -> FloatArray:
    """A smooth wave in [-1, 1] (N,) that is constant along hairs: across the head in front, downwards behind."""
    crown = np.array([0.030, 0.035, 0.235])
    way = points - crown
    angle = np.arctan2(way[:, 1] + 0.25 * way[:, 0], way[:, 0] - 0.02)
    wave = angle + 2.0 * way[:, 2]
    return np.asarray(0.66 * np.sin(19 * wave) + 0.34 * np.sin(41 * wave + 1.0))


def bun() -> DistanceField:
    """Hair combed back from a high forehead over the ears and tied in a bun at the back."""
    shell = union(
        ellipsoid((0, 0.017, 0.1460), (0.0815, 0.1010, 0.0850)),
        ellipsoid((0, 0.046, 0.1000), (0.0700, 0.0640, 0.0700)),
        blend=0.03,
    )
    shell = carve(shell, ellipsoid((0.0, -0.1080, 0.0980), (0.0790, 0.0760, 0.0860)), blend=0.010)
    shell = carve(shell, mirrored(ellipsoid((0.0960, -0.0200, 0.0600), (0.0340, 0.0460, 0.0460))), blend=0.010)
    shell = common(shell, half_space((0, 0.06, 0.046), (0, 0.50, -1)), blend=0.016)
    fringe = union(
        chain(
            [(0.012, -0.060, 0.211), (-0.026, -0.078, 0.186), (-0.058, -0.062, 0.150), (-0.076, -0.030, 0.118)],
            [0.010, 0.013, 0.011, 0.006],
        ),
        chain(
            [(0.016, -0.060, 0.211), (0.044, -0.072, 0.186), (0.067, -0.052, 0.150), (0.078, -0.024, 0.118)],
            [0.009, 0.011, 0.009, 0.006],
        ),
        blend=0.012,
    )
    knot = union(
        sphere((0, 0.128, 0.172), 0.040),
        torus((0, 0.103, 0.160), (0.028, 0.028), 0.010, turned((1, 0, 0), -0.45)),
        blend=0.014,
    )
    return _combed(union(union(shell, fringe, blend=0.020), knot, blend=0.010))
