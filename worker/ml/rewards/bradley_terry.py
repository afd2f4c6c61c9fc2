"""Bradley-Terry: from the returns of two segments to the probability that the right one is preferred."""

from typing import Any

import numpy as np
import numpy.typing as npt


def preference_logits(left_returns: Any, right_returns: Any) -> Any:
    """Log odds that right is preferred, Eq. (1): the difference of the returns. Any shape, NumPy or torch."""
    return right_returns - left_returns


def probability_right(logits: npt.NDArray[np.floating]) -> npt.NDArray[np.float64]:
    """P(right preferred), Eq. (1), without overflow for large logits."""
    probability: npt.NDArray[np.float64] = 0.5 * (1.0 + np.tanh(0.5 * np.asarray(logits, np.float64)))
    return probability


LAPSES = 0.1
"""Share of answers that say nothing, as Christiano et al. (2017) assume. Without it a few slips of the finger on easy
pairs weigh as much as many careful answers (docs/results/chosen_modes.md)."""


def probability_of_answer(probability: npt.NDArray[np.floating]) -> npt.NDArray[np.float64]:
    """P(the answer is "right") of people who answer at random LAPSES of the time, from P(right preferred)."""
    answered: npt.NDArray[np.float64] = LAPSES / 2 + (1.0 - LAPSES) * np.asarray(probability, np.float64)
    return answered


def slope_of_answer(probability: npt.NDArray[np.floating]) -> npt.NDArray[np.float64]:
    """Derivative of probability_of_answer() by the log odds that right is preferred."""
    preferred = np.asarray(probability, np.float64)
    slope: npt.NDArray[np.float64] = (1.0 - LAPSES) * preferred * (1.0 - preferred)
    return slope
