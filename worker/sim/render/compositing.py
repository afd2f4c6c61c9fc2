"""One view of the scene, composed in layers: a still picture, soft moving shadows, and the moving parts on top.

The still picture is drawn once, and what of the person keeps still during a clip is added to it once per clip. Per
frame only the rectangles that hold moving parts are drawn, with an off-centre frustum, and merged by depth; the shadow
they cast comes from a small depth map seen from the lamp, looked up through a table made once per clip (TinyRenderer's
own shadows are wrong when cropped).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageChops, ImageFilter

from worker.domain.type_aliases import FloatArray
from worker.sim.render import skin
from worker.sim.render.camera import Camera, Rectangle
from worker.sim.render.mesh_set import MeshSet
from worker.sim.render.passes import (
    WATER_LIGHT,
    Colours,
    Depth,
    Frame,
    Part,
    Shot,
    Supersampling,
    as_layer,
    as_mask,
    distance_m,
    photograph,
    resampled,
    seen_from_lamp,
)
from worker.sim.render.rectangles import Pixels, cover, on_grid

STILL_LAMP_SIZE, MOVING_LAMP_SIZE = 640, 176

STILL_SHADOW_BLUR_M, MOVING_SHADOW_BLUR_M, SKIN_SHADOW_BLUR_M = 0.002, 0.0036, 0.003
"""Radius of a shadow's soft edge; of moving ones on a grid of half the picture's."""
EDGE_BLUR_PX = 0.3
"""Smooths the edges of moving parts for less than half of what more pixels would cost."""
CLEAR_SHARPNESS = 0.64
"""Water and glass are drawn on a coarser grid: the one is blurred anyway, the other is faint."""
GLASS_OPACITY = 0.34

BACKDROP = (190, 203, 200)
"""Where a close-up sees past the room's two walls."""
BEYOND_DEPTH = 0.99999
"""Nothing is drawn deeper: the software renderer leaves slightly less than 1 where it draws nothing."""

HEAD_RADIUS_M = 0.20
"""Everything of head and arms this close to the middle of the head is head or neck."""


class Portrait(NamedTuple):
    """A moving part of the person as drawn last, and where its pixels, on half the grid, lie in the lamp's map."""

    pose: int
    rgba: Colours
    depth: Depth
    coarse: tuple[int, int]
    texel: npt.NDArray[np.int32]
    limit: npt.NDArray[np.float32]


class View:
    """What one camera sees."""

    def __init__(self, camera: Camera, fine: Supersampling) -> None:
        self._camera, self._supersampling = camera, fine
        self.width, self.height = camera.width, camera.height
        self._whole = (0.0, 0.0, float(camera.width), float(camera.height))
        self._pixels_per_m = camera.pixels_per_m(np.asarray(camera.target_m))
        self._portraits: dict[Rectangle, Portrait] = {}

    def still(self, stage: MeshSet) -> Shot:
        """What never moves, drawn to be kept for many clips."""
        share = self._supersampling.still
        shot = photograph(stage, self._camera, self._whole, round(self.width * share), round(self.height * share))
        beyond = shot.depth > BEYOND_DEPTH
        shot.lit[beyond] = shot.shadowed[beyond] = BACKDROP
        return shot

    def start(self, still: Shot, resting: Sequence[Part], itch_m: FloatArray | None, lamp_depth: Depth) -> None:
        """Prepare a clip: add what rests during it, cast the still shadows, make the tables for the moving ones."""
        shot = still.copy()
        bright: npt.NDArray[np.bool_] = np.zeros(shot.depth.shape, dtype=np.bool_)
        for part in resting:
            self._add(shot, part, itch_m, bright)
        share = self._supersampling.moving
        self._depth = resampled(shot.depth, round(self.height * share), round(self.width * share))
        depth = resampled(shot.depth, self.height, self.width)
        texel, limit = seen_from_lamp(self._camera, self._whole, depth, STILL_LAMP_SIZE)
        dark = (lamp_depth.ravel()[texel] < limit).reshape(depth.shape)
        dark &= ~resampled(bright, self.height, self.width)
        mask = as_mask(dark).filter(ImageFilter.BoxBlur(STILL_SHADOW_BLUR_M * self._pixels_per_m))
        self._background, dim = self._reduced(shot.lit), self._reduced(shot.shadowed)
        self._background.paste(dim, (0, 0), mask)
        self._background_shadowed = ImageChops.darker(dim, self._background)
        coarse = resampled(shot.depth, self.height // 2, self.width // 2)
        self._texel, self._limit = seen_from_lamp(self._camera, self._whole, coarse, MOVING_LAMP_SIZE)

    def frame(self, frame: Frame) -> Image.Image:
        """One picture."""
        picture = self._background.copy()
        self._cast_shadows(picture, frame.lamp_depth)
        covered = []
        for part in frame.parts:
            for pixels in cover(self._camera.boxes(part.corners_m), self.width, self.height):
                if part.prepare:
                    part.prepare()
                place = _on_grid_of(self._supersampling.moving, pixels)
                before = self._depth[place].copy()
                layer = self._layer(part, pixels, place, frame)
                picture.paste(layer, pixels[:2], layer)
                covered.append((place, before))
        for place, before in reversed(covered):
            self._depth[place] = before
        return picture

    def _reduced(self, colours: Colours) -> Image.Image:
        """Supersampled colours as a picture of this view's size."""
        return Image.fromarray(colours).resize((self.width, self.height), Image.Resampling.HAMMING)

    def _add(self, shot: Shot, part: Part, itch_m: FloatArray | None, bright: npt.NDArray[np.bool_]) -> None:
        """Draw a part into the still picture, and note in ``bright`` (h, w) where no still shadow falls."""
        boxes = self._camera.boxes(part.corners_m)
        whole = np.concatenate([boxes[:, :2].min(axis=0), boxes[:, 2:].max(axis=0)])
        left, top, right, bottom = pixels = on_grid(whole, self.width, self.height)
        if right <= left or bottom <= top:
            return
        rectangle, place = _as_rectangle(pixels), _on_grid_of(self._supersampling.still, pixels)
        height, width = shot.depth[place].shape
        own = photograph(part.stage, self._camera, rectangle, width, height)
        if part.alive and itch_m is not None:
            for colours in (own.lit, own.shadowed):
                skin.mark_itch(colours, own.depth, self._camera, rectangle, itch_m)
        nearer = shot.merge(own, place)
        if part.head_m is not None:
            on_head = distance_m(self._camera, rectangle, own.depth, part.head_m) < HEAD_RADIUS_M
            bright[place] = np.where(nearer, on_head, bright[place])

    def _cast_shadows(self, picture: Image.Image, lamp_depth: Depth) -> None:
        dark = lamp_depth.ravel()[self._texel] < self._limit
        mask = as_mask(dark.reshape(self.height // 2, self.width // 2))
        found = mask.getbbox()
        if found is None:
            return
        margin = 8
        x0, y0 = max(0, found[0] - margin), max(0, found[1] - margin)
        x1, y1 = min(self.width // 2, found[2] + margin), min(self.height // 2, found[3] + margin)
        soft = mask.crop((x0, y0, x1, y1)).filter(ImageFilter.BoxBlur(MOVING_SHADOW_BLUR_M * self._pixels_per_m))
        full = (2 * x0, 2 * y0, 2 * x1, 2 * y1)
        soft = soft.resize((full[2] - full[0], full[3] - full[1]), Image.Resampling.BILINEAR)
        picture.paste(self._background_shadowed.crop(full), full[:2], soft)

    def _layer(self, part: Part, pixels: Pixels, place: tuple[slice, slice], frame: Frame) -> Image.Image:
        """What is visible of a part in a rectangle; what is not clear hides whatever is drawn after it behind it."""
        size = (pixels[2] - pixels[0], pixels[3] - pixels[1])
        rectangle, before = _as_rectangle(pixels), self._depth[place]
        if part.drops_m or part.glass:
            return self._clear(part, rectangle, size, before)
        height, width = before.shape
        if part.alive:
            colours, depth = self._alive(part, rectangle, (height, width), frame)
        else:
            colours, depth = part.stage.draw_raw(self._camera, rectangle, width, height, part.light)
        layer = as_layer(colours, depth < before).filter(ImageFilter.BoxBlur(EDGE_BLUR_PX))
        self._depth[place] = np.minimum(depth, before)
        return layer.resize(size, Image.Resampling.HAMMING).convert("RGBA")

    def _clear(self, part: Part, rectangle: Rectangle, size: tuple[int, int], before: Depth) -> Image.Image:
        """Balls of water run together: blurred, and cut off where little of them is left. Glass is faint."""
        share = self._supersampling.moving * CLEAR_SHARPNESS
        width, height = max(1, round(size[0] * share)), max(1, round(size[1] * share))
        light = part.light if part.glass else WATER_LIGHT
        rgba, depth = part.stage.draw_raw(self._camera, rectangle, width, height, light)
        layer = as_layer(rgba, depth < resampled(before, height, width))
        if not part.glass:
            for _ in range(2):
                layer = layer.filter(ImageFilter.BoxBlur(0.42 * part.drops_m * self._pixels_per_m * share))
        layer = layer.resize(size, Image.Resampling.BICUBIC).convert("RGBA")
        layer.putalpha(layer.getchannel("A").point(_GLASS_ALPHA if part.glass else _WATER_ALPHA))
        return layer

    def _alive(self, part: Part, rectangle: Rectangle, shape: tuple[int, int], frame: Frame) -> tuple[Colours, Depth]:
        """A moving part of the person with shadow and itch on it: colours (h, w, 4) and depth (h, w)."""
        height, width = shape
        portrait = self._portraits.get(rectangle)
        if portrait is None or portrait.pose != part.pose:
            rgba, depth = part.stage.draw_raw(self._camera, rectangle, width, height, part.light)
            half = max(1, height // 2), max(1, width // 2)
            seen = seen_from_lamp(self._camera, rectangle, resampled(depth, *half), MOVING_LAMP_SIZE)
            portrait = self._portraits[rectangle] = Portrait(part.pose, rgba.copy(), depth.copy(), half, *seen)
            if frame.itch_m is not None:
                skin.mark_itch(portrait.rgba[..., :3], portrait.depth, self._camera, rectangle, frame.itch_m)
        colours = portrait.rgba.copy()
        dark = (frame.lamp_depth.ravel()[portrait.texel] < portrait.limit).reshape(portrait.coarse)
        skin.shade(
            colours[..., :3], as_mask(dark), SKIN_SHADOW_BLUR_M * self._pixels_per_m * self._supersampling.moving
        )
        return colours, portrait.depth


_WATER_ALPHA = [round(min(1.0, max(0.0, (alpha / 255 - 0.34) / 0.30)) * 245) for alpha in range(256)]
"""Opacity of water for each opacity of its blurred balls."""
_GLASS_ALPHA = [round(GLASS_OPACITY * alpha) for alpha in range(256)]


def _as_rectangle(pixels: Pixels) -> Rectangle:
    left, top, right, bottom = pixels
    return float(left), float(top), float(right), float(bottom)


def _on_grid_of(supersampling: float, pixels: Pixels) -> tuple[slice, slice]:
    """A rectangle on a supersampled grid."""
    left, top, right, bottom = (round(value * supersampling) for value in pixels)
    return slice(top, bottom), slice(left, right)
