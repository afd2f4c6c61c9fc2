"""A gentle sign that the robot presses: a warm ring where the tool is, and a warm frame around the inset."""

import numpy as np
from PIL import Image

from worker.domain.type_aliases import FloatArray
from worker.sim.render.camera import Camera
from worker.sim.render.meshes.distance_fields import smooth_step

NOTICED_FROM_N, STRONG_FROM_N = 2.0, 15.0
RADIUS_PX = 34
"""In a picture 640 pixels wide."""

Rgb = tuple[int, int, int]


class Highlight:
    """The highlight of one clip of N frames."""

    CALM: Rgb = (255, 255, 255)
    WARM: Rgb = (246, 138, 60)

    def __init__(
        self, camera: Camera, force_n: FloatArray, tool_m: FloatArray, target_m: FloatArray, scale: float = 1.0
    ) -> None:
        """force_n (N,), where tool and target are in the world (N, 3), and how much larger the ring is drawn."""
        strength = np.clip((force_n - NOTICED_FROM_N) / (STRONG_FROM_N - NOTICED_FROM_N), 0.0, 1.0)
        self._strength = np.where(force_n > NOTICED_FROM_N, 0.25 + 0.75 * np.sqrt(strength), 0.0)
        near = np.linalg.norm(tool_m - target_m, axis=1, keepdims=True) < 0.08
        self._centres = camera.pixels(np.where(near, target_m, tool_m)).round().astype(int)
        self._radius_px = round(RADIUS_PX * scale)
        self._ring = _ring(self._radius_px)

    def draw(self, picture: Image.Image, index: int) -> None:
        """Draw the ring of one frame; nothing while the robot does not press."""
        strength = float(self._strength[index])
        if strength <= 0.0:
            return
        x, y = self._centres[index]
        mask = self._ring.point(lambda value: round(value * strength))
        picture.paste(self.WARM, (int(x) - self._radius_px, int(y) - self._radius_px), mask)

    def border(self, index: int) -> Rgb:
        """The colour of the inset's frame."""
        share = float(self._strength[index])
        r, g, b = (round(calm + (warm - calm) * share) for calm, warm in zip(self.CALM, self.WARM, strict=True))
        return r, g, b


def _ring(radius_px: int) -> Image.Image:
    """A soft ring as a mask, two radii wide."""
    place = np.arange(2 * radius_px) + 0.5 - radius_px
    distance = np.hypot(place[:, None], place[None, :]) / radius_px
    profile = smooth_step(distance.ravel(), 0.55, 0.82) * (1 - smooth_step(distance.ravel(), 0.84, 1.0))
    return Image.fromarray((profile.reshape(distance.shape) * 215).astype(np.uint8))
