"""The Wilson interval of a proportion. The web server has the same without numpy (app.services.answers.accuracy)."""

import numpy as np

_Z_95 = 1.959963984540054


def wilson_interval(correct: float, scored: float, z: float = _Z_95) -> tuple[float, float]:
    """95 % interval of a proportion; unlike the textbook one it stays inside [0, 1] and works for few trials.

    Wilson (1927). ``correct`` may be a fraction where every trial is a mean over repetitions, ``scored``
    where it is what a variance is worth in trials.
    Raises ValueError when nothing was scored.
    """
    if scored < 1 or not 0 <= correct <= scored:
        raise ValueError(f"{correct} of {scored} is not a proportion.")
    share = correct / scored
    centre = share + z * z / (2 * scored)
    margin = z * float(np.sqrt(share * (1 - share) / scored + z * z / (4 * scored * scored)))
    scale = 1 + z * z / scored
    return (centre - margin) / scale, (centre + margin) / scale
