"""Meshes made in numpy: surfaces of distance fields, tubes and flat panels, painted per vertex.

Nothing is read from files and nothing is random, so the same code always gives the same arrays.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
import numpy.typing as npt

from worker.domain.type_aliases import FloatArray
from worker.sim.render.meshes.distance_fields import DistanceField

Faces = npt.NDArray[np.int32]
Paint = Callable[[FloatArray], FloatArray]

_COARSE = 4
"""Grid cells per side of a block that is skipped when the surface cannot pass through it."""

_NORMAL_STEP_M = 4e-4


@dataclass(frozen=True)
class Mesh:
    """Triangles with smooth normals. V vertices, F faces, counter-clockwise seen from outside."""

    vertices: FloatArray
    """(V, 3) m"""
    normals: FloatArray
    """(V, 3) unit length, pointing outwards"""
    paint: FloatArray
    """(V, 2) in [0, 1]: the position in the palette and how much light reaches the vertex"""
    faces: Faces
    """(F, 3)"""

    def moved(self, rotation: FloatArray, translation: Sequence[float] | FloatArray) -> "Mesh":
        """The mesh turned by rotation (3, 3), then shifted."""
        return replace(
            self,
            vertices=self.vertices @ rotation.T + np.asarray(translation),
            normals=self.normals @ rotation.T,
        )

    def mirrored(self) -> "Mesh":
        """The mirror image in the plane x = 0, its faces turned over so that they still look outwards."""
        mirror = np.array([-1.0, 1.0, 1.0])
        return Mesh(self.vertices * mirror, self.normals * mirror, self.paint, self.faces[:, ::-1])

    def scaled(self, factor: float) -> "Mesh":
        """The mesh made larger or smaller about its origin."""
        return replace(self, vertices=self.vertices * factor)

    def shaded(self, light: FloatArray) -> "Mesh":
        """The same mesh with light (V,) in [0, 1] reaching its vertices."""
        return replace(self, paint=np.column_stack([self.paint[:, 0], light]))


def joined(*meshes: Mesh) -> Mesh:
    """Several meshes as one."""
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    return Mesh(
        vertices=np.concatenate([mesh.vertices for mesh in meshes]),
        normals=np.concatenate([mesh.normals for mesh in meshes]),
        paint=np.concatenate([mesh.paint for mesh in meshes]),
        faces=np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts, strict=True)]).astype(np.int32),
    )


def surface(
    field: DistanceField, lower: Sequence[float], upper: Sequence[float], cell_m: float, colour: float | Paint = 0.0
) -> Mesh:
    """The zero surface of a distance field inside a box, by naive surface nets (Gibson 1998).

    One vertex per crossed grid cell, pulled onto the surface by a Newton step; normals are the field's gradient.
    """
    values = _sampled(field, np.asarray(lower, dtype=float), np.asarray(upper, dtype=float), cell_m)
    inside = values < 0.0
    vertices, number = _cell_vertices(values, inside)
    faces = _crossed_quads(inside, number)
    vertices = np.asarray(lower, dtype=float) + vertices * cell_m
    vertices = vertices - np.clip(field(vertices), -cell_m, cell_m)[:, None] * gradient(field, vertices)
    colours = colour(vertices) if callable(colour) else np.full(len(vertices), colour)
    return Mesh(vertices, gradient(field, vertices), np.column_stack([colours, np.ones(len(vertices))]), faces)


def without_hidden(mesh: Mesh, cover: DistanceField, depth_m: float) -> Mesh:
    """The mesh without the faces that lie deeper than this inside another solid."""
    hidden = cover(mesh.vertices) < -depth_m
    faces = mesh.faces[~hidden[mesh.faces].all(axis=1)]
    kept, numbers = np.unique(faces, return_inverse=True)
    return Mesh(mesh.vertices[kept], mesh.normals[kept], mesh.paint[kept], numbers.reshape(-1, 3).astype(np.int32))


def gradient(field: DistanceField, points: FloatArray) -> FloatArray:
    """Unit direction of steepest increase (N, 3), by the four-point stencil of a tetrahedron."""
    corners = np.array([[1, -1, -1], [-1, -1, 1], [-1, 1, -1], [1, 1, 1]], dtype=float)
    total = sum(
        (corner * field(points + corner * _NORMAL_STEP_M)[:, None] for corner in corners), start=np.zeros_like(points)
    )
    return np.asarray(total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-12))


def openness(field: DistanceField, mesh: Mesh, reach_m: float, strength: float) -> FloatArray:
    """How open the surroundings of each vertex are (V,) in [0, 1]: 1 in the open, less in folds and corners.

    Ambient occlusion from a distance field: walking out along the normal, the distance to the nearest surface grows
    as fast as the walk unless something is in the way.
    """
    missing = np.zeros(len(mesh.vertices))
    for share in (0.2, 0.45, 0.7, 1.0):
        walked = reach_m * share
        free = field(mesh.vertices + mesh.normals * walked)
        missing += np.clip(walked - free, 0.0, walked) / walked / 4.0
    return np.asarray(np.clip(1.0 - strength * missing, 0.0, 1.0))


SKY = np.array([-0.55, -0.45, 0.70])


def softly_lit(field: DistanceField, mesh: Mesh, reach_m: float, strength: float = 0.75) -> Mesh:
    """The mesh with baked ambient light: less in folds, a little more where it faces a bright sky."""
    towards_sky = 0.5 + 0.5 * (mesh.normals @ (SKY / np.linalg.norm(SKY)))
    return mesh.shaded(openness(field, mesh, reach_m, strength) * (0.80 + 0.20 * towards_sky))


def tube(path: FloatArray, radii: FloatArray, sides: int, colours: FloatArray, closed_ends: bool = True) -> Mesh:
    """A round tube along a path.

    path (R, 3), radii (R,) or (R, 2) half width and half height, colours (R,) or (R - 1,): with one colour per piece
    the border between two colours is sharp. Rings may repeat a point with another radius to make a step.
    """
    sizes = np.repeat(radii[:, None], 2, axis=1) if radii.ndim == 1 else radii
    frames = _frames_along(path)
    angle = np.linspace(0.0, 2 * np.pi, sides, endpoint=False)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    offsets = np.einsum("rij,rj,js->rsi", frames, sizes, circle)
    rings = path[:, None] + offsets
    pieces = []
    per_piece = len(colours) == len(path) - 1
    normals = _tube_normals(rings)
    for start in range(len(path) - 1):
        if np.allclose(rings[start], rings[start + 1]):
            continue
        shades = [colours[start]] * 2 if per_piece else [colours[start], colours[start + 1]]
        pieces.append(_band(rings[start : start + 2], normals[start], shades))
    if closed_ends:
        pieces += [_cap(rings[0], path[0], colours[0], True), _cap(rings[-1], path[-1], colours[-1], False)]
    return joined(*pieces)


def ball(radius_m: float, colour: float, halvings: int = 1) -> Mesh:
    """A small ball around the origin: an icosahedron (20 faces) whose edges are halved (80 faces)."""
    golden = (1 + 5**0.5) / 2
    upright = [(0.0, a, b * golden) for a in (-1, 1) for b in (-1, 1)]
    points = np.array([*upright, *((y, z, x) for x, y, z in upright), *((z, x, y) for x, y, z in upright)])
    points /= np.linalg.norm(points[0])
    gaps = np.linalg.norm(points[:, None] - points[None], axis=-1)
    near = (gaps > 1e-9) & (gaps < 1.2 * gaps[gaps > 1e-9].min())
    triples = [triple for triple in combinations(range(12), 3) if near[np.ix_(triple, triple)].sum() == 6]
    corners = [points[list(triple if np.linalg.det(points[list(triple)]) > 0 else triple[::-1])] for triple in triples]
    for _ in range(halvings):
        corners = [piece for triangle in corners for piece in _quartered(*triangle)]
    vertices, numbers = np.unique(np.round(np.array(corners).reshape(-1, 3), 9), axis=0, return_inverse=True)
    paint = np.column_stack([np.full(len(vertices), colour), np.ones(len(vertices))])
    return Mesh(vertices * radius_m, vertices, paint, numbers.reshape(-1, 3).astype(np.int32))


def _quartered(a: FloatArray, b: FloatArray, c: FloatArray) -> list[FloatArray]:
    """A triangle on the unit ball as four."""
    ab, bc, ca = _unit(a + b), _unit(b + c), _unit(c + a)
    return [np.array(piece) for piece in ((a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca))]


def _unit(vector: FloatArray) -> FloatArray:
    return np.asarray(vector / np.linalg.norm(vector))


def panel(corners: Sequence[Sequence[float]], columns: int, rows: int, colour: float | Paint) -> Mesh:
    """A flat four-cornered panel in small cells, seen from the side where its corners run counter-clockwise."""
    a, b, c, d = (np.asarray(corner, dtype=float) for corner in corners)
    u, v = np.meshgrid(np.linspace(0, 1, columns + 1), np.linspace(0, 1, rows + 1), indexing="ij")
    u, v = u.reshape(-1, 1), v.reshape(-1, 1)
    vertices = (1 - u) * (1 - v) * a + u * (1 - v) * b + u * v * c + (1 - u) * v * d
    normal = np.cross(b - a, d - a)
    normals = np.tile(normal / np.linalg.norm(normal), (len(vertices), 1))
    colours = colour(vertices) if callable(colour) else np.full(len(vertices), colour)
    first = (np.arange(columns)[:, None] * (rows + 1) + np.arange(rows)).ravel()
    quads = np.stack([first, first + rows + 1, first + rows + 2, first + 1], axis=1)
    return Mesh(vertices, normals, np.column_stack([colours, np.ones(len(vertices))]), _triangles(quads))


def turned(axis: Sequence[float], angle_rad: float) -> FloatArray:
    """Rotation matrix (3, 3) about an axis (Rodrigues)."""
    x, y, z = np.asarray(axis, dtype=float) / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.eye(3) + np.sin(angle_rad) * cross + (1 - np.cos(angle_rad)) * cross @ cross)


def curve(points: Sequence[Sequence[float]], count: int) -> FloatArray:
    """A smooth path (count, 3) through the points (Catmull-Rom)."""
    knots = np.asarray(points, dtype=float)
    padded = np.concatenate([[2 * knots[0] - knots[1]], knots, [2 * knots[-1] - knots[-2]]])
    place = np.linspace(0, len(knots) - 1, count)
    index = np.minimum(place.astype(int), len(knots) - 2)
    t = (place - index)[:, None]
    p0, p1, p2, p3 = (padded[index + k] for k in range(4))
    return np.asarray(
        0.5 * (2 * p1 + (p2 - p0) * t + (2 * p0 - 5 * p1 + 4 * p2 - p3) * t**2 + (3 * p1 - p0 - 3 * p2 + p3) * t**3)
    )


def _sampled(field: DistanceField, lower: FloatArray, upper: FloatArray, cell_m: float) -> FloatArray:
    """Field values on a grid of points, exact near the surface and only signed elsewhere."""
    blocks = np.ceil((upper - lower) / cell_m / _COARSE).astype(int)
    step = cell_m * _COARSE
    centres = lower + (np.stack(np.meshgrid(*(np.arange(n) for n in blocks), indexing="ij"), -1) + 0.5) * step
    rough = field(centres.reshape(-1, 3)).reshape(blocks)
    shape = blocks * _COARSE
    values = np.repeat(np.repeat(np.repeat(rough, _COARSE, 0), _COARSE, 1), _COARSE, 2)
    near = np.abs(rough) < 1.3 * step
    index = np.argwhere(np.repeat(np.repeat(np.repeat(near, _COARSE, 0), _COARSE, 1), _COARSE, 2))
    values[tuple(index.T)] = field(lower + index * cell_m)
    border = np.ones(shape, dtype=bool)
    border[1:-1, 1:-1, 1:-1] = False
    values[border] = np.maximum(values[border], cell_m * 0.1)
    return np.asarray(values)


_CORNERS = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
_EDGES = [(a, b) for a in range(8) for b in range(a + 1, 8) if np.abs(_CORNERS[a] - _CORNERS[b]).sum() == 1]


def _cell_vertices(values: FloatArray, inside: npt.NDArray[np.bool_]) -> tuple[FloatArray, Faces]:
    """One vertex per crossed cell, in grid units (V, 3), and the vertex number of every cell (-1 where none)."""
    nx, ny, nz = (n - 1 for n in values.shape)
    count = sum(inside[i : i + nx, j : j + ny, k : k + nz].astype(np.int8) for i, j, k in _CORNERS)
    cells = np.argwhere((count > 0) & (count < 8))
    corner_values = np.stack([values[tuple((cells + corner).T)] for corner in _CORNERS], axis=1)
    total, crossings = np.zeros((len(cells), 3)), np.zeros(len(cells))
    for a, b in _EDGES:
        first, second = corner_values[:, a], corner_values[:, b]
        crossed = (first < 0) != (second < 0)
        share = np.where(crossed, first / np.where(crossed, first - second, 1.0), 0.0)
        place = _CORNERS[a] + share[:, None] * (_CORNERS[b] - _CORNERS[a])
        total += place * crossed[:, None]
        crossings += crossed
    number = np.full((nx, ny, nz), -1, dtype=np.int32)
    number[tuple(cells.T)] = np.arange(len(cells))
    return cells + total / crossings[:, None], number


def _crossed_quads(inside: npt.NDArray[np.bool_], number: Faces) -> Faces:
    """Two triangles for every grid edge that passes through the surface, joining the four cells around it."""
    quads = []
    for axis in range(3):
        first, second = (axis + 1) % 3, (axis + 2) % 3
        limits = [slice(1, -1)] * 3
        limits[axis] = slice(0, -1)
        ahead = list(limits)
        ahead[axis] = slice(1, None)
        here, there = inside[tuple(limits)], inside[tuple(ahead)]
        edges = np.argwhere(here != there)
        leaving = here[tuple(edges.T)]
        start = edges + np.array([1 if k != axis else 0 for k in range(3)])
        u, v = np.eye(3, dtype=int)[first], np.eye(3, dtype=int)[second]
        around = np.stack([number[tuple((start - shift).T)] for shift in (u + v, v, 0 * u, u)], axis=1)
        quads.append(np.where(leaving[:, None], around, around[:, ::-1]))
    return _triangles(np.concatenate(quads))


def _triangles(quads: npt.NDArray[np.integer]) -> Faces:
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]).astype(np.int32)


def _frames_along(path: FloatArray) -> FloatArray:
    """Two directions across the path at each point (R, 3, 2), turning as little as possible."""
    ahead = np.diff(path, axis=0)
    length = np.linalg.norm(ahead, axis=1)
    known = np.flatnonzero(length > 1e-9)
    ahead = ahead[known[np.maximum(np.searchsorted(known, np.arange(len(ahead)), side="right") - 1, 0)]]
    ahead /= np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-12)
    tangents = np.concatenate([ahead[:1], ahead[:-1] + ahead[1:], ahead[-1:]])
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    side = np.cross(tangents[0], [0.0, 0.0, 1.0] if abs(tangents[0, 2]) < 0.9 else [0.0, 1.0, 0.0])
    frames = []
    for tangent in tangents:
        side = side - tangent * (side @ tangent)
        side /= np.linalg.norm(side)
        frames.append(np.stack([side, np.cross(tangent, side)], axis=1))
    return np.array(frames)


_SHARP_RAD = 0.7


def _tube_normals(rings: FloatArray) -> list[FloatArray]:
    """Normals of both ends of every band (R-1 of (2, S, 3)), shared with the neighbour unless the edge is sharp."""
    around = np.roll(rings, -1, axis=1) - np.roll(rings, 1, axis=1)
    flat = []
    for start in range(len(rings) - 1):
        along = rings[start + 1] - rings[start]
        spread = around[start] + around[start + 1]
        normal = np.cross(spread, along)
        flat.append(normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12))
    result = []
    for k, own in enumerate(flat):
        ends = []
        for neighbour in (k - 1, k + 1):
            other = flat[neighbour] if 0 <= neighbour < len(flat) else own
            soft = (own * other).sum(axis=1, keepdims=True) > np.cos(_SHARP_RAD)
            mean = np.where(soft, own + other, own)
            ends.append(mean / np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-12))
        result.append(np.stack(ends))
    return result


def _band(rings: FloatArray, normals: FloatArray, colours: Sequence[float]) -> Mesh:
    sides = rings.shape[1]
    here = np.arange(sides)
    after = (here + 1) % sides
    quads = np.stack([here, after, after + sides, here + sides], axis=1)
    paint = np.column_stack([np.repeat(colours, sides), np.ones(2 * sides)])
    return Mesh(rings.reshape(-1, 3), normals.reshape(-1, 3), paint, _triangles(quads))


def _cap(ring: FloatArray, centre: FloatArray, colour: float, at_start: bool) -> Mesh:
    sides = len(ring)
    vertices = np.concatenate([ring, centre[None]])
    here = np.arange(sides)
    faces = np.stack([np.full(sides, sides), here, (here + 1) % sides], axis=1)
    normal = np.cross(ring[0] - centre, ring[sides // 4] - centre)
    normal /= max(float(np.linalg.norm(normal)), 1e-12)
    if at_start:
        faces, normal = faces[:, ::-1], -normal
    paint = np.column_stack([np.full(sides + 1, colour), np.ones(sides + 1)])
    return Mesh(vertices, np.tile(normal, (sides + 1, 1)), paint, faces.astype(np.int32))
