"""Generated meshes: closed, outward, painted, and always the same."""

from dataclasses import replace

import numpy as np
import pytest

from app.installed_tasks import catalogue
from worker.domain.trajectory import SKIN_TONES
from worker.sim import human
from worker.sim.arm import Tool
from worker.sim.geometry import Shape
from worker.sim.human import BODY_SHAPES, BROAD, BodyShape
from worker.sim.jaco import JACO
from worker.sim.render.camera import Camera
from worker.sim.render.mesh_set import MeshSet, Paints
from worker.sim.render.meshes import arm_mesh, body_mesh, chair_mesh, head_mesh, limb_mesh, tool_mesh
from worker.sim.render.meshes.colours import COMPLEXIONS, Palette, ramps
from worker.sim.render.meshes.distance_fields import (
    DistanceField,
    box,
    carve,
    cone,
    cylinder,
    ellipsoid,
    sphere,
    torus,
    union,
)
from worker.sim.render.meshes.mesh import (
    Mesh,
    ball,
    curve,
    gradient,
    joined,
    openness,
    panel,
    surface,
    tube,
    without_hidden,
)
from worker.sim.render.passes import MACHINE_LIGHT
from worker.tasks.drinking import cup_mesh
from worker.tasks.drinking.environment import PELLETS, pellet_radius_m, resting_places_m
from worker.tasks.feeding.spoon_mesh import spoon
from worker.tasks.registry import filmed_task, look

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


def test_what_was_drawn_before_changes_no_pixel() -> None:
    """The software renderer normalises normals in place whenever it draws, and some never settle by themselves."""
    smooth = ball_mesh(0.006)
    corners = smooth.faces.ravel()
    rough = smooth.normals[corners] + np.random.default_rng(0).normal(0, 0.2, (len(corners), 3))
    apart = np.arange(len(corners), dtype=np.int32).reshape(-1, 3)  # a normal of two faces is looked at twice
    paints = Paints()
    stage = MeshSet(paints)
    stage.add({"ball": Mesh(smooth.vertices[corners], rough, smooth.paint[corners], apart)})
    camera = Camera((0.0, -0.5, 0.1), (0.0, 0.0, 0.0), 30.0, 600, 600, 0.1, 2.0)
    different = 0
    for turn in np.linspace(0, 3, 10):
        stage.place("ball", quaternion=(0.0, 0.0, np.sin(turn / 2), np.cos(turn / 2)))
        one, other = (stage.draw(camera, None, 600, 600, MACHINE_LIGHT).rgb for _ in range(2))
        assert np.ptp(one[:, 300]) > 50, "the ball is in sight, and lit from one side"
        different += int(np.count_nonzero(one != other))
    stage.close()
    paints.close()
    assert different == 0


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
    field: DistanceField, inside: tuple[float, ...], outside: tuple[float, ...]
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


@pytest.mark.parametrize("tone", range(SKIN_TONES))
def test_palette_positions_give_back_the_colours_of_the_ramp(tone: int) -> None:
    palette = Palette()
    image = palette.texture(tone)
    for name, colours in ramps(tone).items():
        for share, colour in ((0.0, colours[0]), (1.0, colours[-1])):
            column = int(palette.at(name, share) * palette.columns)
            assert image[0, column] / 255 == pytest.approx(np.array(colour), abs=0.03)


def test_every_skin_tone_is_darker_than_the_one_before() -> None:
    brightness = [sum(complexion.skin) for complexion in COMPLEXIONS]
    assert len(brightness) == SKIN_TONES
    assert brightness == sorted(brightness, reverse=True)


def test_full_light_is_not_wrapped_around_to_darkness() -> None:
    coordinates = Palette().coordinates(np.array([[0.5, 1.0], [0.5, 0.0]]))
    assert (coordinates[:, 1] < 1.0).all()
    assert (coordinates[:, 1] > 0.0).all()
    assert coordinates[0, 1] > coordinates[1, 1]


def test_the_mouth_is_open_wide_enough_for_the_spoon_and_no_wider_for_a_cup_or_nothing() -> None:
    middle, features = head_mesh.MOUTH, head_mesh.FEATURES["broad"]
    bowl_edges = middle + np.array([[0.019, -0.005, 0.0], [-0.019, -0.005, 0.0], [0, 0.02, 0.008], [0, 0.02, -0.004]])
    assert (head_mesh.face(features, look("feeding").mouth)(bowl_edges) > 0).all()
    below_the_rim = middle + np.array([[0.0, 0.0, -0.009]])
    assert (head_mesh.face(features, look("drinking").mouth)(below_the_rim) < 0).all()
    assert (head_mesh.face(features, look("scratching").mouth)(middle + np.array([[0.0, 0.004, 0.004]])) < 0).all()


def test_the_cup_is_cut_out_for_the_nose_and_whole_where_it_is_drunk_from() -> None:
    for mesh in (cup_mesh.cup(arm_mesh.Detail(Palette())), cup_mesh.cup_glass(arm_mesh.Detail(Palette()))):
        x, y, z = (mesh.vertices - cup_mesh.CUP_CENTRE_M).T
        angle = np.arctan2(np.abs(y), x)
        assert z[angle < 0.5].max() == pytest.approx(0.0, abs=0.004)
        assert z[angle > 2.9].max() == pytest.approx(-cup_mesh.NOSE_CUT_M, abs=0.004)


def test_water_in_a_level_cup_stays_below_the_cut() -> None:
    assert resting_places_m(PELLETS)[:, 2].max() + pellet_radius_m(PELLETS) < -cup_mesh.NOSE_CUT_M + 0.002


def test_the_mirror_image_of_a_mesh_still_faces_outwards() -> None:
    arm = limb_mesh.arm_meshes(BROAD, Palette(), "shirt", BALL)
    assert volume(arm["right_forearm"]) == pytest.approx(volume(arm["left_forearm"]))
    assert volume(arm["right_forearm"]) > 0


def test_a_ball_is_round_and_faces_outwards() -> None:
    mesh = ball(0.01, 0.5)
    assert len(mesh.faces) == 80
    assert volume(mesh) == pytest.approx(4 / 3 * np.pi * 0.01**3, rel=0.15)


def test_faces_hidden_inside_another_solid_are_left_out_and_the_others_kept() -> None:
    mesh = ball_mesh()
    rest = without_hidden(mesh, box((0.1, 0, 0), (0.1, 1, 1)), 0.005)
    assert rest.vertices[:, 0].max() < 0.03
    assert len(rest.faces) == pytest.approx(len(mesh.faces) / 2, rel=0.1)


@pytest.mark.parametrize("body", BODY_SHAPES.values(), ids=lambda body: body.name)
def test_arms_lie_on_the_armrests_and_not_in_them(body: BodyShape) -> None:
    _, elbow, wrist, _ = human.arm_points_m(body, np.radians([0.0, 0.0, 0.0, 90.0]), human.LEFT)
    underside = (elbow + wrist) / 2 - [0.0, 0.0, body.forearm_radius_m]
    gap = float(chair_mesh.chair(body)(underside[None])[0])
    assert -0.002 < gap < 0.02


@pytest.mark.parametrize("body", BODY_SHAPES.values(), ids=lambda body: body.name)
@pytest.mark.parametrize("side", [human.RIGHT, human.LEFT])
def test_drawn_arms_have_the_thickness_that_the_simulation_feels(body: BodyShape, side: int) -> None:
    name = ("right", "left")[side]
    meshes = limb_mesh.arm_meshes(body, Palette(), "shirt", body_mesh.trunk(body))
    bare = meshes[f"{name}_upper_arm"].vertices
    bare = bare[(bare[:, 2] < -0.62 * body.upper_arm_length_m) & (bare[:, 2] > -0.92 * body.upper_arm_length_m)]
    forearm = meshes[f"{name}_forearm"].vertices
    forearm = forearm[(forearm[:, 2] < -0.12 * body.forearm_length_m) & (forearm[:, 2] > -0.7 * body.forearm_length_m)]
    for vertices, radius_m in ((bare, body.upper_arm_radius_m), (forearm, body.forearm_radius_m)):
        assert np.abs(np.hypot(vertices[:, 0], vertices[:, 1]) - radius_m).max() < 0.006


@pytest.mark.parametrize("body", BODY_SHAPES.values(), ids=lambda body: body.name)
def test_the_drawn_mouth_is_where_the_simulation_feeds(body: BodyShape) -> None:
    drawn = head_mesh.MOUTH * body.head_scale
    assert drawn == pytest.approx(np.array(body.mouth_from_neck_m), abs=0.001)


@pytest.mark.parametrize("task", catalogue.names())
def test_our_tools_have_a_designed_look_as_large_as_what_the_simulation_moves(task: str) -> None:
    detail, (_, tool, look) = arm_mesh.Detail(Palette()), filmed_task(task)
    assert look.tool is not None
    drawn = look.tool.solid(detail).vertices
    felt = tool_mesh.plain(detail, tool.shapes).vertices
    # The spoon's handle is drawn longer, for the hand to hold.
    assert drawn.min(axis=0) == pytest.approx(felt.min(axis=0), abs=0.065)
    assert drawn.max(axis=0) == pytest.approx(felt.max(axis=0), abs=0.013)


def test_a_tool_nobody_designed_is_drawn_from_its_collision_shapes() -> None:
    shapes = (Shape.box((0, 0, 0), (0.02, 0.04, 0.06)), Shape("capsule", 0.01, 0.1), Shape("sphere", 0.02))
    comb = Tool("comb", (0, 0, 0), (0, 0, 0), shapes, 0.1)
    mesh = tool_mesh.plain_look(comb.shapes).solid(arm_mesh.Detail(Palette()))
    assert mesh.vertices.max(axis=0) == pytest.approx([0.02, 0.02, 0.06], abs=0.002)
    assert volume(mesh) > 0


def test_a_robot_nobody_designed_is_drawn_from_its_links() -> None:
    links = arm_mesh.arm_meshes(arm_mesh.Detail(Palette()), replace(JACO, name="other"), arm_mesh.Grip(0.004))
    assert list(links) == [joint.link for joint in JACO.joints]
    assert all(volume(mesh) > 0 for mesh in links.values())


def test_the_fingers_touch_the_handle_without_cutting_through_it() -> None:
    detail = arm_mesh.Detail(Palette())
    handle = spoon(detail).vertices
    grip = handle[(handle[:, 0] > -0.155) & (handle[:, 0] < -0.105)]
    lowest_above, highest_below = _finger_gap(detail)
    assert lowest_above >= grip[:, 2].max() - 0.004
    assert highest_below <= grip[:, 2].min() + 0.004
    assert lowest_above - highest_below < 0.016


def _finger_gap(detail: arm_mesh.Detail) -> tuple[float, float]:
    """Heights of the fingertips above and of the thumb below the handle, in the spoon's frame."""
    held = look("feeding").tool
    assert held is not None
    hand = arm_mesh.arm_meshes(detail, JACO, held.grip)["link_7"].vertices
    up = -hand[:, 1]  # the spoon's z axis is link 7's -y axis
    tips = (hand[:, 2] < -0.155) & (hand[:, 2] > -0.165)
    return float(up[tips & (up > 0)].min()), float(up[tips & (up < 0)].max())


@pytest.mark.parametrize("body", BODY_SHAPES.values(), ids=lambda body: body.name)
def test_the_same_code_always_makes_the_same_head(body: BodyShape) -> None:
    first, second = (head_mesh.head_mesh(body, head_mesh.EATING, Palette()) for _ in range(2))
    assert (first.vertices == second.vertices).all()
    assert (first.faces == second.faces).all()
    assert np.isfinite(first.vertices).all()
    assert np.isfinite(first.normals).all()
