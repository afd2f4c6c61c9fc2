"""Demonstrations as transitions beside the replay, and the loss that keeps a learner near them.

Actor-critic with demonstrations in every batch and a fading imitation loss, in the manner of Nair et al. 2018 (arXiv
1709.10089). For tasks that are too long to be found by chance, such as pouring.
"""

import torch
from torch import Tensor

from worker.domain.type_aliases import Float32Array


class Demonstrations:
    """N transitions like those of the replay, and what the demonstrator wanted to do in each state."""

    def __init__(self, rows: Float32Array, wanted: Float32Array) -> None:
        """``rows`` (N, ...) as in the replay, ``wanted`` (N, A) undisturbed actions in the learner's units."""
        self.rows, self.wanted = torch.from_numpy(rows), torch.from_numpy(wanted)

    def sample(self, count: int) -> tuple[Tensor, Tensor]:
        """Random rows and the wanted actions that belong to them."""
        chosen = torch.randint(len(self.rows), (count,))
        return self.rows[chosen], self.wanted[chosen]


def imitation_loss(mean: Tensor, wanted: Tensor) -> Tensor:
    """Squared distance of the actor's deterministic actions (B, A) from the wanted ones, summed over the joints."""
    return (mean.tanh() - wanted).square().sum(-1).mean()
