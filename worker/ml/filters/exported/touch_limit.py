"""How hard a step may reach the skin: none goes deeper towards the person than the reference policy's touches usually.

    depth = -outward . (tool - target + motion),    motion = a J + b     m, where the step would end with nobody there
    action' = action + near (limit - depth) g / |g|^2,    g = -J outward           where depth > limit, else as it is

Most high forces are blows: the tool comes from free air, and the force follows how deep the step would have ended
(decision 168). Only the part of the action that leads into the skin is taken back, so whoever wants it fast keeps that
along the skin.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from worker.domain.spaces import Space
from worker.domain.trajectory import Trajectory
from worker.domain.type_aliases import Float32Array, FloatArray

FORCE, DISTANCE, OUTWARD = "force_on_person_n", "tool_to_target_m", "target_outward"
"""Fields of our tasks; a laboratory's have none of them, and no such limit."""
NEAR_M, COMING_NEAR_M = 0.10, 0.05
"""Within the first it counts, on the way there the more the nearer."""
TOUCH_N = 0.3
"""Forces from here on are touches."""
USUAL_TOUCH, USUAL_STEP = 0.75, 0.95
"""Quantiles of the depths of the reference policy's touches, and of its steps that touch nobody. Where the latter is
deeper, as with a cup's rim, depth says nothing about touches."""
LEAST_STEPS, EXPLAINED = 100, 0.7
"""Steps to learn the motion from, and what of the way into the skin has to follow from the action."""
NAMES = ("touch_motion", "touch_depth")


class TouchLimit(nn.Module):
    """observation (B, D), action (B, A) -> action (B, A), the share of it that was taken back (B, 1) in [0, 1]."""

    touch_motion: Tensor
    touch_depth: Tensor

    def __init__(self, space: Space, limits: Mapping[str, Float32Array]) -> None:
        super().__init__()
        self.place, self.outward = space.slice_of(DISTANCE), space.slice_of(OUTWARD)
        for name in NAMES:
            self.register_buffer(name, torch.from_numpy(np.array(limits[name], np.float32)))

    def forward(self, observation: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """See the module."""
        to_target, outward = observation[:, self.place], observation[:, self.outward]
        motion = action @ self.touch_motion[:-1] + self.touch_motion[-1]
        depth = ((to_target - motion) * outward).sum(-1, keepdim=True)
        near = ((NEAR_M + COMING_NEAR_M - length(to_target)) / COMING_NEAR_M).clamp(0.0, 1.0)
        inward = -outward @ self.touch_motion[:-1].T
        size = (inward * inward).sum(-1, keepdim=True).clamp(min=1e-12)
        taken = near * (depth - self.touch_depth).clamp(min=0.0) * inward / size
        share = length(taken) / length(action).clamp(min=1e-6)
        return action - taken, share.clamp(0.0, 1.0)


def length(vectors: Tensor) -> Tensor:
    """(B, K) -> (B, 1)"""
    return (vectors * vectors).sum(-1, keepdim=True).sqrt()


@dataclass(frozen=True)
class _Steps:
    """Steps near the person that begin without a touch: (N, A), (N, 3), (N, 3), (N, 3), (N,)."""

    actions: FloatArray
    motion: FloatArray
    to_target: FloatArray
    outward: FloatArray
    touch: NDArray[np.bool_]
    """whether they end in one"""

    def only(self, which: NDArray[np.bool_]) -> Self:
        """Those alone."""
        return replace(self, **{field.name: getattr(self, field.name)[which] for field in fields(self)})

    def predicted(self, learned: FloatArray) -> FloatArray:
        """(N, 3), the motion that follows from the actions."""
        motion: FloatArray = self.actions @ learned[:-1] + learned[-1]
        return motion

    def along_outward(self, vectors: FloatArray) -> FloatArray:
        """(N,)"""
        along: FloatArray = (vectors * self.outward).sum(axis=1)
        return along


def _steps(space: Space, rollouts: Sequence[Trajectory]) -> _Steps:
    to_target, outward, force = (space.slice_of(name) for name in (DISTANCE, OUTWARD, FORCE))
    before, after = (
        np.concatenate([each.observations[some] for each in rollouts]).astype(np.float64)
        for some in (slice(None, -1), slice(1, None))
    )
    steps = _Steps(
        np.concatenate([each.actions for each in rollouts]).astype(np.float64),
        before[:, to_target] - after[:, to_target],
        before[:, to_target],
        before[:, outward],
        after[:, force][:, 0] >= TOUCH_N,
    )
    free = before[:, force][:, 0] < TOUCH_N
    return steps.only(free & (np.linalg.norm(steps.to_target, axis=1) <= NEAR_M))


def touch_limits(space: Space, reference: Sequence[Trajectory]) -> dict[str, Float32Array]:
    """How actions move the tool near the person, (A + 1, 3) in m, and the usual depth, (1,) in m.

    Empty where the task does not observe what it takes, or touches do not follow from the actions.
    """
    if not {FORCE, DISTANCE, OUTWARD} <= {field.name for field in space.fields}:
        return {}
    steps = _steps(space, reference)
    free = steps.only(~steps.touch)
    if len(free.touch) < LEAST_STEPS or not steps.touch.any():
        return {}
    with_one = np.column_stack([free.actions, np.ones(len(free.actions))])
    learned = np.asarray(np.linalg.lstsq(with_one, free.motion, rcond=None)[0], np.float64)
    inward, missed = free.along_outward(free.motion), free.along_outward(free.motion - free.predicted(learned))
    depth = steps.along_outward(steps.to_target - steps.predicted(learned))
    limit = float(np.quantile(depth[steps.touch], USUAL_TOUCH))
    foretold = missed.var() <= (1.0 - EXPLAINED) * inward.var() and limit > np.quantile(depth[~steps.touch], USUAL_STEP)
    if not foretold:
        return {}
    return {"touch_motion": learned.astype(np.float32), "touch_depth": np.array([limit], np.float32)}
