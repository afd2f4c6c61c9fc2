"""One drawing pass of a stage and what is made of it: pictures in light and shadow, masks, layers with soft edges."""

from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt
from PIL import Image

from worker.domain.type_aliases import FloatArray
from worker.sim.render.camera import Camera, Rectangle, lamp
from worker.sim.render.mesh_set import Lighting, MeshSet

Colours = npt.NDArray[np.uint8]
Depth = npt.NDArray[np.float32]
Number = TypeVar("Number", np.float32, np.bool_)

TOWARDS_KEY_LIGHT = (0.60, -1.20, 2.20)
AMBIENT, KEY = 0.72, 0.43
SHADOW_KEY = 0.34
"""Share of the key light that is left in full shadow."""
SHADOW_BIAS = 0.0035
"""How much nearer to the lamp something must be to cast a shadow, as a share of the lamp's depth range."""

MACHINE_LIGHT = Lighting(TOWARDS_KEY_LIGHT, AMBIENT, KEY, 0.30)
BODY_LIGHT = Lighting(TOWARDS_KEY_LIGHT, AMBIENT, KEY, 0.026)
WATER_LIGHT = Lighting(TOWARDS_KEY_LIGHT, 0.80, 0.34, 0.20)
DEPTH_ONLY = Lighting(TOWARDS_KEY_LIGHT, 1.0, 0.0)


class Shot(NamedTuple):
    """Colours (h, w, 3) in the light and in the shadow, and depth (h, w)."""

    lit: Colours
    shadowed: Colours
    depth: Depth

    def copy(self) -> "Shot":
        """One that may be painted over."""
        return Shot(self.lit.copy(), self.shadowed.copy(), self.depth.copy())

    def merge(self, above: "Shot", place: tuple[slice, slice]) -> npt.NDArray[np.bool_]:
        """Put another shot into a part of this one where it is nearer, and give where that is."""
        nearer = above.depth < self.depth[place]
        self.lit[place][nearer], self.shadowed[place][nearer] = above.lit[nearer], above.shadowed[nearer]
        self.depth[place] = np.minimum(self.depth[place], above.depth)
        return nearer


class Part(NamedTuple):
    """A stage with the corners (K, 8, 3) of boxes in the world around what it shows, and how it is drawn."""

    stage: MeshSet
    corners_m: FloatArray
    """NaN around what is gone"""
    light: Lighting = MACHINE_LIGHT
    prepare: Callable[[], None] | None = None
    """called before drawing, by parts that share a stage"""
    alive: bool = False
    """part of the person: the robot's shadow falls on it, and an itch on it shows"""
    pose: int = 0
    """a number for each pose of a part of the person; while it stays the same, the part is not drawn anew"""
    drops_m: float = 0.0
    """water: the radius of the balls that are drawn as one body"""
    glass: bool = False
    head_m: FloatArray | None = None
    """where the person's head is: it receives no still shadow, for that of brows and hair would only look dirty"""


class Frame(NamedTuple):
    """What moves in one frame, in drawing order (water and glass last), and the lamp's depth map of it."""

    parts: Sequence[Part]
    lamp_depth: Depth
    itch_m: FloatArray | None


class Supersampling(NamedTuple):
    """How many drawn pixels lie along one pixel of the picture."""

    still: float
    moving: float


def photograph(stage: MeshSet, camera: Camera, rectangle: Rectangle, width: int, height: int) -> Shot:
    """Draw a stage with and without the key light's full strength."""
    ambient = stage.draw(camera, rectangle, width, height, Lighting(TOWARDS_KEY_LIGHT, 1.0, 0.0))
    key = stage.draw(camera, rectangle, width, height, Lighting(TOWARDS_KEY_LIGHT, 0.0, 1.0, 0.06))
    base = ambient.rgb * np.float32(AMBIENT)
    light = key.rgb * np.float32(KEY)
    return Shot(as_bytes(base + light), as_bytes(base + light * np.float32(SHADOW_KEY)), ambient.depth)


def seen_from_lamp(
    camera: Camera, rectangle: Rectangle, depth: Depth, size: int
) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.float32]]:
    """For each pixel of a part of the picture, its texel in a lamp map, and nearer than what depth it is shaded."""
    x, y, z = camera.seen_through(lamp(size).world_to_device, rectangle, depth)
    column, row = (x + 1) * np.float32(size / 2), (1 - y) * np.float32(size / 2)
    inside = (column >= 0) & (column < size) & (row >= 0) & (row < size)
    texel = np.where(inside, row.astype(np.int32) * size + column.astype(np.int32), 0)
    limit = np.where(inside, (z + 1) / 2 - np.float32(SHADOW_BIAS), np.float32(0.0))
    return texel.ravel(), limit.ravel()


def distance_m(camera: Camera, rectangle: Rectangle, depth: Depth, point_m: FloatArray) -> Depth:
    """How far from a point what each pixel (h, w) of a part of the picture shows is."""
    places = camera.seen_through(np.eye(4), rectangle, depth)
    squared = sum((place - np.float32(middle)) ** 2 for place, middle in zip(places, point_m, strict=True))
    return np.asarray(np.sqrt(squared), np.float32)


def as_layer(rgba: Colours, visible: npt.NDArray[np.bool_]) -> Image.Image:
    """What is visible (h, w), its alpha premultiplied so that resizing does not bleed hidden colours into the edges."""
    colour = (rgba.view(np.uint32)[..., 0] | np.uint32(0xFF000000)) * visible.view(np.uint8)
    return Image.frombuffer("RGBa", (visible.shape[1], visible.shape[0]), colour, "raw", "RGBa", 0, 1)


def as_mask(chosen: npt.NDArray[np.bool_]) -> Image.Image:
    """255 where chosen (h, w), 0 elsewhere."""
    return Image.fromarray(chosen.view(np.uint8) * np.uint8(255))


def as_bytes(colours: npt.NDArray[np.floating]) -> Colours:
    """Rounded to whole numbers from 0 to 255."""
    return np.asarray((colours + 0.5).clip(0, 255).astype(np.uint8))


def resampled(values: npt.NDArray[Number], height: int, width: int) -> npt.NDArray[Number]:
    """The nearest of values (h, w) on another grid."""
    rows = ((np.arange(height) + 0.5) * values.shape[0] / height).astype(int)
    columns = ((np.arange(width) + 0.5) * values.shape[1] / width).astype(int)
    return np.ascontiguousarray(values[rows][:, columns])
