"""A tied learner that is tried in held-out scenarios from time to time: where it got no better, it goes back.

With noise on its actions a policy may get the task done where it fails without, and what it is rewarded for is not all
that R-hat says, so its training shows neither.
"""

import copy
import math

import torch
from torch import Tensor

from worker.ml.policies.sac import Actor
from worker.ml.reinforcement.tied_learner import TiedLearner


class WatchedLearner(TiedLearner):
    """A tied learner that is held where it gained most, and knows what a step with the task undone costs."""

    price = 0.0
    """of every step with the task undone; raised whenever the task was lost"""
    best_gain = -math.inf
    """of what it is held at"""

    @property
    def best(self) -> Actor | None:
        """What gained most while the task was kept; None: nothing that keeps it is known."""
        return self.anchor if self.best_gain > -math.inf else None

    def passed(self, gain: float) -> None:
        """The slow copy, which was tried, keeps the task: stay close to it if it gains more than ever, else go back."""
        if gain > self.best_gain:
            self.anchor, self.best_gain = copy.deepcopy(self.average), gain
        else:
            self._go_back()

    def failed(self, price: float) -> None:
        """It has lost the task: go back, and a step with the task undone costs so much more."""
        self._go_back()
        self.price += price

    def _go_back(self) -> None:
        for actor in (self.actor, self.average):
            actor.load_state_dict(self.anchor.state_dict())

    def state(self) -> dict[str, Tensor]:
        """See Learner; with what it knows."""
        return {**super().state(), "price": torch.tensor(self.price), "best_gain": torch.tensor(self.best_gain)}

    def load_state(self, tensors: dict[str, Tensor], updates: int) -> None:
        """See Learner."""
        super().load_state(tensors, updates)
        self.price, self.best_gain = price_in(tensors), float(tensors.get("best_gain", -math.inf))


def price_in(tensors: dict[str, Tensor]) -> float:
    """What a step with the task undone costs in a state of a learner; nothing in one of before there were prices."""
    return float(tensors.get("price", 0.0))
