"""The palette of the scene: one small texture whose columns are colours and whose rows are how much light arrives.

The software renderer draws one colour per mesh, but looks colours up in a texture per pixel. Painting vertices with
(palette position, light) therefore gives smooth gradients (skin to lips) and baked ambient occlusion at no cost.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

_COLUMNS_PER_RAMP = 64
_LIGHT_ROWS = 64

Colour = tuple[float, float, float]

# Each ramp is a list of colours (sRGB, 0 to 1) at equal distances; a vertex may lie anywhere between them.
RAMPS: dict[str, tuple[Colour, ...]] = {
    "skin": ((0.93, 0.76, 0.65), (0.92, 0.70, 0.60), (0.86, 0.57, 0.51), (0.74, 0.42, 0.40), (0.36, 0.12, 0.13)),
    "mouth": ((0.42, 0.13, 0.14), (0.20, 0.06, 0.07)),
    "tongue": ((0.78, 0.40, 0.40), (0.66, 0.28, 0.30)),
    "teeth": ((0.97, 0.96, 0.93), (0.97, 0.96, 0.93)),
    "eye": ((0.98, 0.98, 0.97), (0.98, 0.98, 0.97)),
    "iris": ((0.36, 0.27, 0.20), (0.25, 0.18, 0.13)),
    "pupil": ((0.06, 0.05, 0.05), (0.06, 0.05, 0.05)),
    "hair": ((0.20, 0.13, 0.10), (0.36, 0.24, 0.17), (0.47, 0.33, 0.23)),
    "shirt": ((0.50, 0.63, 0.76), (0.43, 0.56, 0.70)),
    "shirt_trim": ((0.40, 0.53, 0.67), (0.40, 0.53, 0.67)),
    "trousers": ((0.34, 0.37, 0.46), (0.34, 0.37, 0.46)),
    "shoe": ((0.86, 0.85, 0.82), (0.86, 0.85, 0.82)),
    "chair": ((0.50, 0.52, 0.56), (0.50, 0.52, 0.56)),
    "cushion": ((0.55, 0.57, 0.60), (0.55, 0.57, 0.60)),
    "wood": ((0.72, 0.56, 0.42), (0.62, 0.46, 0.34)),
    "tyre": ((0.20, 0.21, 0.23), (0.20, 0.21, 0.23)),
    "metal": ((0.70, 0.72, 0.74), (0.84, 0.85, 0.86)),
    "arm": ((0.17, 0.19, 0.22), (0.24, 0.26, 0.30)),
    "ring": ((0.86, 0.88, 0.89), (0.86, 0.88, 0.89)),
    "spoon": ((0.90, 0.91, 0.92), (0.70, 0.73, 0.77), (0.62, 0.66, 0.70)),
    "grip": ((0.16, 0.60, 0.58), (0.16, 0.60, 0.58)),
    "wall": ((0.97, 0.96, 0.93), (0.92, 0.92, 0.89)),
    "side_wall": ((0.93, 1.00, 0.98), (0.89, 0.96, 0.945)),
    "floor": ((0.90, 0.83, 0.74), (0.84, 0.76, 0.66)),
    "skirting": ((0.96, 0.96, 0.94), (0.96, 0.96, 0.94)),
    "leaf": ((0.36, 0.53, 0.38), (0.47, 0.63, 0.44)),
    "pot": ((0.85, 0.80, 0.74), (0.85, 0.80, 0.74)),
    "carrot": ((0.96, 0.55, 0.13), (0.96, 0.55, 0.13)),
    "tomato": ((0.88, 0.26, 0.20), (0.88, 0.26, 0.20)),
    "corn": ((0.98, 0.79, 0.20), (0.98, 0.79, 0.20)),
    "pea": ((0.42, 0.70, 0.24), (0.42, 0.70, 0.24)),
}

FOOD = ("carrot", "tomato", "corn", "pea")

_DARKEST = 0.25
"""Share of the light that is left where none of the surroundings is open."""


@dataclass(frozen=True)
class Palette:
    """Where each ramp lies in the texture."""

    @property
    def columns(self) -> int:
        return _COLUMNS_PER_RAMP * len(RAMPS)

    def at(self, ramp: str, share: float = 0.0) -> float:
        """Palette position of a colour, `share` of the way along its ramp."""
        return float(self.along(ramp, np.array([share]))[0])

    def along(self, ramp: str, shares: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Palette positions (N,) for places (N,) in [0, 1] along a ramp."""
        start = list(RAMPS).index(ramp) * _COLUMNS_PER_RAMP
        inset = 1.5  # never read the neighbouring ramp
        place = start + inset + np.clip(shares, 0.0, 1.0) * (_COLUMNS_PER_RAMP - 2 * inset)
        return np.asarray(place / self.columns)

    def coordinates(self, paint: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Texture coordinates (V, 2) of paint (V, 2): full light must not wrap around to the darkest row."""
        light = (0.5 + np.clip(paint[:, 1], 0.0, 1.0) * (_LIGHT_ROWS - 1)) / _LIGHT_ROWS
        return np.column_stack([paint[:, 0], light])

    def texture(self) -> npt.NDArray[np.uint8]:
        """The palette as an image (rows, columns, 3), row 0 for full light (texture coordinates run upwards)."""
        ramps = np.concatenate([_ramp(colours) for colours in RAMPS.values()])
        light = np.linspace(1.0, 0.0, _LIGHT_ROWS)[:, None, None]
        # Shaded colours keep their red longest: light that bounces around skin, wood and cloth turns warm.
        warmth = np.array([0.90, 1.0, 1.08])
        level = (_DARKEST + (1.0 - _DARKEST) * light) ** warmth
        return np.asarray((ramps[None] * level * 255.0).round().clip(0, 255).astype(np.uint8))


def _ramp(colours: tuple[Colour, ...]) -> npt.NDArray[np.float64]:
    place = np.linspace(0.0, 1.0, _COLUMNS_PER_RAMP)
    stops = np.linspace(0.0, 1.0, len(colours))
    table = np.asarray(colours)
    return np.stack([np.interp(place, stops, table[:, channel]) for channel in range(3)], axis=1)
