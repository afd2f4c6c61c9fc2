"""Whole clips: what a participant would see, looked at as pixels."""

import io
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from PIL import Image

from tests.worker.waving import itching_trajectory, pouring_trajectory, waving_trajectory
from worker.compute import simulation
from worker.domain.trajectory import Trajectory
from worker.sim.arm import Tool
from worker.sim.geometry import Shape, rotation_of
from worker.sim.human import BROAD, RIGHT
from worker.sim.jaco import JACO
from worker.sim.render import compositing
from worker.sim.render.camera import scene_camera
from worker.sim.render.clip import INSET_MARGIN_PX, STYLES, ClipRenderer, FilmedTask
from worker.sim.render.close_up import close_up
from worker.sim.render.highlight import Highlight
from worker.sim.render.interpolation import clip_motion
from worker.sim.render.mesh_set import MeshSet
from worker.sim.render.passes import Shot
from worker.sim.render.scene import Scene
from worker.sim.render.task_look import TaskLook
from worker.sim.rollout import rollout
from worker.tasks.feeding.environment import SPOON
from worker.tasks.registry import filmed_task, look
from worker.tasks.scratching.environment import SCRATCHER

Picture = npt.NDArray[np.uint8]
QUICK = STYLES["quick"]
PLAIN = replace(QUICK, inset=False)


@pytest.fixture(scope="module")
def scene() -> Iterator[Scene]:
    """Making its meshes takes longer than a clip."""
    scene = Scene()
    yield scene
    scene.close()


@pytest.fixture(scope="module")
def renderer(scene: Scene) -> ClipRenderer:
    return ClipRenderer(filmed_task, QUICK, scene)


@pytest.fixture(scope="module")
def plain(scene: Scene) -> ClipRenderer:
    """Without the close-up, which takes half of the time: for what is looked for in the picture around it."""
    return ClipRenderer(filmed_task, PLAIN, scene)


@pytest.fixture(scope="module")
def usual(plain: ClipRenderer) -> Picture:
    """The first picture of an arm that waves in front of somebody broad."""
    return film(plain, waving_trajectory(1))[0]


def film(renderer: ClipRenderer, trajectory: Trajectory) -> list[Picture]:
    return [np.asarray(picture).copy() for picture in renderer.pictures(trajectory, 0, len(trajectory))]


def pictures(renderer: ClipRenderer, force_n: float = 0.0, steps: int = 4, food: bool = True) -> list[Picture]:
    trajectory = waving_trajectory(steps, force_n)
    if not food:
        trajectory.particles[:] = np.nan
    return film(renderer, trajectory)


def different(first: Picture, second: Picture, by: int = 12) -> npt.NDArray[np.bool_]:
    return np.asarray(np.abs(first.astype(int) - second).max(axis=2) > by)


def around(point_m: npt.NDArray[np.floating], task: str = "feeding", reach: int = 12) -> tuple[slice, slice]:
    """A square of the picture around a point in the world."""
    x, y = scene_camera(look(task), 640, 480).pixels(point_m.astype(float)).astype(int)
    return np.s_[y - reach : y + reach, x - reach : x + reach]


def test_a_clip_reports_what_it_holds(renderer: ClipRenderer) -> None:
    clip = renderer.render_clip(waving_trajectory(8), 2, 4)
    assert (clip.width, clip.height, clip.fps, clip.n_frames, clip.duration_ms) == (640, 480, 15, 6, 400)
    assert clip.video.index(b"moov") < clip.video.index(b"mdat")
    assert clip.poster.startswith(b"\xff\xd8")


def test_a_sharp_clip_shows_the_same_in_more_pixels_and_pictures(renderer: ClipRenderer, scene: Scene) -> None:
    sharp = ClipRenderer(filmed_task, STYLES["sharp"], scene)
    trajectory = waving_trajectory(2)
    clip = sharp.render_clip(trajectory, 0, 2)
    first = Image.open(io.BytesIO(clip.poster)).resize((640, 480))
    assert (clip.width, clip.height, clip.fps, clip.n_frames) == (960, 720, 25, 5)
    assert different(np.asarray(first), film(renderer, trajectory)[0], by=40).mean() < 0.01


def test_the_close_up_looks_the_person_in_the_face_wherever_it_turns(renderer: ClipRenderer) -> None:
    for turn_rad in (-0.5, 0.0, 0.5):
        trajectory = waving_trajectory(1)
        turn = np.array([0.0, 0.0, np.sin(turn_rad / 2), np.cos(turn_rad / 2)])
        trajectory.head_quaternions[:] = turn
        pivot = np.array(BROAD.neck_pivot_m)
        trajectory.target_m[:] = pivot + rotation_of(turn) @ BROAD.mouth_from_neck_m
        motion = clip_motion(trajectory, JACO, SPOON, 0, 1, 15)
        camera = close_up(look("feeding"), motion, 312, 228)
        towards = np.array(camera.eye_m) - camera.target_m
        out_of_the_face = rotation_of(turn) @ [0.0, -1.0, 0.0]
        assert towards @ out_of_the_face / np.linalg.norm(towards) > np.cos(np.radians(40))
        assert (camera.pixels(motion.target_m[0]) - [156, 114]) / [156, 114] == pytest.approx([0, 0], abs=0.4)


def test_two_clips_of_a_scenario_are_seen_from_the_same_place() -> None:
    for task, tool in (("feeding", SPOON), ("scratching", SCRATCHER)):
        first = itching_trajectory(3) if task == "scratching" else waving_trajectory(3)
        other = replace(first, joint_positions=first.joint_positions + np.float32(0.1))
        cameras = {close_up(look(task), clip_motion(each, JACO, tool, 0, 3, 15), 208, 152) for each in (first, other)}
        assert len(cameras) == 1


@pytest.mark.parametrize("scenario", [9_000_055, 9_000_136, 9_000_272])
def test_no_shoulder_and_no_head_hides_an_itch_in_the_crook_of_the_elbow(renderer: ClipRenderer, scenario: int) -> None:
    """Where the arm is dark, so that the itch is the only thing in the close-up that is as red."""
    whole = rollout(simulation.environment("scratching"), lambda observation: np.zeros(7, np.float32), scenario)
    first = np.asarray(next(renderer.pictures(whole, 0, 1))).astype(int)
    red, green, _ = np.moveaxis(first[: first.shape[0] // 3, 2 * first.shape[1] // 3 :], -1, 0)
    assert ((red > 100) & (red > 2.2 * green)).mean() > 0.004


def test_what_lies_behind_a_camera_is_not_drawn_and_what_reaches_behind_it_is_drawn_whole() -> None:
    camera = scene_camera(look("feeding"), 640, 480)
    ahead, eye = np.array(camera.target_m), np.array(camera.eye_m)
    behind = 2 * eye - ahead
    boxes = camera.boxes(np.array([[ahead, ahead], [behind, behind], [ahead, behind], [[np.nan] * 3] * 2]))
    assert boxes[0] == pytest.approx([318.5, 238.5, 321.5, 241.5])
    assert boxes[1].tolist() == boxes[3].tolist() == [0, 0, 0, 0]
    assert boxes[2].tolist() == [0, 0, 640, 480]


def test_rendering_twice_gives_identical_bytes(renderer: ClipRenderer) -> None:
    trajectory = waving_trajectory(2)
    first = renderer.render_clip(trajectory, 0, 2)
    film(renderer, waving_trajectory(1, 9.0))
    assert renderer.render_clip(trajectory, 0, 2) == first


@pytest.mark.long
def test_nothing_of_other_clips_remains(renderer: ClipRenderer) -> None:
    trajectories = [
        waving_trajectory(2, body="slim", skin_tone=4),
        pouring_trajectory(2),
        itching_trajectory(2, lift_rad=0.1),
        replace(waving_trajectory(2), particles=waving_trajectory(2).particles[:, :5]),
    ]
    first = [film(renderer, trajectory) for trajectory in trajectories]
    for trajectory, before in reversed(list(zip(trajectories, first, strict=True))):
        assert all((now == then).all() for now, then in zip(film(renderer, trajectory), before, strict=True))
    fresh = ClipRenderer(filmed_task, QUICK)
    assert (film(fresh, trajectories[2])[1] == first[2][1]).all()
    fresh.close()


def test_only_the_arm_and_its_shadow_change_between_frames(plain: ClipRenderer) -> None:
    first, *_, last = pictures(plain)
    assert 0.002 < different(first, last).mean() < 0.25


def test_the_food_is_visible_on_the_spoon(plain: ClipRenderer, usual: Picture) -> None:
    changed = different(usual, pictures(plain, steps=1, food=False)[0], by=40)
    bowl = clip_motion(waving_trajectory(1), JACO, SPOON, 0, 1, 15).frames[0, -1, :3, 3]
    assert changed[around(bowl, reach=18)].sum() > 60
    assert not changed[240:, 320:].any()


@pytest.mark.parametrize("pellets", [16, 64])
def test_the_water_is_seen_in_its_cup(plain: ClipRenderer, pellets: int) -> None:
    full = pouring_trajectory(1, pellets)
    empty = replace(full, particles=np.full_like(full.particles, np.nan))
    wet, dry = film(plain, full)[0], film(plain, empty)[0]
    water = different(wet, dry, by=30)[around(full.particles[0].mean(axis=0), "drinking", reach=24)]
    assert water.sum() > 150
    red, _, blue = wet[around(full.particles[0].mean(axis=0), "drinking", reach=24)][water].mean(axis=0)
    assert blue > red + 60


def test_two_skin_tones_differ_in_the_face_only_and_share_the_still_picture(
    renderer: ClipRenderer, monkeypatch: pytest.MonkeyPatch
) -> None:
    light = film(renderer, waving_trajectory(1, skin_tone=0))[0]
    drawn: list[int] = []
    still = compositing.View.still

    def noted(view: compositing.View, stage: MeshSet) -> Shot:
        drawn.append(view.width)
        return still(view, stage)

    monkeypatch.setattr(compositing.View, "still", noted)
    dark = film(renderer, waving_trajectory(1, skin_tone=5))[0]
    assert drawn == [renderer.style.inset_size[0]]
    trajectory = waving_trajectory(1)
    assert different(light, dark, by=60)[around(trajectory.target_m[0] + [0.03, 0.0, 0.0])].mean() > 0.5
    assert not different(light, dark)[200:300, :200].any()


def test_two_bodies_differ(plain: ClipRenderer, usual: Picture) -> None:
    slim = film(plain, waving_trajectory(1, body="slim"))[0]
    assert different(usual, slim).mean() > 0.05


def test_the_persons_arms_are_where_the_trajectory_says(plain: ClipRenderer, usual: Picture) -> None:
    raised = waving_trajectory(1)
    raised.arm_positions_rad[:, RIGHT, 0] += 0.5
    changed = different(usual, film(plain, raised)[0])
    assert changed[300:, 250:450].any()
    assert not changed[:220, 230:].any()


def redness(picture: Picture, place: tuple[slice, slice]) -> float:
    red, green, _ = picture[place].astype(float).mean(axis=(0, 1))
    return float(red - green)


def test_the_itch_is_marked_on_the_skin_and_moves_with_the_arm(plain: ClipRenderer) -> None:
    trajectory = itching_trajectory(3, lift_rad=0.35)
    frames = film(plain, trajectory)
    before, after = (around(trajectory.target_m[step], "scratching", reach=5) for step in (0, 2))
    assert redness(frames[0], before) > redness(frames[0], after) + 25
    assert redness(frames[-1], after) > redness(frames[-1], before) + 25


def test_an_arm_at_rest_looks_as_it_does_at_the_start_of_a_movement(plain: ClipRenderer) -> None:
    resting, rising = (film(plain, itching_trajectory(1, lift_rad))[0] for lift_rad in (0.0, 0.1))
    assert different(resting, rising, by=40).mean() < 0.004


def test_a_trembling_head_is_drawn_moving(plain: ClipRenderer) -> None:
    trajectory = waving_trajectory(2)
    trajectory.head_quaternions[1:] = [0.0, 0.0, np.sin(0.1), np.cos(0.1)]
    trembling, still = film(plain, trajectory), film(plain, waving_trajectory(2))
    face = around(trajectory.target_m[0], reach=30)
    assert different(trembling[0], trembling[-1])[face].mean() > 0.2
    assert not different(still[0], still[-1])[face].any()
    assert different(trembling[0], still[0], by=40)[face].mean() < 0.03


def test_a_task_nobody_designed_a_look_for_is_filmed_all_the_same(scene: Scene, usual: Picture) -> None:
    comb = Tool("comb", (0.13, 0, 0), (-np.pi / 2, 0, 0), (Shape.box((0, 0, 0), (0.06, 0.03, 0.03)),), 0.03)
    combing = ClipRenderer(lambda name: FilmedTask(JACO, comb, TaskLook()), PLAIN, scene)
    with_comb = film(combing, replace(waving_trajectory(1), task="combing"))[0]
    comb_m = clip_motion(waving_trajectory(1), JACO, comb, 0, 1, 15).frames[0, -1, :3, 3]
    assert different(with_comb, usual)[around(comb_m, reach=4)].mean() > 0.7
    assert not different(with_comb, usual)[:, 400:].any()


def test_pressing_warms_the_frame_of_the_inset(renderer: ClipRenderer) -> None:
    x, y = INSET_MARGIN_PX - 2, INSET_MARGIN_PX + 40
    calm, pressing = (pictures(renderer, force)[-1][y, x].astype(int) for force in (0.0, 15.0))
    assert (calm == 255).all()
    assert pressing == pytest.approx(np.array(Highlight.WARM), abs=2)


def test_a_light_touch_is_not_marked(renderer: ClipRenderer) -> None:
    assert (pictures(renderer, 1.5, steps=1)[-1] == pictures(renderer, steps=1)[-1]).all()


def test_turning_the_head_moves_the_face_and_leaves_the_arm(plain: ClipRenderer, usual: Picture) -> None:
    ahead, aside = waving_trajectory(1), waving_trajectory(1)
    aside.head_quaternions[:] = [0.0, 0.0, np.sin(0.2), np.cos(0.2)]
    changed = different(usual, film(plain, aside)[0], by=8)
    assert changed[around(ahead.target_m[0], reach=30)].mean() > 0.2
    assert not changed[250:, :200].any()


def test_a_style_without_inset_shows_the_room_in_the_corner(usual: Picture) -> None:
    assert usual[:30, :30].std(axis=(0, 1)).max() < 6


def test_many_clips_do_not_use_more_memory(renderer: ClipRenderer) -> None:
    def resident_pages() -> int:
        with open("/proc/self/statm") as statm:  # noqa: PTH123 -- not a file on disk
            return int(statm.read().split()[1])

    pictures(renderer, steps=1)
    before = resident_pages()
    for _ in range(6):
        pictures(renderer, steps=1)
    grown_mib = (resident_pages() - before) * 4096 / 2**20
    assert grown_mib < 12
