"""What there is to draw, in clients by how often it moves: the room and the body, the head, the arm with its food."""

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from PIL import Image

from worker.sim import arm_look, body_look, chair_look, head_look, jaco, room_look
from worker.sim.bullet import DrawingClient
from worker.sim.camera import Camera, Rectangle, flat
from worker.sim.colours import FOOD, Palette
from worker.sim.human import NECK_PIVOT_M
from worker.sim.meshes import Mesh
from worker.sim.solids import Array, union

GONE_M = (0.0, 0.0, -5.0)
"""Where food that was eaten or lost is kept, out of sight."""

TOWARDS_KEY_LIGHT = (0.60, -1.20, 2.20)

UPPER_ARM = ("link_1", "link_2", "link_3")
HAND_PARTS = ("link_6", "link_7", "spoon")
"""What of the arm can come near the mouth and is drawn in the inset."""


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


class Stage:
    """A set of meshes that is drawn together."""

    def __init__(self, meshes: Mapping[str, Mesh], palette: Palette, texture: Path) -> None:
        self._client = DrawingClient(texture)
        for name, mesh in meshes.items():
            self._client.add_mesh(name, mesh.vertices, mesh.normals, palette.coordinates(mesh.paint), mesh.faces)

    def close(self) -> None:
        self._client.close()

    def place(self, name: str, position_m: Sequence[float] | Array, quaternion: Sequence[float] | Array) -> None:
        self._client.place(name, position_m, quaternion)

    def draw_raw(
        self, camera: Camera, rectangle: Rectangle | None, width: int, height: int, light: Lighting
    ) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.float32]]:
        """Colours (h, w, 4) and depth (h, w), valid until the next call."""
        return self._client.draw(width, height, flat(camera.view), flat(camera.projection(rectangle)), *light)

    def draw(self, camera: Camera, rectangle: Rectangle | None, width: int, height: int, light: Lighting) -> Layer:
        """One pass, copied."""
        rgba, depth = self.draw_raw(camera, rectangle, width, height, light)
        return Layer(rgba[..., :3].copy(), depth.copy())


class Boxes(NamedTuple):
    """Corners of the moving meshes' bounding boxes in their own frames."""

    names: tuple[str, ...]
    corners_m: Array
    """(L, 8, 3)"""


class Scene:
    """All stages. Building one takes about a second; it is meant to live as long as its process."""

    def __init__(self, food_count: int, food_radius_m: float) -> None:
        palette = Palette()
        arm = arm_look.arm_meshes(arm_look.Detail(palette, sides=14))
        foods = {
            food_name(index): arm_look.food_mesh(arm_look.Detail(palette), FOOD[index % len(FOOD)], food_radius_m)
            for index in range(food_count)
        }
        with tempfile.TemporaryDirectory() as folder:
            texture = Path(folder) / "palette.png"
            Image.fromarray(palette.texture()).save(texture)
            self.still = Stage(_still_meshes(palette), palette, texture)
            head = {"head": head_look.head_mesh(palette), "neck": body_look.neck_mesh(palette)}
            self.head = Stage(head, palette, texture)
            self.upper_arm = Stage({name: arm[name] for name in UPPER_ARM}, palette, texture)
            self.forearm = Stage({name: arm[name] for name in arm if name not in UPPER_ARM} | foods, palette, texture)
            fine = arm_look.arm_meshes(arm_look.Detail(palette, sides=18))
            self.hand = Stage({name: fine[name] for name in HAND_PARTS} | foods, palette, texture)
            self.casters = Stage(arm_look.arm_meshes(arm_look.Detail(palette, sides=6)), palette, texture)
        self.boxes = _boxes(arm)

    def close(self) -> None:
        """Free every client."""
        for stage in (self.still, self.head, self.upper_arm, self.forearm, self.hand, self.casters):
            stage.close()

    def turn_head(self, quaternion: Sequence[float] | Array) -> None:
        self.head.place("head", NECK_PIVOT_M, quaternion)


def food_name(index: int) -> str:
    return f"food_{index}"


def _still_meshes(palette: Palette) -> dict[str, Mesh]:
    person = union(body_look.shirt(), body_look.arms(), body_look.trousers())
    chair = chair_look.chair()
    base = arm_look.base_mesh(arm_look.Detail(palette)).moved(arm_look.base_turn(), jaco.ROBOT_BASE_M)
    return {
        "body": body_look.body_mesh(palette, chair),
        "chair": chair_look.chair_mesh(palette, person),
        "base": base,
        **room_look.room_meshes(palette, union(person, chair)),
    }


def _boxes(meshes: Mapping[str, Mesh]) -> Boxes:
    corners = []
    for mesh in meshes.values():
        lower, upper = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
        choose = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
        corners.append(np.where(choose == 1, upper, lower))
    return Boxes(tuple(meshes), np.array(corners))
