"""Bradley-Terry: from the returns of two segments to the probability that the right one is preferred, and its loss.

The paper's Eq. (2) weighs log P[s1 > s0] with (1 - y) although y = 1 means that s1 was preferred; trained as printed it
learns the opposite of what was said. Here the target y is the probability that the right segment (the paper's s1) is
preferred: 1 right, 0 left, 1/2 equal. "Can't tell" has no target and must have been left out before.
"""

from typing import Any

import numpy as np
import numpy.typing as npt
from torch import Tensor
from torch.nn import functional


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


def preference_loss(logits: Tensor, targets: Tensor, weights: Tensor | None = None) -> Tensor:
    """Mean cross-entropy, Eq. (2) in the right form: y log P[right] + (1 - y) log P[left].

    logits and targets (..., N), targets in {0, 1/2, 1}; weights (..., N) for bootstrap counts.
    """
    return functional.binary_cross_entropy_with_logits(logits, targets.expand_as(logits), weights)


def preference_loss_as_printed(logits: Tensor, targets: Tensor) -> Tensor:
    """Eq. (2) letter by letter. Kept only so that a test can show that it learns the reversed preference."""
    return functional.binary_cross_entropy_with_logits(logits, 1.0 - targets.expand_as(logits))
