"""Soft actor-critic that is held back towards what its actor was some time before. Its actor minimises

    alpha log pi(a | s) - Q(s, a) + weight * sd_Q * KL(pi(. | s) || pi_then(. | s))

with sd_Q the mean spread of Q over that earlier policy's own actions in one state.
"""

import copy

import torch
from torch import Tensor

from worker.ml.policies.sac import Learner, SacConfig

UNIT_EVERY_UPDATES = 400
"""How often the unit of Q is measured anew."""


class TiedLearner(Learner):
    """A learner whose actor is held back towards where it was when hold() was called."""

    def __init__(self, config: SacConfig, offset: Tensor, scale: Tensor, actions: int, weight: float) -> None:
        super().__init__(config, offset, scale, actions)
        self.weight = weight
        self.anchor = self.actor
        self._unit = 1.0

    def hold(self) -> None:
        """From here on, stay close to the present actor."""
        self.anchor = copy.deepcopy(self.actor).requires_grad_(False)

    def state(self) -> dict[str, Tensor]:
        """See Learner; with where it is held."""
        anchor = {f"anchor.{name}": value.clone() for name, value in self.anchor.state_dict().items()}
        return {**super().state(), **anchor, "unit": torch.tensor(self._unit)}

    def load_state(self, tensors: dict[str, Tensor], updates: int) -> None:
        """See Learner."""
        super().load_state(tensors, updates)
        self.hold()
        self.anchor.load_state_dict(anchor_in(tensors))
        self._unit = float(tensors["unit"])

    def tie(self, states: Tensor) -> Tensor | float:
        """See Learner."""
        if self.weight == 0.0:
            return 0.0
        if self.updates % UNIT_EVERY_UPDATES == 2:
            self._unit = self._spread_of_values(states)
        return self.weight * self._unit * gaussian_divergence(*self.actor(states), *self.anchor(states)).mean()

    @torch.no_grad()
    def _spread_of_values(self, states: Tensor) -> float:
        repeated = states.expand(10, *states.shape).reshape(-1, states.shape[-1])
        values = self.critics(repeated, self.anchor.sample(repeated)[0]).amin(0)
        return max(float(values.reshape(10, -1).std(dim=0).mean()), 1e-6)


def anchor_in(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """What the actor that it is held at is made of in a state of a learner."""
    return {name.removeprefix("anchor."): tensors[name] for name in tensors if name.startswith("anchor.")}


def gaussian_divergence(mean: Tensor, log_std: Tensor, other_mean: Tensor, other_log_std: Tensor) -> Tensor:
    """KL(N(mean, std^2) || N(other)) summed over joints, (B, 7) each -> (B,). A tanh after both does not change it."""
    ratio = 2 * (log_std - other_log_std)
    distance = ((mean - other_mean) / other_log_std.exp()) ** 2
    divergence: Tensor = 0.5 * (ratio.exp() + distance - 1.0 - ratio).sum(-1)
    return divergence
