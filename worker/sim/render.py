"""A piece of a trajectory as a short, calm video clip."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from PIL import Image

from worker.sim import video
from worker.sim.camera import Camera, Rectangle, lamp, scene_camera
from worker.sim.food import BALL_RADIUS_M, BALLS
from worker.sim.highlight import Highlight
from worker.sim.human import NECK_PIVOT_M
from worker.sim.layers import DEPTH_ONLY, MOVING_LAMP_SIZE, STILL_LAMP_SIZE, View
from worker.sim.motion import Motion, clip_motion, quaternions
from worker.sim.rectangles import Pixels
from worker.sim.scene import GONE_M, HAND_PARTS, UPPER_ARM, Scene, Stage, food_name
from worker.sim.solids import Array
from worker.trajectory import Trajectory

HEAD_EXTENT_M = np.array([[x, y, z] for x in (-0.15, 0.15) for y in (-0.16, 0.16) for z in (-0.12, 0.27)])
"""Corners of a box that holds the head however it is turned, around the neck pivot."""


@dataclass(frozen=True)
class RenderStyle:
    """How clips look."""

    fps: int = 15
    width: int = 640
    height: int = 480
    supersampling: float = 1.25
    inset: bool = True
    inset_width: int = 208
    inset_height: int = 156
    inset_zoom: float = 2.3
    highlight_pressing: bool = True
    food_scale: float = 1.3


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


class ClipRenderer:
    """Draws clips one after the other. Building one takes about a second; keep it for the life of the process."""

    def __init__(self, style: RenderStyle = RenderStyle()) -> None:
        self.style = style
        self._camera = scene_camera(style.width, style.height)
        self._scene = Scene(BALLS, BALL_RADIUS_M * style.food_scale)
        whole = (0.0, 0.0, float(style.width), float(style.height))
        self._main = View(self._camera, whole, style.width, style.height, style.supersampling, self._scene.still)
        self._still_lamp_depth = self._lamp_depth(self._scene.still)
        self._parts = self._scene.boxes.names
        self._hand = [self._parts.index(name) for name in HAND_PARTS]

    def close(self) -> None:
        """Free the drawing clients."""
        self._scene.close()

    def render_clip(self, trajectory: Trajectory, first_step: int, n_steps: int) -> RenderedClip:
        """The video of steps first_step to first_step + n_steps. Raises ValueError when they do not exist."""
        style = self.style
        motion = clip_motion(trajectory, first_step, n_steps, style.fps)
        frames = [np.asarray(picture) for picture in self.pictures(motion)]
        return RenderedClip(
            video=video.encode_mp4(frames, style.width, style.height, style.fps),
            poster=video.encode_poster(frames[0]),
            width=style.width,
            height=style.height,
            fps=style.fps,
            n_frames=len(frames),
            duration_ms=round(1000 * len(frames) / style.fps),
        )

    def pictures(self, motion: Motion) -> Iterator[Image.Image]:
        """The frames of a motion, one after the other."""
        style, scene = self.style, self._scene
        scene.turn_head(motion.head_quaternion.tolist())
        head_box, lamp_depth = self._head_box(), np.minimum(self._still_lamp_depth, self._lamp_depth(scene.head))
        self._main.start(scene.head, head_box, lamp_depth)
        inset = self._inset(motion.mouth_m, head_box, lamp_depth) if style.inset else None
        boxes, first_food = self._moving_boxes(motion), len(self._parts)
        turns = quaternions(motion.frames[..., :3, :3])
        force_n = motion.force_n if style.highlight_pressing else np.zeros(len(motion))
        highlight = Highlight(self._camera, force_n, motion.frames[:, -1], motion.mouth_m)
        for index in range(len(motion)):
            self._pose(motion, turns, index)
            shadows = self._moving_lamp_depth()
            picture = self._main.frame(self._reaching(boxes[index]), shadows)
            highlight.draw(picture, index)
            if inset is not None:
                near_mouth = np.concatenate([boxes[index, self._hand], boxes[index, first_food:]])
                _paste_inset(picture, inset.frame([(scene.hand, near_mouth)], shadows), highlight.border(index))
            yield picture

    def _moving_lamp_depth(self) -> npt.NDArray[np.float32]:
        size = MOVING_LAMP_SIZE
        return self._scene.casters.draw_raw(lamp(size), None, size, size, DEPTH_ONLY)[1]

    def _lamp_depth(self, stage: Stage) -> npt.NDArray[np.float32]:
        """Depth of a still stage as the lamp sees it."""
        return stage.draw(lamp(STILL_LAMP_SIZE), None, STILL_LAMP_SIZE, STILL_LAMP_SIZE, DEPTH_ONLY).depth

    def _head_box(self) -> Pixels:
        corners = self._camera.pixels(np.asarray(NECK_PIVOT_M) + HEAD_EXTENT_M)
        x0, y0 = np.floor(corners.min(axis=0))
        x1, y1 = np.ceil(corners.max(axis=0))
        return int(x0), int(y0), int(x1), int(y1)

    def _inset(self, mouth_m: Array, head_box: Pixels, lamp_depth: npt.NDArray[np.float32]) -> View:
        style = self.style
        rectangle = _around(
            self._camera, mouth_m, style.inset_width / style.inset_zoom, style.inset_height / style.inset_zoom
        )
        view = View(
            self._camera, rectangle, style.inset_width, style.inset_height, style.supersampling, self._scene.still
        )
        view.start(self._scene.head, head_box, lamp_depth)
        return view

    def _reaching(self, boxes: Array) -> list[tuple[Stage, Array]]:
        """The moving stages with the boxes (K, 4) of what is in them."""
        upper = len(UPPER_ARM)
        return [(self._scene.upper_arm, boxes[:upper]), (self._scene.forearm, boxes[upper:])]

    def _moving_boxes(self, motion: Motion) -> Array:
        """Where every link and piece of food is in every frame (N, L + P, 4), in pixels."""
        corners = np.einsum("nlij,lcj->nlci", motion.frames[..., :3, :3], self._scene.boxes.corners_m)
        pixels = self._camera.pixels(corners + motion.frames[:, :, None, :3, 3])
        links = np.concatenate([pixels.min(axis=2) - 1.5, pixels.max(axis=2) + 1.5], axis=-1)
        centre = self._camera.pixels(np.where(np.isnan(motion.food_m), GONE_M, motion.food_m))
        gone = np.isnan(motion.food_m).any(axis=-1)
        food = np.concatenate([centre - 8, centre + 8], axis=-1)
        food[gone] = 0.0
        return np.concatenate([links, food], axis=1)

    def _pose(self, motion: Motion, turns: Array, index: int) -> None:
        scene = self._scene
        for part, name in enumerate(self._parts):
            place, turn = motion.frames[index, part, :3, 3].tolist(), turns[index, part].tolist()
            (scene.upper_arm if name in UPPER_ARM else scene.forearm).place(name, place, turn)
            scene.casters.place(name, place, turn)
            if name in HAND_PARTS:
                scene.hand.place(name, place, turn)
        for food, place_m in enumerate(motion.food_m[index, :BALLS]):
            where = GONE_M if np.isnan(place_m).any() else place_m.tolist()
            scene.forearm.place(food_name(food), where, (0, 0, 0, 1))
            scene.hand.place(food_name(food), where, (0, 0, 0, 1))


INSET_CORNER_PX = (11, 11)
INSET_BORDER_PX = 3


def _paste_inset(picture: Image.Image, inset: Image.Image, border: tuple[int, int, int]) -> None:
    x, y = INSET_CORNER_PX
    edge = INSET_BORDER_PX
    picture.paste(border, (x - edge, y - edge, x + inset.width + edge, y + inset.height + edge))
    picture.paste(inset, (x, y))


def _around(camera: Camera, mouth_m: Array, width: float, height: float) -> Rectangle:
    """A part of the picture with the mouth right of its middle, for the spoon comes from the left."""
    x, y = camera.pixels(mouth_m).tolist()
    left = min(max(0.0, x - 0.68 * width), camera.width - width)
    top = min(max(0.0, y - 0.46 * height), camera.height - height)
    return left, top, left + width, top + height
