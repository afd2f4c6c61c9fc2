"""Sets of meshes that are drawn together, in software renderer clients of their own."""

import tempfile
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from PIL import Image

from worker.domain.trajectory import SKIN_TONES
from worker.domain.type_aliases import FloatArray
from worker.sim.geometry import IDENTITY
from worker.sim.render.camera import Camera, Rectangle, flat
from worker.sim.render.engine_client import DrawingClient
from worker.sim.render.meshes.colours import Palette
from worker.sim.render.meshes.mesh import Mesh

GONE_M = (0.0, 0.0, -1000.0)
"""Where food that was eaten or lost is kept, out of sight."""


class Lighting(NamedTuple):
    """How strongly the pieces of one drawing pass are lit."""

    towards: tuple[float, float, float]
    ambient: float
    diffuse: float
    specular: float = 0.0


class Layer(NamedTuple):
    """Colours (h, w, 3) in [0, 255] and device depth (h, w) of one drawing pass."""

    rgb: npt.NDArray[np.uint8]
    depth: npt.NDArray[np.float32]


class Paints:
    """The palette, and its texture for every skin tone as files, which the clients read."""

    def __init__(self) -> None:
        self.palette = Palette()
        self._folder = tempfile.TemporaryDirectory()
        self.textures = [Path(self._folder.name) / f"palette_{tone}.png" for tone in range(SKIN_TONES)]
        for tone, texture in enumerate(self.textures):
            Image.fromarray(self.palette.texture(tone)).save(texture)

    def close(self) -> None:
        """Remove the files."""
        self._folder.cleanup()


class MeshSet:
    """A set of meshes that is drawn together, in a client of its own.

    A client takes 29 MB before the first mesh, and a mesh that is not in sight still costs half of its drawing time:
    so stages are few, and hold what is drawn at the same moments.
    """

    def __init__(self, paints: Paints, with_skin: bool = False) -> None:
        self._client = DrawingClient(paints.textures if with_skin else paints.textures[:1])
        self._palette = paints.palette
        self._shown: set[str] = set()
        self._corners_m: dict[str, FloatArray] = {}

    def add(self, meshes: Mapping[str, Mesh]) -> None:
        """Add meshes that are not there yet, out of sight until they are placed."""
        for name, mesh in meshes.items():
            if name not in self._corners_m:
                coordinates = self._palette.coordinates(mesh.paint)
                self._client.add_mesh(name, mesh.vertices, mesh.normals, coordinates, mesh.faces)
                self._client.place(name, GONE_M)
                self._corners_m[name] = corners_around(mesh.vertices)

    def __contains__(self, name: str) -> bool:
        return name in self._corners_m

    def corners_m(self, name: str) -> FloatArray:
        """(8, 3) of a mesh's bounding box in its own frame."""
        return self._corners_m[name]

    def close(self) -> None:
        """Free the client."""
        self._client.close()

    def repaint(self, skin_tone: int) -> None:
        """Give the person's colours to a stage that was made with skin."""
        self._client.repaint(skin_tone)

    def place(
        self,
        name: str,
        position_m: Sequence[float] | FloatArray = (0, 0, 0),
        quaternion: Sequence[float] | FloatArray = IDENTITY,
    ) -> None:
        """Put a mesh somewhere in sight."""
        self._client.place(name, position_m, quaternion)
        self._shown.add(name)

    def hide_all_but(self, names: Iterable[str]) -> None:
        """Put everything else out of sight."""
        for name in self._shown - set(names):
            self.hide(name)

    def hide(self, name: str) -> None:
        """Put a mesh out of sight."""
        self._client.place(name, GONE_M)
        self._shown.discard(name)

    def draw_raw(
        self, camera: Camera, rectangle: Rectangle | None, width: int, height: int, light: Lighting
    ) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.float32]]:
        """Colours (h, w, 4) and depth (h, w), valid until the next call."""
        return self._client.draw(width, height, flat(camera.view), flat(camera.projection(rectangle)), *light)

    def draw(self, camera: Camera, rectangle: Rectangle | None, width: int, height: int, light: Lighting) -> Layer:
        """One pass, copied."""
        rgba, depth = self.draw_raw(camera, rectangle, width, height, light)
        return Layer(rgba[..., :3].copy(), depth.copy())


CUBE = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)])
"""(8, 3) corners of a box from -1 to 1"""


def corners_around(points_m: FloatArray) -> FloatArray:
    """(8, 3) corners of the box around points (N, 3)."""
    return np.asarray(np.where(CUBE == 1, points_m.max(axis=0), points_m.min(axis=0)))
