"""Statistics of features as LeRobot keeps them beside a dataset, by which policies normalise what they see."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
SAMPLED_PIXELS = 2000
"""Of the pictures of an episode."""

Values = npt.NDArray[Any]


def of_vectors(values: Values) -> dict[str, Any]:
    """(N, D) -> lists of D."""
    found = _statistics(np.asarray(values, np.float64))
    return {name: each.tolist() for name, each in found.items()} | {"count": [len(values)]}


def of_pixels(pixels: Values, pictures: int) -> dict[str, Any]:
    """(N, 3) of ``pictures`` pictures, 0 to 255 -> lists of three channels in [0, 1], each (1, 1)."""
    found = _statistics(np.asarray(pixels, np.float64) / 255.0)
    return {name: each[:, None, None].tolist() for name, each in found.items()} | {"count": [pictures]}


def sampled(picture: Values, pictures: int) -> Values:
    """One of so many pictures, (H, W, 3) -> (N, 3) some of its pixels, always the same ones."""
    pixels = picture.reshape(-1, 3)
    wanted = max(1, SAMPLED_PIXELS // pictures)
    return np.array(pixels[:: max(1, len(pixels) // wanted)])


def as_columns(statistics: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """By the names that they have in the table of episodes."""
    return {f"stats/{key}/{name}": value for key, found in statistics.items() for name, value in found.items()}


def _statistics(values: npt.NDArray[np.float64]) -> dict[str, npt.NDArray[np.float64]]:
    quantiles = np.quantile(values, list(QUANTILES.values()), axis=0)
    usual = {name: getattr(values, name)(axis=0) for name in ("min", "max", "mean", "std")}
    return usual | dict(zip(QUANTILES, quantiles, strict=True))
