"""Whole clips: what a participant would see, looked at as pixels."""

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt
import pytest

from tests.worker.waving import waving_trajectory
from worker.sim.camera import scene_camera
from worker.sim.highlight import Highlight
from worker.sim.human import MOUTH_FROM_NECK_M, NECK_PIVOT_M
from worker.sim.motion import clip_motion
from worker.sim.render import INSET_CORNER_PX, ClipRenderer, RenderStyle

Picture = npt.NDArray[np.uint8]


@pytest.fixture(scope="module")
def renderer() -> Iterator[ClipRenderer]:
    renderer = ClipRenderer()
    yield renderer
    renderer.close()


def pictures(renderer: ClipRenderer, force_n: float = 0.0, steps: int = 4, food: bool = True) -> list[Picture]:
    trajectory = waving_trajectory(steps, force_n)
    if not food:
        trajectory.particles[:] = np.nan
    motion = clip_motion(trajectory, 0, steps, renderer.style.fps)
    return [np.asarray(picture).copy() for picture in renderer.pictures(motion)]


def test_a_clip_reports_what_it_holds(renderer: ClipRenderer) -> None:
    clip = renderer.render_clip(waving_trajectory(8), 2, 4)
    assert (clip.width, clip.height, clip.fps, clip.n_frames, clip.duration_ms) == (640, 480, 15, 6, 400)
    assert clip.video.index(b"moov") < clip.video.index(b"mdat")
    assert clip.poster.startswith(b"\xff\xd8")


def test_rendering_twice_gives_identical_bytes(renderer: ClipRenderer) -> None:
    trajectory = waving_trajectory(5)
    first = renderer.render_clip(trajectory, 0, 5)
    renderer.render_clip(waving_trajectory(3, 9.0), 0, 3)
    assert renderer.render_clip(trajectory, 0, 5) == first


def test_only_the_arm_and_its_shadow_change_between_frames(renderer: ClipRenderer) -> None:
    first, *_, last = pictures(renderer)
    changed = (np.abs(first.astype(int) - last).max(axis=2) > 12).mean()
    assert 0.002 < changed < 0.25


def test_the_food_is_visible_on_the_spoon(renderer: ClipRenderer) -> None:
    with_food, without = pictures(renderer, steps=1)[0], pictures(renderer, steps=1, food=False)[0]
    different = np.abs(with_food.astype(int) - without).max(axis=2) > 40
    bowl = clip_motion(waving_trajectory(1), 0, 1, 15).frames[0, -1, :3, 3]
    x, y = scene_camera(640, 480).pixels(bowl).astype(int)
    assert different[y - 15 : y + 15, x - 20 : x + 20].sum() > 60
    assert not different[240:, 320:].any()


def test_pressing_warms_the_frame_of_the_inset(renderer: ClipRenderer) -> None:
    x, y = INSET_CORNER_PX[0] - 2, INSET_CORNER_PX[1] + 40
    calm, pressing = (pictures(renderer, force)[-1][y, x].astype(int) for force in (0.0, 15.0))
    assert (calm == 255).all()
    assert pressing == pytest.approx(np.array(Highlight.WARM), abs=2)


def test_a_light_touch_is_not_marked(renderer: ClipRenderer) -> None:
    assert (pictures(renderer, 1.5)[-1] == pictures(renderer, 0.0)[-1]).all()


def test_turning_the_head_moves_the_face_and_leaves_the_arm(renderer: ClipRenderer) -> None:
    ahead, aside = waving_trajectory(1), waving_trajectory(1)
    aside.head_quaternion[:] = [0.0, 0.0, np.sin(0.2), np.cos(0.2)]
    seen = []
    for trajectory in (ahead, aside):
        motion = clip_motion(trajectory, 0, 1, 15)
        seen.append(np.asarray(next(iter(renderer.pictures(motion)))).astype(int))
    different = np.abs(seen[0] - seen[1]).max(axis=2) > 8
    x, y = scene_camera(640, 480).pixels(np.asarray(NECK_PIVOT_M) + MOUTH_FROM_NECK_M).astype(int)
    assert different[y - 30 : y + 30, x - 30 : x + 30].mean() > 0.2
    assert not different[250:, :200].any()


def test_a_style_without_inset_shows_the_room_in_the_corner() -> None:
    plain = ClipRenderer(RenderStyle(inset=False, supersampling=1.25))
    picture = pictures(plain, steps=1)[0]
    plain.close()
    assert picture[:30, :30].std(axis=(0, 1)).max() < 6


def test_many_clips_do_not_use_more_memory(renderer: ClipRenderer) -> None:
    def resident_pages() -> int:
        with open("/proc/self/statm") as statm:  # noqa: PTH123 -- not a file on disk
            return int(statm.read().split()[1])

    pictures(renderer)
    before = resident_pages()
    for _ in range(6):
        pictures(renderer)
    grown_mib = (resident_pages() - before) * 4096 / 2**20
    assert grown_mib < 12
