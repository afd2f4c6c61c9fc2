"""The loss of networks that learn from preferences, over the log odds of Bradley-Terry.

The paper's Eq. (2) weighs log P[s1 > s0] with (1 - y) although y = 1 means that s1 was preferred; trained as printed it
learns the opposite of what was said. Here the target y is the probability that the right segment (the paper's s1) is
preferred: 1 right, 0 left, 1/2 equal. "Can't tell" has no target and must have been left out before.
"""

from torch import Tensor
from torch.nn import functional


def preference_loss(logits: Tensor, targets: Tensor, weights: Tensor | None = None) -> Tensor:
    """Mean cross-entropy, Eq. (2) in the right form: y log P[right] + (1 - y) log P[left].

    logits and targets (..., N), targets in {0, 1/2, 1}; weights (..., N) for bootstrap counts.
    """
    return functional.binary_cross_entropy_with_logits(logits, targets.expand_as(logits), weights)


def preference_loss_as_printed(logits: Tensor, targets: Tensor) -> Tensor:
    """Eq. (2) letter by letter. Kept only so that a test can show that it learns the reversed preference."""
    return functional.binary_cross_entropy_with_logits(logits, 1.0 - targets.expand_as(logits))
