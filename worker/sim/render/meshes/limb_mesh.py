"""How the person's arms look: a sleeve over the upper arm, and a bare forearm with a relaxed hand.

Each arm is two meshes that turn about the shoulder and the elbow. Both meet in a ball around the joint, so that no gap
and no edge opens in any pose. Segment frames follow human.py: origin at the joint, the bone runs along -z; at rest the
palm faces the forearm's +y. Everything is made for the left arm (thumb on -x) and mirrored for the right one.
"""

from collections.abc import Callable

import numpy as np

from worker.domain.type_aliases import FloatArray
from worker.sim import human
from worker.sim.human import BodyShape
from worker.sim.render.meshes.colours import Palette
from worker.sim.render.meshes.distance_fields import (
    DistanceField,
    chain,
    common,
    cone,
    ellipsoid,
    half_space,
    smooth_step,
    sphere,
    union,
)
from worker.sim.render.meshes.mesh import Mesh, curve, joined, softly_lit, surface, tube

SLEEVE_SHARE = 0.50
"""Down to here, as a share of the upper arm, the arm is in its sleeve."""

_FINGERS = (
    # x at the knuckle, length, radius, sideways lean, in metres and radians for a hand of the broad body's size
    (-0.0285, 0.066, 0.0100, -0.08),
    (-0.0095, 0.073, 0.0103, -0.02),
    (0.0098, 0.069, 0.0100, 0.04),
    (0.0280, 0.054, 0.0089, 0.12),
)
_PHALANGES = ((0.45, 0.24), (0.31, 0.52), (0.24, 0.34))
"""Share of the finger's length, and how far each joint is bent in rad."""


def placed(field: DistanceField, rotation: FloatArray, origin_m: FloatArray) -> DistanceField:
    """A solid given in a segment's frame, in the world."""
    return lambda points: field((points - origin_m) @ rotation)


def sleeve(body: BodyShape) -> DistanceField:
    """The sleeve in the upper arm's frame; its ball around the shoulder joint lies inside the shirt."""
    end = body.upper_arm_length_m * SLEEVE_SHARE
    shoulder, hem = body.upper_arm_radius_m + 0.0125, body.upper_arm_radius_m + 0.0085
    return common(
        chain([(0, 0, 0), (0.001, 0, -0.45 * end), (0, 0, -1.4 * end)], [shoulder, shoulder - 0.0015, hem]),
        half_space((0, 0, -end), (0.10, 0.0, -1)),
        blend=0.010,
    )


def upper_arm(body: BodyShape) -> DistanceField:
    """Bare upper arm in its own frame, ending in a ball around the elbow."""
    length, radius = body.upper_arm_length_m, body.upper_arm_radius_m
    return chain(
        [(0, 0, -0.3 * length), (0, -0.001, -0.6 * length), (0, 0, -length)],
        [radius - 0.001, radius - 0.001, _elbow_radius(body)],
    )


def forearm(body: BodyShape) -> DistanceField:
    """Forearm and palm in the forearm's frame, beginning with a ball around the elbow."""
    length, radius = body.forearm_length_m, body.forearm_radius_m
    arm = chain(
        [(0, 0, 0), (0, 0.001, -0.22 * length), (0, 0, -0.60 * length), (0, 0, -0.97 * length)],
        [_elbow_radius(body), radius + 0.0015, radius - 0.0015, radius * 0.78],
    )
    elbow = sphere((0.004, 0.006, 0.006), _elbow_radius(body) - 0.003)
    return union(union(arm, elbow, blend=0.02), _palm(body), blend=0.020)


def _elbow_radius(body: BodyShape) -> float:
    return 0.5 * (body.upper_arm_radius_m + body.forearm_radius_m) - 0.0005


def _size(body: BodyShape) -> float:
    """How large the hand is relative to the broad body's."""
    return body.hand_length_m / human.BROAD.hand_length_m


def _palm(body: BodyShape) -> DistanceField:
    size, wrist = _size(body), -body.forearm_length_m
    middle = ellipsoid((0.0, 0.002, wrist - 0.052 * size), (0.0375 * size, 0.0145 * size, 0.046 * size))
    bones = [
        cone(
            (0.28 * x * size, 0.0, wrist - 0.014 * size),
            (x * size, -0.001, wrist - 0.088 * size),
            0.0150 * size,
            radius * size,
        )
        for x, _, radius, _ in _FINGERS
    ]
    ball = ellipsoid((-0.023 * size, 0.008, wrist - 0.036 * size), (0.016 * size, 0.013 * size, 0.028 * size))
    return union(middle, *bones, ball, blend=0.011)


def _fingers(body: BodyShape, palette: Palette) -> list[Mesh]:
    size, wrist = _size(body), -body.forearm_length_m
    meshes = []
    for x, length, radius, lean in _FINGERS:
        place, down = np.array([x * size, -0.001, wrist - 0.080 * size]), 0.06
        points, radii = [place], [radius * 1.02]
        for share, bend in _PHALANGES:
            down += bend
            ahead = np.array([np.sin(lean) * np.cos(down), np.sin(down), -np.cos(down) * np.cos(lean)])
            place = place + size * length * share * ahead
            points.append(place)
            radii.append(radii[-1] * 0.92)
        meshes.append(_finger(palette, np.array(points), np.array(radii) * size))
    thumb = np.array([(-0.021, 0.007, 0.020), (-0.037, 0.014, 0.050), (-0.0415, 0.019, 0.080), (-0.0375, 0.024, 0.102)])
    thumb = thumb * [size, size, -size] + [0, 0, wrist]
    meshes.append(_finger(palette, thumb, np.array([0.0135, 0.0120, 0.0105, 0.0088]) * size))
    return meshes


def _finger(palette: Palette, points: FloatArray, radii: FloatArray) -> Mesh:
    """A tube through the joints with a round tip, a little thicker at each joint and rosier towards the tip."""
    count = 8
    path = curve(points.tolist(), count)
    place = np.linspace(0, len(points) - 1, count)
    thick = np.interp(place, np.arange(len(radii)), radii) * (1.0 - 0.05 * np.sin(np.pi * place) ** 2)
    ahead = path[-1] - path[-2]
    ahead /= np.linalg.norm(ahead)
    tip = np.radians([35, 65, 86])
    path = np.concatenate([path, path[-1] + thick[-1] * np.sin(tip)[:, None] * ahead])
    thick = np.concatenate([thick, thick[-1] * np.cos(tip)])
    rosy = palette.along("skin", np.linspace(0.02, 0.20, len(path)))
    return tube(path, thick, 7, rosy)


def _hem(end_m: float) -> Callable[[FloatArray], FloatArray]:
    return lambda points: smooth_step(-points[:, 2], end_m - 0.017, end_m - 0.014)


def arm_meshes(body: BodyShape, palette: Palette, cloth: str, around: DistanceField) -> dict[str, Mesh]:
    """Upper arm and forearm of both sides by name, each in its segment's frame.

    ``around`` is what keeps light away from the left arm at rest: the trunk and the chair.
    """
    origins, turns = rest_frames(body, human.LEFT)
    solids = union(sleeve(body), upper_arm(body)), forearm(body)
    meshes = _upper_mesh(body, palette, cloth), _lower_mesh(body, palette)
    # Neither segment shades the other: the fold of a bent elbow would stay dark when it is stretched.
    upper, lower = (
        _lit_at_rest(mesh, union(around, placed(solid, turn, origin)), turn, origin)
        for mesh, solid, turn, origin in zip(meshes, solids, turns, origins, strict=True)
    )
    return {
        "left_upper_arm": upper,
        "left_forearm": lower,
        "right_upper_arm": upper.mirrored(),
        "right_forearm": lower.mirrored(),
    }


def _lit_at_rest(mesh: Mesh, whole: DistanceField, turn: FloatArray, origin: FloatArray) -> Mesh:
    """The mesh with the light that reaches it in the resting pose."""
    return mesh.shaded(softly_lit(whole, mesh.moved(turn, origin), 0.045).paint[:, 1])


def _upper_mesh(body: BodyShape, palette: Palette, cloth: str) -> Mesh:
    end, radius = body.upper_arm_length_m * SLEEVE_SHARE, body.upper_arm_radius_m + 0.03
    elbow = body.upper_arm_length_m + 0.05
    hem = _hem(end)
    tube_of_cloth = surface(
        sleeve(body),
        (-radius, -radius, -end - 0.03),
        (radius, radius, radius + 0.01),
        0.014,
        lambda points: palette.along(cloth, hem(points)),
    )
    skin = surface(
        upper_arm(body), (-radius, -radius, -elbow), (radius, radius, 0.01 - end), 0.013, palette.at("skin", 0.02)
    )
    return joined(tube_of_cloth, skin)


def _lower_mesh(body: BodyShape, palette: Palette) -> Mesh:
    width, end = body.forearm_radius_m + 0.028, body.forearm_length_m + 0.12
    skin = surface(forearm(body), (-width, -width, -end), (width, width, 0.06), 0.0100, palette.at("skin", 0.02))
    return joined(skin, *_fingers(body, palette))


def rest_frames(body: BodyShape, side: int) -> tuple[list[FloatArray], list[FloatArray]]:
    """Origins (3,) and rotations (3, 3) of upper arm and forearm in the middle of the resting poses."""
    return segment_frames(body, REST_RAD, side)


REST_RAD = np.radians([6.0, 4.0, 11.0, 88.0])


def segment_frames(body: BodyShape, arm_rad: FloatArray, side: int) -> tuple[list[FloatArray], list[FloatArray]]:
    """Origins (3,) and rotations (3, 3) of upper arm and forearm in the world."""
    shoulder, elbow = human.arm_points_m(body, arm_rad, side)[:2]
    return [shoulder, elbow], [human.upper_arm_rotation(arm_rad, side), human.forearm_rotation(arm_rad, side)]
