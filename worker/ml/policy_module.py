"""The frozen reference policy as a torch module, for training filters on top of it and for exporting it."""

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from worker.ml.policies import LAYERS, LOG_STD_HIGH, LOG_STD_LOW


class FrozenPolicy(nn.Module):
    """observations (..., D) -> action after the tanh and log standard deviation before it, (..., 7) each."""

    offset: Tensor
    scale: Tensor

    def __init__(self, weights: Mapping[str, npt.NDArray[np.float32]]) -> None:
        super().__init__()
        for name, array in weights.items():
            self.register_buffer(name, torch.from_numpy(np.array(array)))

    def forward(self, observations: Tensor) -> tuple[Tensor, Tensor]:
        """See the class."""
        hidden = (observations - self.offset) * self.scale
        for index in range(LAYERS - 1):
            hidden = (hidden @ self.get_buffer(f"weight_{index}") + self.get_buffer(f"bias_{index}")).relu()
        last = LAYERS - 1
        raw = hidden @ self.get_buffer(f"weight_{last}") + self.get_buffer(f"bias_{last}")
        centre, spread = raw.chunk(2, -1)
        log_std = LOG_STD_LOW + (LOG_STD_HIGH - LOG_STD_LOW) * 0.5 * (spread.tanh() + 1)
        return centre.tanh(), log_std
