"""A tied learner that is tried in held-out scenarios from time to time: where the task gets lost, it goes back.

With noise on its actions a policy may get the task done where it fails without, so its training does not show this.
"""

import copy
import math

import torch
from torch import Tensor

from worker.ml.policies.sac import Actor
from worker.ml.reinforcement.tied_learner import TiedLearner


class WatchedLearner(TiedLearner):
    """A tied learner that knows its best policy so far, and what a step with the task undone costs."""

    price = 0.0
    """of every step with the task undone; raised whenever the task was lost"""
    best: Actor | None = None
    """what gained most while the task was kept"""
    best_gain = -math.inf

    def passed(self, gain: float) -> None:
        """The slow copy, which was tried, keeps the task: stay close to it from here on."""
        self.anchor = copy.deepcopy(self.average)
        if gain > self.best_gain:
            self.best, self.best_gain = self.anchor, gain

    def failed(self, price: float) -> None:
        """It has lost the task: back to where it was held, and a step with the task undone costs so much more."""
        for actor in (self.actor, self.average):
            actor.load_state_dict(self.anchor.state_dict())
        self.price += price

    def state(self) -> dict[str, Tensor]:
        """See Learner; with what it knows."""
        best = {} if self.best is None else self.best.state_dict()
        known = {"price": torch.tensor(self.price), "best_gain": torch.tensor(self.best_gain)}
        return {**super().state(), **known, **{f"best.{name}": value.clone() for name, value in best.items()}}

    def load_state(self, tensors: dict[str, Tensor], updates: int) -> None:
        """See Learner."""
        super().load_state(tensors, updates)
        self.price, self.best_gain = price_in(tensors), float(tensors.get("best_gain", -math.inf))
        if self.best_gain > -math.inf:
            self.best = copy.deepcopy(self.average)
            self.best.load_state_dict(best_in(tensors))


def best_in(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """What the best actor so far is made of in a state of a learner; the slow copy where there is none yet."""
    part = "best." if any(name.startswith("best.") for name in tensors) else "average."
    return {name.removeprefix(part): tensors[name] for name in tensors if name.startswith(part)}


def price_in(tensors: dict[str, Tensor]) -> float:
    """What a step with the task undone costs in a state of a learner; nothing in one of before there were prices."""
    return float(tensors.get("price", 0.0))
