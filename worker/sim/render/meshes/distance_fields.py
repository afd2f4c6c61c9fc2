"""Solids as signed distance fields, so that bodies can be sculpted by smooth unions and then meshed.

A field maps points (N, 3) in m to distances (N,) in m: negative inside, zero on the surface. The blends are the
polynomial smooth minimum of Quilez; a blend of width k rounds the seam over about k metres.
"""

from collections.abc import Callable, Sequence

import numpy as np

from worker.domain.type_aliases import FloatArray

DistanceField = Callable[[FloatArray], FloatArray]
Point = Sequence[float]


def sphere(centre: Point, radius: float) -> DistanceField:
    middle = np.asarray(centre, dtype=float)
    return lambda points: _length(points - middle) - radius


def ellipsoid(centre: Point, radii: Point, turn: FloatArray | None = None) -> DistanceField:
    """An ellipsoid; distances are first-order estimates, exact on the surface. `turn` (3, 3) holds its axes."""
    middle, size = np.asarray(centre, dtype=float), np.asarray(radii, dtype=float)

    def distance(points: FloatArray) -> FloatArray:
        local = points - middle
        if turn is not None:
            local = local @ turn
        scaled = _length(local / size)
        slope = np.maximum(_length(local / size**2), 1e-9)
        return np.where(scaled < 1e-6, -size.min(), scaled * (scaled - 1.0) / slope)

    return distance


def cone(start: Point, end: Point, start_radius: float, end_radius: float | None = None) -> DistanceField:
    """A capsule whose radius runs linearly from one end to the other (a limb, a finger)."""
    first, last = np.asarray(start, dtype=float), np.asarray(end, dtype=float)
    change = (start_radius if end_radius is None else end_radius) - start_radius
    along = last - first

    def distance(points: FloatArray) -> FloatArray:
        offset = points - first
        share = np.clip(offset @ along / (along @ along), 0.0, 1.0)
        return np.asarray(_length(offset - share[:, None] * along) - (start_radius + change * share))

    return distance


def chain(points: Sequence[Point], radii: Sequence[float]) -> DistanceField:
    """Cones end to end through the given points."""
    pieces = [cone(a, b, ra, rb) for a, b, ra, rb in zip(points[:-1], points[1:], radii[:-1], radii[1:], strict=True)]
    return union(*pieces)


def box(centre: Point, half_extents: Point, rounding: float = 0.0, turn: FloatArray | None = None) -> DistanceField:
    """A box with rounded edges; the half extents include the rounding."""
    middle, half = np.asarray(centre, dtype=float), np.asarray(half_extents, dtype=float) - rounding

    def distance(points: FloatArray) -> FloatArray:
        local = points - middle
        if turn is not None:
            local = local @ turn
        excess = np.abs(local) - half
        outside = _length(np.maximum(excess, 0.0))
        return np.asarray(outside + np.minimum(excess.max(axis=1), 0.0) - rounding)

    return distance


def cylinder(start: Point, end: Point, radius: float, rounding: float = 0.0) -> DistanceField:
    """A cylinder with flat, rounded ends."""
    first, last = np.asarray(start, dtype=float), np.asarray(end, dtype=float)
    height = float(np.linalg.norm(last - first))
    axis = (last - first) / height
    middle = (first + last) / 2

    def distance(points: FloatArray) -> FloatArray:
        offset = points - middle
        along = offset @ axis
        across = _length(offset - along[:, None] * axis)
        excess = np.stack([across - radius + rounding, np.abs(along) - height / 2 + rounding], axis=1)
        return np.asarray(_length(np.maximum(excess, 0.0)) + np.minimum(excess.max(axis=1), 0.0) - rounding)

    return distance


def torus(centre: Point, radii: Point, thickness: float, turn: FloatArray | None = None) -> DistanceField:
    """An elliptical ring in the local x-z plane; `radii` are its half width and half height."""
    middle = np.asarray(centre, dtype=float)
    half_width, half_height = radii

    def distance(points: FloatArray) -> FloatArray:
        local = points - middle
        if turn is not None:
            local = local @ turn
        flat = np.stack([local[:, 0] / half_width, local[:, 2] / half_height], axis=1)
        scaled = np.maximum(_length(flat), 1e-6)
        slope = np.maximum(_length(flat / np.array([half_width, half_height])), 1e-6)
        ring = scaled * (scaled - 1.0) / slope
        return np.asarray(np.sqrt(ring**2 + local[:, 1] ** 2) - thickness)

    return distance


def half_space(origin: Point, outward: Point) -> DistanceField:
    """Everything behind a plane."""
    start, normal = np.asarray(origin, dtype=float), np.asarray(outward, dtype=float)
    normal = normal / np.linalg.norm(normal)
    return lambda points: (points - start) @ normal


def union(*fields: DistanceField, blend: float = 0.0) -> DistanceField:
    """The sum of solids, with their seams rounded over `blend` metres."""

    def distance(points: FloatArray) -> FloatArray:
        result = fields[0](points)
        for field in fields[1:]:
            result = smooth_minimum(result, field(points), blend)
        return result

    return distance


def carve(solid: DistanceField, cutter: DistanceField, blend: float = 0.0) -> DistanceField:
    """The solid without the cutter, the edge rounded over `blend` metres."""
    return lambda points: -smooth_minimum(-solid(points), cutter(points), blend)


def common(first: DistanceField, second: DistanceField, blend: float = 0.0) -> DistanceField:
    """What two solids share."""
    return lambda points: -smooth_minimum(-first(points), -second(points), blend)


def mirrored(field: DistanceField) -> DistanceField:
    """The solid and its mirror image in the plane x = 0."""
    return lambda points: field(np.column_stack([np.abs(points[:, 0]), points[:, 1], points[:, 2]]))


def smooth_minimum(first: FloatArray, second: FloatArray, blend: float) -> FloatArray:
    """The smaller of two distances, rounded where they differ by less than `blend` (N,)."""
    if blend <= 0.0:
        return np.minimum(first, second)
    overlap = np.maximum(blend - np.abs(first - second), 0.0) / blend
    return np.asarray(np.minimum(first, second) - overlap * overlap * blend / 4.0)


def smooth_step(values: FloatArray, start: float, end: float) -> FloatArray:
    """0 before `start`, 1 after `end`, and an S-curve between (N,)."""
    share = np.clip((values - start) / (end - start), 0.0, 1.0)
    return np.asarray(share * share * (3.0 - 2.0 * share))


def _length(vectors: FloatArray) -> FloatArray:
    return np.asarray(np.sqrt(np.einsum("ij,ij->i", vectors, vectors)))
