"""The palette of the scene: one small texture whose columns are colours and whose rows are how much light arrives.

The software renderer draws one colour per mesh, but looks colours up in a texture per pixel. Painting vertices with
(palette position, light) therefore gives smooth gradients (skin to lips) and baked ambient occlusion at no cost.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

_COLUMNS = 64
"""Of a ramp with several colours; a single colour takes fewer."""
_COLUMNS_OF_ONE_COLOUR = 4
_LIGHT_ROWS = 64
_DARKEST = 0.25
"""Share of the light that is left where none of the surroundings is open."""

Colour = tuple[float, float, float]
Ramp = tuple[Colour, ...]

# Each ramp is a list of colours (sRGB, 0 to 1) at equal distances; a vertex may lie anywhere between them.
RAMPS: dict[str, Ramp] = {
    "tongue": ((0.78, 0.40, 0.40), (0.66, 0.28, 0.30)),
    "teeth": ((0.97, 0.96, 0.93),),
    "eye": ((0.93, 0.925, 0.91),),
    "pupil": ((0.06, 0.05, 0.05),),
    "shirt": ((0.50, 0.63, 0.76), (0.43, 0.56, 0.70)),
    "shirt_trim": ((0.40, 0.53, 0.67),),
    "blouse": ((0.66, 0.60, 0.75), (0.58, 0.52, 0.68)),
    "blouse_trim": ((0.55, 0.49, 0.65),),
    "trousers": ((0.34, 0.37, 0.46),),
    "shoe": ((0.86, 0.85, 0.82),),
    "chair": ((0.50, 0.52, 0.56),),
    "cushion": ((0.55, 0.57, 0.60),),
    "tyre": ((0.20, 0.21, 0.23),),
    "metal": ((0.70, 0.72, 0.74), (0.84, 0.85, 0.86)),
    "arm": ((0.17, 0.19, 0.22), (0.24, 0.26, 0.30)),
    "ring": ((0.86, 0.88, 0.89),),
    "spoon": ((0.90, 0.91, 0.92), (0.70, 0.73, 0.77), (0.62, 0.66, 0.70)),
    "grip": ((0.16, 0.60, 0.58),),
    "wall": ((0.97, 0.96, 0.93), (0.92, 0.92, 0.89)),
    "side_wall": ((0.93, 1.00, 0.98), (0.89, 0.96, 0.945)),
    "floor": ((0.90, 0.83, 0.74), (0.84, 0.76, 0.66)),
    "skirting": ((0.96, 0.96, 0.94),),
    "carrot": ((0.96, 0.55, 0.13),),
    "tomato": ((0.88, 0.26, 0.20),),
    "corn": ((0.98, 0.79, 0.20),),
    "water": ((0.20, 0.52, 0.86),),
    "glass": ((0.80, 0.90, 0.96),),
    "glass_rim": ((0.93, 0.97, 1.0),),
    "bamboo": ((0.86, 0.70, 0.46), (0.78, 0.60, 0.37)),
    "tool": ((0.62, 0.66, 0.70),),
    "pea": ((0.42, 0.70, 0.24),),
}

_MOUTH_INSIDE: Colour = (0.36, 0.12, 0.13)


class Complexion(NamedTuple):
    """The colours of a person of one skin tone."""

    skin: Colour
    lips: Colour
    hair: Ramp
    iris: Ramp


_BLUE_EYES: Ramp = ((0.42, 0.54, 0.62), (0.27, 0.37, 0.46))
_BROWN_EYES: Ramp = ((0.36, 0.25, 0.17), (0.24, 0.16, 0.11))
_DARK_EYES: Ramp = ((0.25, 0.17, 0.12), (0.16, 0.11, 0.08))
_BLOND: Ramp = ((0.39, 0.29, 0.19), (0.55, 0.43, 0.29), (0.68, 0.56, 0.41))
_CHESTNUT: Ramp = ((0.20, 0.13, 0.10), (0.36, 0.24, 0.17), (0.47, 0.33, 0.23))
_BROWN: Ramp = ((0.12, 0.08, 0.06), (0.22, 0.15, 0.11), (0.32, 0.22, 0.16))
_DARK_BROWN: Ramp = ((0.08, 0.06, 0.05), (0.15, 0.11, 0.09), (0.23, 0.17, 0.14))
_BLACK: Ramp = ((0.06, 0.05, 0.05), (0.11, 0.095, 0.09), (0.18, 0.155, 0.145))

COMPLEXIONS = (
    Complexion((0.96, 0.82, 0.74), (0.80, 0.48, 0.46), _BLOND, _BLUE_EYES),
    Complexion((0.92, 0.74, 0.62), (0.74, 0.42, 0.40), _CHESTNUT, _BROWN_EYES),
    Complexion((0.84, 0.64, 0.49), (0.66, 0.37, 0.33), _BROWN, _BROWN_EYES),
    Complexion((0.71, 0.51, 0.37), (0.56, 0.31, 0.27), _DARK_BROWN, _DARK_EYES),
    Complexion((0.565, 0.39, 0.28), (0.47, 0.255, 0.225), _BLACK, _DARK_EYES),
    Complexion((0.46, 0.312, 0.232), (0.46, 0.235, 0.215), _BLACK, _DARK_EYES),
)
"""One per skin tone, from the lightest to the darkest."""

WATER = ("water",)
FOOD = ("carrot", "tomato", "corn", "pea")


def ramps(skin_tone: int) -> dict[str, Ramp]:
    """Every ramp by name; the person's own follow the skin tone."""
    person = COMPLEXIONS[skin_tone]
    skin = (
        person.skin,
        _between(person.skin, person.lips, 0.14),
        _between(person.skin, person.lips, 0.52),
        person.lips,
        _between(_MOUTH_INSIDE, person.lips, 0.12),
    )
    return {**RAMPS, "skin": skin, "hair": person.hair, "iris": person.iris}


def _between(first: Colour, second: Colour, share: float) -> Colour:
    r, g, b = (a + share * (z - a) for a, z in zip(first, second, strict=True))
    return r, g, b


class Palette:
    """Where each ramp lies in the texture. The places are the same for every skin tone."""

    def __init__(self) -> None:
        self._columns: dict[str, tuple[int, int]] = {}
        start = 0
        for name, colours in ramps(0).items():
            count = _COLUMNS if len(colours) > 1 else _COLUMNS_OF_ONE_COLOUR
            self._columns[name] = start, count
            start += count
        self.columns = start

    def at(self, ramp: str, share: float = 0.0) -> float:
        """Palette position of a colour, `share` of the way along its ramp."""
        return float(self.along(ramp, np.array([share]))[0])

    def along(self, ramp: str, shares: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Palette positions (N,) for places (N,) in [0, 1] along a ramp."""
        start, count = self._columns[ramp]
        inset = 1.5  # never read the neighbouring ramp
        place = start + inset + np.clip(shares, 0.0, 1.0) * (count - 2 * inset)
        return np.asarray(place / self.columns)

    def coordinates(self, paint: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Texture coordinates (V, 2) of paint (V, 2): full light must not wrap around to the darkest row."""
        light = (0.5 + np.clip(paint[:, 1], 0.0, 1.0) * (_LIGHT_ROWS - 1)) / _LIGHT_ROWS
        return np.column_stack([paint[:, 0], light])

    def texture(self, skin_tone: int = 1) -> npt.NDArray[np.uint8]:
        """The palette as an image (rows, columns, 3), row 0 for full light (texture coordinates run upwards)."""
        colours = ramps(skin_tone)
        row = np.concatenate([_ramp(colours[name], count) for name, (_, count) in self._columns.items()])
        light = np.linspace(1.0, 0.0, _LIGHT_ROWS)[:, None, None]
        # Shaded colours keep their red longest: light that bounces around skin, wood and cloth turns warm.
        warmth = np.array([0.90, 1.0, 1.08])
        level = (_DARKEST + (1.0 - _DARKEST) * light) ** warmth
        return np.asarray((row[None] * level * 255.0).round().clip(0, 255).astype(np.uint8))


def _ramp(colours: Ramp, count: int) -> npt.NDArray[np.float64]:
    place = np.linspace(0.0, 1.0, count)
    stops = np.linspace(0.0, 1.0, len(colours))
    table = np.asarray(colours)
    return np.stack([np.interp(place, stops, table[:, channel]) for channel in range(3)], axis=1)
