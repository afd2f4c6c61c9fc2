"""Generated meshes: closed, outward, painted, and always the same."""

import numpy as np
import pytest

from worker.sim import arm_look, head_look
from worker.sim.colours import RAMPS, Palette
from worker.sim.meshes import Mesh, curve, gradient, joined, openness, panel, surface, tube
from worker.sim.solids import Field, box, carve, cone, cylinder, ellipsoid, sphere, torus, union

BALL = sphere((0.0, 0.0, 0.0), 0.1)


def volume(mesh: Mesh) -> float:
    """Signed volume in cubic metres: positive when the faces run counter-clockwise seen from outside."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)


def ball_mesh(cell_m: float = 0.01) -> Mesh:
    return surface(BALL, (-0.12,) * 3, (0.12,) * 3, cell_m)


def test_the_surface_of_a_ball_lies_on_the_ball_and_encloses_its_volume() -> None:
    mesh = ball_mesh()
    assert np.linalg.norm(mesh.vertices, axis=1) == pytest.approx(0.1, abs=2e-4)
    assert volume(mesh) == pytest.approx(4 / 3 * np.pi * 0.1**3, rel=0.02)


def test_normals_point_away_from_the_inside() -> None:
    mesh = ball_mesh()
    outwards = (mesh.normals * mesh.vertices).sum(axis=1) / 0.1
    assert outwards.min() > 0.99


def test_every_edge_of_a_surface_is_shared_by_two_faces() -> None:
    faces = ball_mesh().faces
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    _, uses = np.unique(edges, axis=0, return_counts=True)
    assert set(uses.tolist()) == {2}


@pytest.mark.parametrize(
    ("field", "inside", "outside"),
    [
        (ellipsoid((0, 0, 0), (0.1, 0.2, 0.3)), (0, 0, 0.29), (0.11, 0, 0)),
        (cone((0, 0, 0), (0, 0, 0.2), 0.05, 0.02), (0.04, 0, 0), (0.04, 0, 0.2)),
        (box((0, 0, 0), (0.1, 0.1, 0.1), 0.02), (0.09, 0.09, 0), (0.099, 0.099, 0.099)),
        (cylinder((0, 0, 0), (0, 0, 0.2), 0.05), (0.04, 0, 0.19), (0, 0, 0.21)),
        (torus((0, 0, 0), (0.1, 0.05), 0.01), (0.1, 0.005, 0), (0, 0, 0)),
        (carve(BALL, sphere((0.1, 0, 0), 0.05)), (0, 0, 0), (0.09, 0, 0)),
    ],
)
def test_a_field_is_negative_inside_and_positive_outside(
    field: Field, inside: tuple[float, ...], outside: tuple[float, ...]
) -> None:
    assert field(np.array([inside]))[0] < 0 < field(np.array([outside]))[0]


def test_a_blended_union_is_fuller_at_the_seam_than_a_plain_one() -> None:
    pair = sphere((-0.08, 0, 0), 0.1), sphere((0.08, 0, 0), 0.1)
    seam = np.array([[0.0, 0.065, 0.0]])
    assert union(*pair, blend=0.05)(seam)[0] < union(*pair)(seam)[0]


def test_gradients_have_unit_length() -> None:
    points = np.random.default_rng(0).normal(size=(50, 3))
    assert np.linalg.norm(gradient(BALL, points), axis=1) == pytest.approx(1.0)


def test_a_corner_is_less_open_than_a_lone_ball() -> None:
    mesh = ball_mesh(0.02)
    wall = union(BALL, box((0.16, 0, 0), (0.05, 1, 1)))
    beside_wall = mesh.vertices[:, 0] > 0.08
    assert openness(BALL, mesh, 0.05, 1.0).min() > 0.95
    assert openness(wall, mesh, 0.05, 1.0)[beside_wall].max() < 0.9


def test_a_tube_is_closed_and_faces_outwards() -> None:
    path = curve([(0, 0, 0), (0, 0, 0.1), (0.05, 0, 0.2)], 20)
    mesh = tube(path, np.full(20, 0.01), 12, np.zeros(20))
    length = np.linalg.norm(np.diff(path, axis=0), axis=1).sum()
    assert volume(mesh) == pytest.approx(np.pi * 0.01**2 * length, rel=0.08)


def test_a_panel_faces_the_side_from_which_its_corners_run_counter_clockwise() -> None:
    mesh = panel([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], 3, 2, 0.5)
    assert len(mesh.faces) == 12
    assert (mesh.normals == [0, 0, 1]).all()


def test_joining_meshes_keeps_every_face_on_its_own_vertices() -> None:
    first, second = ball_mesh(0.03), ball_mesh(0.02)
    both = joined(first, second)
    assert (both.faces[len(first.faces) :] - len(first.vertices) == second.faces).all()


def test_palette_positions_give_back_the_colours_of_the_ramp() -> None:
    palette = Palette()
    image = palette.texture()
    for name, colours in RAMPS.items():
        for share, colour in ((0.0, colours[0]), (1.0, colours[-1])):
            column = int(palette.at(name, share) * palette.columns)
            assert image[0, column] / 255 == pytest.approx(np.array(colour), abs=0.03)


def test_full_light_is_not_wrapped_around_to_darkness() -> None:
    coordinates = Palette().coordinates(np.array([[0.5, 1.0], [0.5, 0.0]]))
    assert (coordinates[:, 1] < 1.0).all()
    assert (coordinates[:, 1] > 0.0).all()
    assert coordinates[0, 1] > coordinates[1, 1]


def test_the_mouth_is_open_wide_enough_for_the_spoon() -> None:
    mouth = head_look.MOUTH
    bowl_edges = mouth + np.array([[0.019, -0.005, 0.0], [-0.019, -0.005, 0.0], [0, 0.02, 0.008], [0, 0.02, -0.004]])
    assert (head_look.face()(bowl_edges) > 0).all()


def test_the_fingers_touch_the_handle_without_cutting_through_it() -> None:
    detail = arm_look.Detail(Palette())
    handle = arm_look.spoon(detail).vertices
    grip = handle[(handle[:, 0] > -0.155) & (handle[:, 0] < -0.105)]
    lowest_above, highest_below = _finger_gap(detail)
    assert lowest_above >= grip[:, 2].max() - 0.004
    assert highest_below <= grip[:, 2].min() + 0.004
    assert lowest_above - highest_below < 0.016


def _finger_gap(detail: arm_look.Detail) -> tuple[float, float]:
    """Heights of the fingertips above and of the thumb below the handle, in the spoon's frame."""
    hand = arm_look.arm_meshes(detail)["link_7"].vertices
    up = -hand[:, 1]  # the spoon's z axis is link 7's -y axis
    tips = (hand[:, 2] < -0.155) & (hand[:, 2] > -0.165)
    return float(up[tips & (up > 0)].min()), float(up[tips & (up < 0)].max())


def test_the_same_code_always_makes_the_same_head() -> None:
    first, second = head_look.head_mesh(Palette()), head_look.head_mesh(Palette())
    assert (first.vertices == second.vertices).all()
    assert (first.faces == second.faces).all()
    assert np.isfinite(first.vertices).all()
    assert np.isfinite(first.normals).all()
