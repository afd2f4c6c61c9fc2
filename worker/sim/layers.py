"""One view of the scene, composed in layers: a still picture, soft moving shadows, and the moving parts on top.

The still picture is drawn once, and the head in it once per clip. Per frame only the rectangles that hold moving
parts are drawn, with an off-centre frustum, and merged by depth; the shadow they cast comes from a small depth map
seen from the lamp, looked up through a table made once per clip (TinyRenderer's own shadows are wrong when cropped).
"""

from collections.abc import Sequence
from typing import NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageChops, ImageFilter

from worker.sim.camera import Camera, Rectangle, lamp
from worker.sim.rectangles import Pixels, cover, on_grid
from worker.sim.scene import TOWARDS_KEY_LIGHT, Lighting, Stage
from worker.sim.solids import Array

STILL_LAMP_SIZE, MOVING_LAMP_SIZE = 640, 176
SHADOW_BIAS = 0.0035
"""How much nearer to the lamp something must be to cast a shadow, as a share of the lamp's depth range."""

AMBIENT, KEY = 0.72, 0.43
SHADOW_KEY = 0.34
"""Share of the key light that is left in full shadow."""

MOVING_LIGHT = Lighting(TOWARDS_KEY_LIGHT, AMBIENT, KEY, 0.30)
DEPTH_ONLY = Lighting(TOWARDS_KEY_LIGHT, 1.0, 0.0)

Colours = npt.NDArray[np.float32]
Number = TypeVar("Number", np.float32, np.bool_)


class Shot(NamedTuple):
    """Colours (h, w, 3) in the light and in the shadow, and depth (h, w)."""

    lit: Colours
    shadowed: Colours
    depth: npt.NDArray[np.float32]


def photograph(stage: Stage, camera: Camera, rectangle: Rectangle, width: int, height: int) -> Shot:
    """Draw a stage with and without the key light's full strength."""
    ambient = stage.draw(camera, rectangle, width, height, Lighting(TOWARDS_KEY_LIGHT, 1.0, 0.0))
    key = stage.draw(camera, rectangle, width, height, Lighting(TOWARDS_KEY_LIGHT, 0.0, 1.0, 0.06))
    base = ambient.rgb * np.float32(AMBIENT)
    light = key.rgb * np.float32(KEY)
    return Shot(base + light, base + light * np.float32(SHADOW_KEY), ambient.depth)


class View:
    """A part of the camera's picture, drawn at its own size."""

    def __init__(
        self, camera: Camera, rectangle: Rectangle, width: int, height: int, supersampling: float, still: Stage
    ) -> None:
        """Draws the still stage at once; start() must be called before the first frame."""
        self._camera, self._rectangle = camera, rectangle
        self.width, self.height, self._supersampling = width, height, supersampling
        self._zoom = float(width / (rectangle[2] - rectangle[0]))
        self._room = photograph(still, camera, rectangle, self._fine(width), self._fine(height))

    def start(self, head: Stage, head_box: Pixels, lamp_depth: npt.NDArray[np.float32]) -> None:
        """Prepare a clip: add the head, cast the still shadows, and make the tables for the moving ones."""
        lit, shadowed, self._depth, on_head = self._with_head(head, head_box)
        depth = _resampled(self._depth, self.height, self.width)
        texel, distance = self._seen_from_lamp(depth, STILL_LAMP_SIZE)
        dark = (lamp_depth.ravel()[texel] < distance).reshape(depth.shape)
        # The head receives no still shadow: that of brows and hair would only make the face look dirty.
        dark &= ~_resampled(on_head, self.height, self.width)
        mask = _mask(dark).filter(ImageFilter.BoxBlur(max(1.0, 0.7 * self._zoom)))
        self._background = self._reduced(lit)
        dim = self._reduced(shadowed)
        self._background.paste(dim, (0, 0), mask)
        self._background_shadowed = ImageChops.darker(dim, self._background)
        coarse = _resampled(self._depth, self.height // 2, self.width // 2)
        self._texel, self._distance = self._seen_from_lamp(coarse, MOVING_LAMP_SIZE)

    def _fine(self, pixels: float) -> int:
        """A length on the supersampled grid."""
        return round(pixels * self._supersampling)

    def _reduced(self, colours: Colours) -> Image.Image:
        """Supersampled colours as a picture of this view's size."""
        fine = Image.fromarray(colours.round().clip(0, 255).astype(np.uint8))
        return fine.resize((self.width, self.height), Image.Resampling.HAMMING)

    def frame(self, moving: Sequence[tuple[Stage, Array]], lamp_depth: npt.NDArray[np.float32]) -> Image.Image:
        """One picture. Each moving stage comes with boxes (K, 4) that hold it, in pixels of the whole picture."""
        picture = self._background.copy()
        self._cast_shadows(picture, lamp_depth)
        covered = []
        for stage, boxes in moving:
            for pixels in cover(self._own_pixels(boxes), self.width, self.height):
                covered.append((pixels, self._draw_moving(picture, stage, pixels)))
        for pixels, before in reversed(covered):
            self._depth[self._place(pixels)] = before
        return picture

    def _own_pixels(self, boxes: Array) -> Array:
        """Boxes (K, 4) of the whole picture in this view's pixels."""
        left, top = self._rectangle[:2]
        return np.asarray((boxes - [left, top, left, top]) * self._zoom)

    def _part(self, pixels: Pixels) -> Rectangle:
        """A rectangle of this view in pixels of the whole picture."""
        left, top = self._rectangle[:2]
        x0, y0, x1, y1 = (value / self._zoom for value in pixels)
        return left + x0, top + y0, left + x1, top + y1

    def _with_head(
        self, head: Stage, head_box: Pixels
    ) -> tuple[Colours, Colours, npt.NDArray[np.float32], npt.NDArray[np.bool_]]:
        lit, shadowed, depth = self._room.lit.copy(), self._room.shadowed.copy(), self._room.depth.copy()
        on_head: npt.NDArray[np.bool_] = np.zeros(depth.shape, dtype=np.bool_)
        own = self._own_pixels(np.array([head_box], dtype=float))[0]
        box = on_grid(own, self.width, self.height)
        left, top, right, bottom = (self._fine(value) for value in box)
        if right > left and bottom > top:
            shot = photograph(head, self._camera, self._part(box), right - left, bottom - top)
            place = np.s_[top:bottom, left:right]
            nearer = shot.depth < depth[place]
            lit[place][nearer], shadowed[place][nearer] = shot.lit[nearer], shot.shadowed[nearer]
            on_head[place] = nearer
            depth[place] = np.minimum(depth[place], shot.depth)
        return lit, shadowed, depth, on_head

    def _seen_from_lamp(
        self, depth: npt.NDArray[np.floating], size: int
    ) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.float32]]:
        """For each pixel, its texel in a lamp map of this size and the depth below which something shades it."""
        height, width = depth.shape
        left, top, right, bottom = self._rectangle
        x = (left + (np.arange(width) + 0.5) / width * (right - left)) / self._camera.width * 2 - 1
        y = 1 - (top + (np.arange(height) + 0.5) / height * (bottom - top)) / self._camera.height * 2
        # The crop shares the camera's near and far planes, so the whole picture's matrix inverts its depth too.
        to_lamp = lamp(size).world_to_device @ np.linalg.inv(self._camera.world_to_device)
        z = depth * 2.0 - 1.0
        rows = [
            to_lamp[k, 0] * x[None, :] + to_lamp[k, 1] * y[:, None] + to_lamp[k, 2] * z + to_lamp[k, 3]
            for k in range(4)
        ]
        u, v, distance = (rows[0] / rows[3] + 1) / 2, (1 - rows[1] / rows[3]) / 2, (rows[2] / rows[3] + 1) / 2
        inside = (u >= 0) & (u < 1) & (v >= 0) & (v < 1)
        column = np.clip((u * size).astype(np.int32), 0, size - 1)
        row = np.clip((v * size).astype(np.int32), 0, size - 1)
        limit = np.where(inside, distance - SHADOW_BIAS, 0.0).astype(np.float32)
        return (row * size + column).ravel().astype(np.int32), limit.ravel()

    def _cast_shadows(self, picture: Image.Image, lamp_depth: npt.NDArray[np.float32]) -> None:
        dark = lamp_depth.ravel()[self._texel] < self._distance
        mask = _mask(dark.reshape(self.height // 2, self.width // 2))
        found = mask.getbbox()
        if found is None:
            return
        margin = 8
        x0, y0 = max(0, found[0] - margin), max(0, found[1] - margin)
        x1, y1 = min(self.width // 2, found[2] + margin), min(self.height // 2, found[3] + margin)
        soft = mask.crop((x0, y0, x1, y1)).filter(ImageFilter.BoxBlur(max(2.0, 1.4 * self._zoom)))
        full = (2 * x0, 2 * y0, 2 * x1, 2 * y1)
        soft = soft.resize((full[2] - full[0], full[3] - full[1]), Image.Resampling.BILINEAR)
        picture.paste(self._background_shadowed.crop(full), full[:2], soft)

    def _place(self, pixels: Pixels) -> tuple[slice, slice]:
        """A rectangle of this view on the supersampled grid."""
        left, top, right, bottom = (self._fine(value) for value in pixels)
        return slice(top, bottom), slice(left, right)

    def _draw_moving(self, picture: Image.Image, moving: Stage, pixels: Pixels) -> npt.NDArray[np.float32]:
        """Draw a stage where it is nearer than what is there, and return the depth that was there before."""
        place = self._place(pixels)
        before = self._depth[place].copy()
        height, width = before.shape
        rgba, depth = moving.draw_raw(self._camera, self._part(pixels), width, height, MOVING_LIGHT)
        visible = depth < before
        self._depth[place] = np.minimum(depth, before)
        # Premultiplied alpha, so that resizing does not bleed hidden colours into the edges.
        colour = (rgba.view(np.uint32)[..., 0] | np.uint32(0xFF000000)) * visible.view(np.uint8)
        layer = Image.frombuffer("RGBa", (width, height), colour, "raw", "RGBa", 0, 1)
        size = (pixels[2] - pixels[0], pixels[3] - pixels[1])
        layer = layer.resize(size, Image.Resampling.HAMMING).convert("RGBA")
        picture.paste(layer, pixels[:2], layer)
        return before


def _mask(chosen: npt.NDArray[np.bool_]) -> Image.Image:
    return Image.fromarray(chosen.view(np.uint8) * np.uint8(255))


def _resampled(values: npt.NDArray[Number], height: int, width: int) -> npt.NDArray[Number]:
    """The nearest of values (h, w) on a coarser grid."""
    rows = ((np.arange(height) + 0.5) * values.shape[0] / height).astype(int)
    columns = ((np.arange(width) + 0.5) * values.shape[1] / width).astype(int)
    return np.ascontiguousarray(values[rows][:, columns])
