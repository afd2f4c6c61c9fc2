"""Execution modes of a policy nobody can look into: they act on the actions it says, for any continuous actions.

Speed is time-scaling: of velocities or changes of position a part is the same way, more slowly. What a mode needs
beside the policy's action stands at the end of the observation: the action before, and how much of the episode is over.
So a filter stays a function of one observation and one action, and what is trained is what is shipped.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from worker.domain.modes import Axis, ModeFamily

PREVIOUS_ACTION, EPISODE_SHARE = "previous_action", "episode_share"
BY_DISTANCE, BY_TIME = ("far", "near"), ("early", "late")
HALFWAY, WIDTH = 0.5, 0.5
"""Share of the way (or of the episode) around which early becomes late, and over how much of it."""
HESITATES_AT, HESITATES_WITHIN = 0.35, 0.15
"""Share of the way that is left where hesitate slows the robot, and how far around it."""
SPEED, SMOOTH, HESITATE, PUSH, SHIFT = (-1.4, 0.9), (0.0, 0.9), (0.0, 2.0), (-0.6, 0.6), (-0.6, 0.6)
GAIN = SPEED
"""Widest ranges; the program narrows them (worker.experiments.lab_ranges)."""
MOST_PUSHES, MOST_SHIFTS = 6, 3
PUSHES_UNTIL = 0.5
"""Share of the episode after which nothing is pushed, so that every way arrives."""


def widest_axes(by_distance: bool, moving: tuple[str, ...], groups: tuple[str, ...] = ()) -> tuple[Axis, ...]:
    """Every way there is, in its widest range. ``moving``: names of the actions that move the robot; ``groups``: of
    groups of them."""
    early, late = BY_DISTANCE if by_distance else BY_TIME
    where = {"far": "far from the goal", "near": "near the goal", "early": "early", "late": "late in the episode"}
    shifted = moving[:MOST_SHIFTS] if by_distance else ()
    return (
        Axis(f"speed_{early}", *SPEED, f"log of the speed factor {where[early]}"),
        Axis(f"speed_{late}", *SPEED, f"log of the speed factor {where[late]}"),
        Axis("smooth", *SMOOTH, "share of the action before that is kept: a low-pass filter"),
        *(Axis(f"gain_{name}", *GAIN, f"log of the gain of the actions {name} alone") for name in groups),
        Axis("hesitate", *HESITATE, "slows down before the end of the way"),
        *(Axis(f"push_{name}", *PUSH, f"added to the action {name} on the way") for name in moving[:MOST_PUSHES]),
        *(Axis(f"shift_{name}", *SHIFT, f"added to the action {name} near the goal") for name in shifted),
    )


@dataclass(frozen=True)
class LabModes(ModeFamily):
    """Speed early and late and of groups of actions, smoothing, hesitation, a push per action that fades on the way,
    and a shifted goal.

    The goal is shifted without asking the policy again: where it settles at the goal, a constant added to an action
    there lets it settle beside the goal, as far as the constant over the policy's own gain.
    """

    actions: tuple[str, ...]
    """their names"""
    moving: tuple[int, ...]
    """those that modes change, from 0"""
    tip: tuple[int, ...] = ()
    """columns of the observation; empty: ways differ by time"""
    goal: tuple[int, ...] = ()
    start_distance_m: float = 1.0
    """how far the goal usually is at the start"""
    groups: tuple[tuple[str, tuple[int, ...]], ...] = ()
    """names of groups of actions, each with its actions, from 0"""

    def perceived(self, observation: Any, mode: Any, xp: Any = np) -> Any:
        """The policy sees what is there."""
        return observation

    def executed(self, observation: Any, mode: Any, action: Any, xp: Any = np) -> Any:
        """(..., D), (..., A) -> (..., A); not clipped."""
        left = self._left(observation, xp)
        early = xp.clip((left - HALFWAY + WIDTH / 2) / WIDTH, 0.0, 1.0)
        names = BY_DISTANCE if self.tip and self.goal else BY_TIME
        band = xp.clip(1.0 - ((left - HESITATES_AT) / HESITATES_WITHIN) ** 2, 0.0, 1.0)
        quicker = (
            self._of(mode, f"speed_{names[0]}") * early
            + self._of(mode, f"speed_{names[1]}") * (1.0 - early)
            - self._of(mode, "hesitate") * band
        )
        for name, members in self.groups:
            quicker = quicker + self._of(mode, f"gain_{name}") * self._are(members, action, xp)
        scaled = action * xp.exp(quicker)
        pushed = early * xp.clip(1.0 - self._field(observation, EPISODE_SHARE) / PUSHES_UNTIL, 0.0, 1.0)
        for index in self.moving:
            push, shift = (self._of(mode, f"{way}_{self.actions[index]}") for way in ("push", "shift"))
            scaled = scaled + (pushed * push + (1.0 - early) * shift) * self._are((index,), action, xp)
        kept = self._of(mode, "smooth")
        smoothed = (1.0 - kept) * scaled + kept * self._field(observation, PREVIOUS_ACTION)
        if len(self.moving) == len(self.actions):
            return smoothed
        return action + self._are(self.moving, action, xp) * (smoothed - action)

    def _left(self, observation: Any, xp: Any) -> Any:
        """Share of the way (or of the time) that is left, (..., 1)."""
        if not (self.tip and self.goal):
            return 1.0 - self._field(observation, EPISODE_SHARE)
        way = observation[..., list(self.goal)] - observation[..., list(self.tip)]
        return xp.sqrt((way * way).sum(-1) + 1e-12)[..., None] / self.start_distance_m

    def _are(self, which: tuple[int, ...], action: Any, xp: Any) -> Any:
        """(A,) 1 for these actions and 0 for the others."""
        return xp.asarray([float(place in which) for place in range(len(self.actions))], dtype=action.dtype)


@dataclass(frozen=True)
class PolicyChoice(ModeFamily):
    """One of several policies instead of a filter: an axis for each but the frozen one, one of them 1 or all 0."""

    def sample(self, count: int, rng: np.random.Generator) -> npt.NDArray[np.float64]:
        """Random policies, (count, A), each equally often."""
        every = np.concatenate([np.zeros((1, len(self.axes))), np.eye(len(self.axes))])
        chosen: npt.NDArray[np.float64] = every[rng.integers(len(every), size=count)]
        return chosen

    def policy(self, mode: npt.ArrayLike) -> str:
        """See ModeFamily."""
        chosen = np.flatnonzero(np.asarray(mode) > 0.5)
        return self.names[int(chosen[0])] if len(chosen) else ""

    def perceived(self, observation: Any, mode: Any, xp: Any = np) -> Any:
        """Every policy sees what is there."""
        return observation


def policy_axes(names: tuple[str, ...]) -> tuple[Axis, ...]:
    """The axes of a PolicyChoice among the frozen policy and these."""
    return tuple(Axis(name, 0.0, 1.0, f"1: the policy {name} instead of the frozen one") for name in names)
