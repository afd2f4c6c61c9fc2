"""The frozen reference policy as a torch module, for training filters on top of it and for exporting it."""

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from worker.ml.policies.gaussian import ACTION_STD_FLOOR, LAYERS, LOG_STD_HIGH, LOG_STD_LOW


class FrozenPolicy(nn.Module):
    """observations (..., D) -> action after the tanh and log standard deviation before it, (..., 7) each."""

    offset: Tensor
    scale: Tensor
    action_limit: Tensor

    def __init__(self, weights: Mapping[str, npt.NDArray[np.float32]]) -> None:
        super().__init__()
        self.register_buffer("action_limit", torch.ones(1))
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
        return self.action_limit * centre.tanh(), log_std

    def action_std(self, actions: Tensor, log_std: Tensor) -> Tensor:
        """How far actions spread around the deterministic ones, in action units; see GaussianPolicy.action_std()."""
        slope = self.action_limit * (1.0 - (actions / self.action_limit) ** 2)
        spread: Tensor = (log_std.exp() * slope).clamp_min(ACTION_STD_FLOOR)
        return spread
