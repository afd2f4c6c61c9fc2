"""A client of the engine that only draws: meshes in, pixels out."""

from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from worker.domain.type_aliases import FloatArray
from worker.sim.engine import pybullet
from worker.sim.geometry import IDENTITY, Vector


class Drawing(NamedTuple):
    """What the software renderer saw: both arrays share memory with the engine's answer."""

    rgba: npt.NDArray[np.uint8]
    """(height, width, 4)"""
    depth: npt.NDArray[np.float32]
    """(height, width) in [0, 1], the normalised device depth"""


_NUDGES = np.array(sorted(product((0, 1, -1), repeat=3), key=np.count_nonzero), np.float32)


def lasting(normals: FloatArray) -> npt.NDArray[np.float32]:
    """Unit normals (V, 3) that the software renderer leaves as they are; zeros, of vertices without faces, stay zeros.

    It normalises them in place, in single precision, whenever it looks at one. Most unit vectors settle at once; one in
    seven goes to and fro between two values for ever, and what is drawn would depend on what was drawn before. Here a
    component is moved by a unit in its last place where need be.
    """
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    unit = np.asarray(normals / np.where(lengths == 0, 1, lengths), np.float32)
    near = unit + _NUDGES[:, None] * np.spacing(unit)  # (27, V, 3)
    x, y, z = np.moveaxis(near, 2, 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        normalised = near * (np.float32(1) / np.sqrt(x * x + y * y + z * z))[..., None]
    stays = (normalised == near).all(axis=2)
    return np.asarray(near[stays.argmax(axis=0), np.arange(len(unit))])


class DrawingClient:
    """A client that only draws: meshes that share one palette texture, placed by name, no physics."""

    def __init__(self, palettes: Sequence[Path]) -> None:
        """`palettes` are image files of one size, read at once; the first one is worn until repaint()."""
        self._client: int | None = pybullet.connect(pybullet.DIRECT)
        self._textures = [pybullet.loadTexture(str(palette), physicsClientId=self._client) for palette in palettes]
        self._worn = 0
        self._bodies: dict[str, int] = {}

    def close(self) -> None:
        """Disconnect. Closing twice is fine."""
        if self._client is not None and pybullet.isConnected(self._client):
            pybullet.disconnect(self._client)
        self._client = None

    def add_mesh(
        self, name: str, vertices_m: FloatArray, normals: FloatArray, texture: FloatArray, faces: npt.NDArray[np.int32]
    ) -> None:
        """Add a mesh of V vertices (V, 3), normals (V, 3), texture coordinates (V, 2) and triangles (F, 3)."""
        shape = pybullet.createVisualShape(
            pybullet.GEOM_MESH,
            vertices=vertices_m.tolist(),
            normals=lasting(normals).tolist(),
            uvs=texture.tolist(),
            indices=faces.ravel().tolist(),
            rgbaColor=[1, 1, 1, 1],
            physicsClientId=self._client,
        )
        body = pybullet.createMultiBody(0.0, -1, shape, physicsClientId=self._client)
        self._bodies[name] = body
        self._paint(name)

    def repaint(self, palette: int) -> None:
        """Give every mesh the colours of another palette."""
        if palette != self._worn:
            self._worn = palette
            for name in self._bodies:
                self._paint(name)

    def _paint(self, name: str) -> None:
        texture = self._textures[self._worn]
        pybullet.changeVisualShape(self._bodies[name], -1, textureUniqueId=texture, physicsClientId=self._client)

    def place(self, name: str, position_m: Vector, quaternion: Vector = IDENTITY) -> None:
        """Put a mesh somewhere else."""
        pybullet.resetBasePositionAndOrientation(
            self._bodies[name], position_m, quaternion, physicsClientId=self._client
        )

    def draw(
        self,
        width: int,
        height: int,
        view: Sequence[float],
        projection: Sequence[float],
        light_direction: Sequence[float],
        ambient: float,
        diffuse: float,
        specular: float,
    ) -> Drawing:
        """Draw without shadows; matrices are 16 numbers, column by column, as OpenGL wants them."""
        _, _, rgba, depth, _ = pybullet.getCameraImage(
            width,
            height,
            view,
            projection,
            shadow=0,
            lightDirection=light_direction,
            lightColor=(1.0, 1.0, 1.0),
            lightAmbientCoeff=ambient,
            lightDiffuseCoeff=diffuse,
            lightSpecularCoeff=specular,
            renderer=pybullet.ER_TINY_RENDERER,
            flags=pybullet.ER_NO_SEGMENTATION_MASK,
            physicsClientId=self._client,
        )
        return Drawing(
            np.asarray(rgba, np.uint8).reshape(height, width, 4), np.asarray(depth, np.float32).reshape(height, width)
        )
