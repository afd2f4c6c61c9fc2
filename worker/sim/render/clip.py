"""A piece of a trajectory as a short, calm video clip."""

from collections import OrderedDict
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import chain, repeat
from typing import NamedTuple

import numpy as np
from PIL import Image

from worker.domain.trajectory import Trajectory
from worker.sim.arm import RobotArm, Tool
from worker.sim.render import video
from worker.sim.render.camera import Camera, scene_camera
from worker.sim.render.close_up import close_up
from worker.sim.render.compositing import View
from worker.sim.render.highlight import Highlight
from worker.sim.render.interpolation import clip_motion, frame_count
from worker.sim.render.moving_parts import FilmedPerson, Shoot, moving_lamp_depth, moving_parts, still_lamp_depth
from worker.sim.render.passes import Depth, Frame, Shot, Supersampling
from worker.sim.render.scene import Scene
from worker.sim.render.task_look import TaskLook

STILL_PICTURES = 4
"""So many still pictures of 7 MB are kept, one per task and body."""


ANTI_ALIASED = Supersampling(still=1.5, moving=1.0)


@dataclass(frozen=True)
class RenderStyle:
    """How clips look. Sides of the picture are multiples of 80, so that everything falls on whole pixels."""

    fps: int = 25
    width: int = 960
    height: int = 720
    supersampling: Supersampling = ANTI_ALIASED
    inset: bool = True
    highlight_pressing: bool = True
    rate_factor: int = video.CONSTANT_RATE_FACTOR

    @property
    def inset_size(self) -> tuple[int, int]:
        """Width and height of the close-up in the corner, a third of the picture's."""
        return self.width // 80 * 26, self.height // 60 * 19 // 2 * 2

    @property
    def scale(self) -> float:
        """How large fixed marks are drawn, relative to a picture 640 pixels wide."""
        return self.width / 640


STYLES = {"sharp": RenderStyle(), "quick": RenderStyle(fps=15, width=640, height=480, rate_factor=30)}
"""By the name of a study's clip quality. A quick clip takes less than half of a sharp one's time, and is small: at a
rate factor of 30 a third smaller than at 26, while stills of both cannot be told apart."""


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


class FilmedTask(NamedTuple):
    """What a renderer has to know of a task."""

    robot: RobotArm
    tool: Tool
    look: TaskLook


class ClipRenderer:
    """Draws clips of any task one after the other. What it draws it makes when it is first needed, and keeps."""

    def __init__(
        self, tasks: Callable[[str], FilmedTask], style: RenderStyle = RenderStyle(), scene: Scene | None = None
    ) -> None:
        """``tasks`` finds one by its name; ``scene``: one that several renderers of a process draw from, by turns."""
        self.style = style
        self._task = tasks
        self._scene = scene or Scene()
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
            video=video.encode_mp4(chain([first], frames), style.width, style.height, style.fps, style.rate_factor),
            poster=video.encode_poster(first),
            width=style.width,
            height=style.height,
            fps=style.fps,
            n_frames=count,
            duration_ms=round(1000 * count / style.fps),
        )

    def pictures(self, trajectory: Trajectory, first_step: int, n_steps: int) -> Iterator[Image.Image]:
        """The frames of steps first_step to first_step + n_steps, one after the other."""
        robot, tool, look = self._task(trajectory.task)
        motion = clip_motion(trajectory, robot, tool, first_step, n_steps, self.style.fps)
        kit = self._scene.kit(trajectory.task, robot, tool, look)
        kit.take(motion.particles_m.shape[1])
        sitter = self._scene.sitter(motion.body)
        sitter.sit(motion.skin_tone, look.mouth, kit.base)
        yield from self._film(Shoot(look, kit, sitter, motion), trajectory.task)

    def _film(self, shoot: Shoot, task: str) -> Iterator[Image.Image]:
        style, motion = self.style, shoot.motion
        camera = scene_camera(shoot.look, style.width, style.height)
        main, still = self._main_view(camera, task, shoot.sitter.body.name)
        inset = View(close_up(shoot.look, motion, *style.inset_size), style.supersampling) if style.inset else None
        inset_still = inset.still(self._scene.stages.still) if inset else None
        person = FilmedPerson(shoot, self._scene.stages.still)
        lamp_depth = np.minimum(still.lamp_depth, person.lamp_depth())
        resting, itch_m = person.resting(), motion.target_m[0] if shoot.look.itch else None
        main.start(still.picture, resting, itch_m, lamp_depth)
        if inset and inset_still:
            inset.start(inset_still, resting, itch_m, lamp_depth)
        force_n = motion.force_n if style.highlight_pressing else np.zeros(len(motion))
        highlight = Highlight(camera, force_n, motion.frames[:, -1, :3, 3], motion.target_m, style.scale)
        stretches = motion.stretches()
        drawn = [each.start for each in stretches]
        for alike, index, parts in zip(stretches, drawn, moving_parts(shoot, drawn), strict=True):
            itch_m = motion.target_m[index] if shoot.look.itch else None
            frame = Frame([*person.moving(index), *parts], moving_lamp_depth(shoot.kit), itch_m)
            picture = main.frame(frame)
            highlight.draw(picture, index)
            if inset:
                _paste_inset(picture, inset.frame(frame), shoot.look, highlight.border(index), style.scale)
            yield from repeat(picture, len(alike))

    def _main_view(self, camera: Camera, task: str, body: str) -> tuple[View, Still]:
        """The whole picture, and what never moves in it, from memory if it was drawn lately."""
        view, key = View(camera, self.style.supersampling), (task, body)
        if key not in self._stills:
            still = self._scene.stages.still
            self._stills[key] = Still(view.still(still), still_lamp_depth(still))
        self._stills.move_to_end(key)
        while len(self._stills) > STILL_PICTURES:
            self._stills.popitem(last=False)
        return view, self._stills[key]


INSET_MARGIN_PX, INSET_BORDER_PX = 11, 3
"""In a picture 640 pixels wide."""


def _paste_inset(
    picture: Image.Image, inset: Image.Image, look: TaskLook, border: tuple[int, int, int], scale: float
) -> None:
    edge, y = round(INSET_BORDER_PX * scale), round(INSET_MARGIN_PX * scale)
    x = picture.width - inset.width - y if look.inset_on_right else y
    picture.paste(border, (x - edge, y - edge, x + inset.width + edge, y + inset.height + edge))
    picture.paste(inset, (x, y))
