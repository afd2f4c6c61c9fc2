"""Two pinhole cameras in numpy: the one that looks at the scene, and the lamp seen as a camera.

Matrices follow OpenGL: view space looks along -z, device coordinates run from -1 to 1. Pixels count from the top left.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from worker.domain.type_aliases import FloatArray
from worker.sim.render.task_look import TaskLook

Rectangle = tuple[float, float, float, float]
"""left, top, right, bottom in pixels of the whole picture."""


@dataclass(frozen=True)
class Camera:
    """A camera whose picture is width x height pixels."""

    eye_m: tuple[float, float, float]
    target_m: tuple[float, float, float]
    field_of_view_deg: float
    width: int
    height: int
    near_m: float
    far_m: float

    @cached_property
    def view(self) -> FloatArray:
        """World to camera (4, 4)."""
        eye = np.asarray(self.eye_m)
        back = eye - np.asarray(self.target_m)
        back /= np.linalg.norm(back)
        right = np.cross([0.0, 0.0, 1.0], back)
        right /= np.linalg.norm(right)
        matrix = np.eye(4)
        matrix[:3, :3] = right, np.cross(back, right), back
        matrix[:3, 3] = -matrix[:3, :3] @ eye
        return matrix

    def projection(self, rectangle: Rectangle | None = None) -> FloatArray:
        """Camera to device coordinates (4, 4), for the whole picture or for an off-centre part of it."""
        left, top, right, bottom = rectangle or (0, 0, self.width, self.height)
        half_height = self.near_m * math.tan(math.radians(self.field_of_view_deg) / 2)
        half_width = half_height * self.width / self.height
        x0, x1 = (half_width * (2 * x / self.width - 1) for x in (left, right))
        y0, y1 = (half_height * (1 - 2 * y / self.height) for y in (bottom, top))
        near, far = self.near_m, self.far_m
        return np.array(
            [
                [2 * near / (x1 - x0), 0, (x1 + x0) / (x1 - x0), 0],
                [0, 2 * near / (y1 - y0), (y1 + y0) / (y1 - y0), 0],
                [0, 0, -(far + near) / (far - near), -2 * far * near / (far - near)],
                [0, 0, -1, 0],
            ]
        )

    @cached_property
    def world_to_device(self) -> FloatArray:
        """World to device coordinates of the whole picture (4, 4)."""
        return np.asarray(self.projection() @ self.view)

    def seen_through(
        self, matrix: FloatArray, rectangle: Rectangle, depth: npt.NDArray[np.floating]
    ) -> list[FloatArray]:
        """Coordinates after a homogeneous matrix (4, 4) from the world of what is seen in a part of the picture.

        ``depth`` (h, w) is that part's device depth in [0, 1]; gives three arrays (h, w).
        """
        height, width = depth.shape
        left, top, right, bottom = rectangle
        x = (left + (np.arange(width) + 0.5) / width * (right - left)) / self.width * 2 - 1
        y = 1 - (top + (np.arange(height) + 0.5) / height * (bottom - top)) / self.height * 2
        # A part shares the camera's near and far planes, so the whole picture's matrix inverts its depth too.
        through = (matrix @ self.device_to_world).astype(np.float32)
        z = depth.astype(np.float32) * np.float32(2.0) - np.float32(1.0)
        x, y = x.astype(np.float32)[None, :], y.astype(np.float32)[:, None]
        rows = [through[k, 0] * x + (through[k, 1] * y + through[k, 3]) + through[k, 2] * z for k in range(4)]
        return [row / rows[3] for row in rows[:3]]

    @cached_property
    def device_to_world(self) -> FloatArray:
        """Device coordinates of the whole picture to homogeneous world coordinates (4, 4)."""
        return np.asarray(np.linalg.inv(self.world_to_device))

    def pixels(self, points_m: FloatArray) -> FloatArray:
        """Where world points (..., 3) appear (..., 2)."""
        device = points_m @ self.world_to_device[:, :3].T + self.world_to_device[:, 3]
        device = device[..., :2] / device[..., 3:]
        return np.asarray((device * [1, -1] + 1) / 2 * [self.width, self.height])

    def boxes(self, corners_m: FloatArray) -> FloatArray:
        """Boxes (K, 4) in pixels around corners (K, C, 3): the whole picture around what reaches behind the camera,

        and nothing around what lies there wholly, or is NaN.
        """
        depth_m = -(corners_m @ self.view[2, :3] + self.view[2, 3])
        inside = depth_m > self.near_m
        pixels = self.pixels(np.where(inside[..., None], corners_m, np.asarray(self.target_m)))
        boxes = np.concatenate([pixels.min(axis=-2) - 1.5, pixels.max(axis=-2) + 1.5], axis=-1)
        boxes[inside.any(axis=-1) & ~inside.all(axis=-1)] = 0, 0, self.width, self.height
        boxes[~inside.any(axis=-1)] = 0.0
        return np.asarray(boxes)

    def pixels_per_m(self, point_m: FloatArray) -> float:
        """How large things appear at a point."""
        distance = -float((self.view @ np.append(point_m, 1.0))[2])
        return self.height / (2 * distance * math.tan(math.radians(self.field_of_view_deg) / 2))


def flat(matrix: FloatArray) -> Sequence[float]:
    """The 16 numbers of a matrix column by column, as the engine takes them."""
    numbers: list[float] = matrix.T.ravel().tolist()
    return numbers


NEAR_M, FAR_M = 0.05, 6.0


def scene_camera(look: TaskLook, width: int, height: int) -> Camera:
    """The camera of a task's film."""
    return Camera(look.eye_m, look.target_m, look.field_of_view_deg, width, height, NEAR_M, FAR_M)


CLOSE_UP_DISTANCE_M = 0.9
"""Far enough that nothing between camera and person is cut off, and that a face keeps its proportions."""


def close_up_camera(centre_m: FloatArray, towards: FloatArray, span_m: float, width: int, height: int) -> Camera:
    """A camera that looks at a point against a direction (unit vector); ``span_m`` is the height of what it shows."""
    x, y, z = (centre_m + CLOSE_UP_DISTANCE_M * towards).tolist()
    field_of_view_deg = 2 * math.degrees(math.atan(span_m / 2 / CLOSE_UP_DISTANCE_M))
    target_m = (float(centre_m[0]), float(centre_m[1]), float(centre_m[2]))
    return Camera((x, y, z), target_m, field_of_view_deg, width, height, NEAR_M, FAR_M)


LIGHT_CENTRE_M = np.array([-0.25, -0.15, 0.55])
TOWARDS_LIGHT = np.array([0.45, -0.75, 2.2]) / np.linalg.norm([0.45, -0.75, 2.2])
LIGHT_DISTANCE_M = 7.0


def lamp(size: int) -> Camera:
    """A distant lamp above the camera, for shadow maps of size x size texels."""
    eye = LIGHT_CENTRE_M + LIGHT_DISTANCE_M * TOWARDS_LIGHT
    return Camera((eye[0], eye[1], eye[2]), (-0.25, -0.15, 0.55), 18.0, size, size, 5.0, 9.0)
