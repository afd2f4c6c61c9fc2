"""What is seen on the person's skin: an itch as a soft red spot, and the robot's shadow on parts that move."""

import math

import numpy as np
from PIL import Image, ImageFilter

from worker.domain.type_aliases import FloatArray
from worker.sim.render.camera import Camera, Rectangle
from worker.sim.render.passes import Colours, Depth, as_bytes, distance_m

IN_SHADOW = 0.75
"""Brightness in full shadow, relative to that in the light."""

ITCH_RADIUS_M = 0.019
ITCH_STRENGTH = 0.9
_ITCH_TINT = np.array([0.98, 0.50, 0.47], np.float32)
_ITCH_GLOW = np.array([22.0, 0.0, 0.0], np.float32)
"""So that the spot is red on dark skin too."""


def shade(rgb: Colours, mask: Image.Image, blur_px: float) -> None:
    """Darken colours (h, w, 3) softly where a mask of half their size is set."""
    found = mask.getbbox()
    if found is None:
        return
    margin = math.ceil(blur_px) + 1
    x0, y0 = max(0, found[0] - margin), max(0, found[1] - margin)
    x1, y1 = min(mask.width, found[2] + margin), min(mask.height, found[3] + margin)
    soft = mask.crop((x0, y0, x1, y1)).filter(ImageFilter.BoxBlur(blur_px))
    soft = soft.resize((2 * soft.width, 2 * soft.height), Image.Resampling.BILINEAR)
    around = rgb[2 * y0 : 2 * y1, 2 * x0 : 2 * x1]
    share = np.asarray(soft, np.uint16)[: around.shape[0], : around.shape[1], None]
    around -= (around * share // np.uint16(255 / (1.0 - IN_SHADOW))).astype(np.uint8)


def mark_itch(rgb: Colours, depth: Depth, camera: Camera, rectangle: Rectangle, itch_m: FloatArray) -> None:
    """Redden the skin around a point in a drawn part of the picture: colours (h, w, 3) and depth (h, w)."""
    height, width = depth.shape
    left, top = rectangle[:2]
    scale = width / (rectangle[2] - left)
    x, y = (camera.pixels(itch_m) - [left, top]) * scale
    reach = 1.6 * ITCH_RADIUS_M * camera.pixels_per_m(itch_m) * scale
    x0, x1 = (int(np.clip(value, 0, width)) for value in (x - reach, x + reach + 1))
    y0, y1 = (int(np.clip(value, 0, height)) for value in (y - reach, y + reach + 1))
    if x1 <= x0 or y1 <= y0:
        return
    around = np.s_[y0:y1, x0:x1]
    part = (left + x0 / scale, top + y0 / scale, left + x1 / scale, top + y1 / scale)
    share = distance_m(camera, part, depth[around], itch_m) / np.float32(ITCH_RADIUS_M)
    spot = (np.exp(-(share**4)) * np.float32(ITCH_STRENGTH))[..., None]
    plain = rgb[around].astype(np.float32)
    rgb[around] = as_bytes(plain + (plain * _ITCH_TINT + _ITCH_GLOW - plain) * spot)
