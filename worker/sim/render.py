"""A piece of a trajectory as a short, calm video clip."""

from collections import OrderedDict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import chain
from typing import NamedTuple

import numpy as np
from PIL import Image

from worker.sim import video
from worker.sim.assistive import AssistiveEnv
from worker.sim.camera import Camera, Rectangle, scene_camera
from worker.sim.catalogue import ENVIRONMENTS
from worker.sim.highlight import Highlight
from worker.sim.layers import View
from worker.sim.motion import clip_motion, frame_count
from worker.sim.scene import Scene
from worker.sim.shoot import Person, Shoot, moving_lamp_depth, moving_parts, still_lamp_depth
from worker.sim.shots import Depth, Frame, Shot, Supersampling
from worker.sim.solids import Array
from worker.sim.task_look import task_look
from worker.trajectory import Trajectory

STILL_PICTURES = 4
"""So many still pictures of 7 MB are kept, one per task and body."""


ANTI_ALIASED = Supersampling(still=1.5, moving=1.0)


@dataclass(frozen=True)
class RenderStyle:
    """How clips look."""

    fps: int = 15
    width: int = 640
    height: int = 480
    supersampling: Supersampling = ANTI_ALIASED
    inset: bool = True
    inset_width: int = 208
    inset_height: int = 156
    highlight_pressing: bool = True


@dataclass(frozen=True)
class RenderedClip:
    """A finished clip."""

    video: bytes
    """MP4 (H.264, yuv420p), playable while it loads"""
    poster: bytes
    """JPEG of the first frame"""
    width: int
    height: int
    fps: int
    n_frames: int
    duration_ms: int


class Still(NamedTuple):
    """What never moves while one body is filmed in one task."""

    picture: Shot
    lamp_depth: Depth


class ClipRenderer:
    """Draws clips of any task one after the other. What it draws it makes when it is first needed, and keeps."""

    def __init__(
        self, style: RenderStyle = RenderStyle(), environments: Mapping[str, type[AssistiveEnv]] = ENVIRONMENTS
    ) -> None:
        self.style = style
        self._environments = environments
        self._scene = Scene()
        self._stills: OrderedDict[tuple[str, str], Still] = OrderedDict()

    def close(self) -> None:
        """Free the drawing clients."""
        self._scene.close()

    def render_clip(self, trajectory: Trajectory, first_step: int, n_steps: int) -> RenderedClip:
        """The video of steps first_step to first_step + n_steps. Raises ValueError when they do not exist."""
        style = self.style
        frames = (np.asarray(picture) for picture in self.pictures(trajectory, first_step, n_steps))
        first = next(frames)
        count = frame_count(n_steps, style.fps)
        return RenderedClip(
            video=video.encode_mp4(chain([first], frames), style.width, style.height, style.fps),
            poster=video.encode_poster(first),
            width=style.width,
            height=style.height,
            fps=style.fps,
            n_frames=count,
            duration_ms=round(1000 * count / style.fps),
        )

    def pictures(self, trajectory: Trajectory, first_step: int, n_steps: int) -> Iterator[Image.Image]:
        """The frames of steps first_step to first_step + n_steps, one after the other."""
        env = self._environments[trajectory.task]
        motion = clip_motion(trajectory, env.robot, env.tool, first_step, n_steps, self.style.fps)
        look = task_look(trajectory.task)
        kit = self._scene.kit(trajectory.task, env.robot, env.tool, look)
        kit.take(motion.particles_m.shape[1])
        sitter = self._scene.sitter(motion.body)
        sitter.sit(motion.skin_tone, kit.base)
        camera = scene_camera(look, self.style.width, self.style.height)
        yield from self._film(Shoot(camera, look, kit, sitter, motion), trajectory.task)

    def _film(self, shoot: Shoot, task: str) -> Iterator[Image.Image]:
        style, motion = self.style, shoot.motion
        main, still = self._main_view(shoot, task)
        inset = self._inset(shoot) if style.inset else None
        inset_still = inset.still(self._scene.stages.still) if inset else None
        person = Person(shoot, self._scene.stages.still)
        lamp_depth = np.minimum(still.lamp_depth, person.lamp_depth())
        resting, itch_m = person.resting(), motion.target_m[0] if shoot.look.itch else None
        main.start(still.picture, resting, itch_m, lamp_depth)
        if inset and inset_still:
            inset.start(inset_still, resting, itch_m, lamp_depth)
        force_n = motion.force_n if style.highlight_pressing else np.zeros(len(motion))
        highlight = Highlight(shoot.camera, force_n, motion.frames[:, -1, :3, 3], motion.target_m)
        for index, parts in enumerate(moving_parts(shoot)):
            itch_m = motion.target_m[index] if shoot.look.itch else None
            frame = Frame([*person.moving(index), *parts], moving_lamp_depth(shoot.kit), itch_m)
            picture = main.frame(frame)
            highlight.draw(picture, index)
            if inset:
                near = frame._replace(parts=[part for part in frame.parts if part.stage is not shoot.kit.upper])
                _paste_inset(picture, inset.frame(near), shoot.look.inset_on_right, highlight.border(index))
            yield picture

    def _main_view(self, shoot: Shoot, task: str) -> tuple[View, Still]:
        """The whole picture, and what never moves in it, from memory if it was drawn lately."""
        style, key = self.style, (task, shoot.sitter.body.name)
        whole = (0.0, 0.0, float(style.width), float(style.height))
        view = View(shoot.camera, whole, style.width, style.height, style.supersampling)
        if key not in self._stills:
            still = self._scene.stages.still
            self._stills[key] = Still(view.still(still), still_lamp_depth(still))
        self._stills.move_to_end(key)
        while len(self._stills) > STILL_PICTURES:
            self._stills.popitem(last=False)
        return view, self._stills[key]

    def _inset(self, shoot: Shoot) -> View:
        style, look = self.style, shoot.look
        width, height = style.inset_width / look.inset_zoom, style.inset_height / look.inset_zoom
        rectangle = _around(shoot.camera, shoot.motion.target_m[0], (width, height), look.inset_focus)
        return View(shoot.camera, rectangle, style.inset_width, style.inset_height, style.supersampling)


INSET_MARGIN_PX, INSET_BORDER_PX = 11, 3


def _paste_inset(picture: Image.Image, inset: Image.Image, on_right: bool, border: tuple[int, int, int]) -> None:
    edge, y = INSET_BORDER_PX, INSET_MARGIN_PX
    x = picture.width - inset.width - y if on_right else y
    picture.paste(border, (x - edge, y - edge, x + inset.width + edge, y + inset.height + edge))
    picture.paste(inset, (x, y))


def _around(camera: Camera, target_m: Array, size: tuple[float, float], focus: tuple[float, float]) -> Rectangle:
    """A part of the picture of this size with the target at these shares of its width and height."""
    x, y = camera.pixels(target_m).tolist()
    width, height = size
    left = min(max(0.0, x - focus[0] * width), camera.width - width)
    top = min(max(0.0, y - focus[1] * height), camera.height - height)
    return left, top, left + width, top + height
