"""How often the model's prediction agreed with what the person then said."""

from typing import Any

import numpy as np
import numpy.typing as npt

Z_95 = 1.959963984540054


def wilson_interval(correct: float, scored: int, z: float = Z_95) -> tuple[float, float]:
    """95 % interval of a proportion; unlike the textbook one it stays inside [0, 1] and works for few trials.

    Wilson (1927). ``correct`` may be a fraction where every trial is a mean over repetitions.
    Raises ValueError when nothing was scored.
    """
    if scored < 1 or not 0 <= correct <= scored:
        raise ValueError(f"{correct} of {scored} is not a proportion.")
    share = correct / scored
    centre = share + z * z / (2 * scored)
    margin = z * float(np.sqrt(share * (1 - share) / scored + z * z / (4 * scored * scored)))
    scale = 1 + z * z / scored
    return (centre - margin) / scale, (centre + margin) / scale


def prequential(predicted_right: npt.ArrayLike, targets: npt.ArrayLike, window: int = 30) -> dict[str, Any]:
    """Accuracy of predictions that were made before each label was seen.

    predicted_right (N,): P(right) at the time of asking, NaN where no model existed yet; targets (N,) in {0, 1/2, 1}.
    Ties ("equal") have no right answer and are not scored. Values are None while nothing has been scored.
    """
    predicted, said = np.asarray(predicted_right, np.float64), np.asarray(targets, np.float64)
    scored = np.isfinite(predicted) & (said != 0.5)
    hits = ((predicted > 0.5) == (said > 0.5))[scored]
    return {"overall": _proportion(hits), "recent": _proportion(hits[-window:]), "window": window}


def _proportion(hits: npt.NDArray[np.bool_]) -> dict[str, Any]:
    correct, scored = int(hits.sum()), len(hits)
    if scored == 0:
        return {"correct": 0, "scored": 0, "accuracy": None, "low": None, "high": None}
    low, high = wilson_interval(correct, scored)
    return {"correct": correct, "scored": scored, "accuracy": correct / scored, "low": low, "high": high}
