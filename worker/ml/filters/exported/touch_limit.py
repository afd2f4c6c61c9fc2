"""How a step may reach the skin: no deeper than the reference policy's touches, and beside the target hardly sooner.

    depth = -outward . (tool - target + motion),    motion = a J(q) + b(q)   m, where the step would end by itself
    closer = -outward . (a - mean) J(q)             m, that it leads nearer to the skin than the reference policy's
    excess = max(depth - deepest, beside (closer - CLOSING height)),    height = outward . (tool - target) - skin
    action' = action + near excess g / |g|^2,       g = J(q) outward         where excess > 0, else as it is

J and b are linear in the joint angles q. Most high forces are blows: the force follows how deep the step would end
(decisions 168 and 169). Beside the target, where the reference policy seldom touches, depth says little: there the
robot may come nearer sooner than the reference policy only while it is still far from the skin (decision 175). Only the
part of the action that leads into the skin is taken back, so whoever wants it fast keeps that along the skin; and never
more than the whole action's size, whatever is foretold for postures never seen.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from worker.domain.spaces import Space
from worker.domain.trajectory import Trajectory
from worker.domain.type_aliases import Float32Array, FloatArray

FORCE, DISTANCE, OUTWARD = "force_on_person_n", "tool_to_target_m", "target_outward"
JOINTS = "joint_positions_rad"
FIELDS = {FORCE, DISTANCE, OUTWARD, JOINTS}
"""Of our tasks; a laboratory's lack some of them, and have no such limit."""
NEAR_M, COMING_NEAR_M = 0.10, 0.05
"""Within the first it counts, on the way there the more the nearer."""
BESIDE_M = 0.02
"""So much farther from the target than usual touches of the reference policy, all of it is beside the target."""
CLOSING = 0.1
"""of the height above the skin that a step may lead nearer than the reference policy's"""
TOUCH_N = 0.3
"""Forces from here on are touches."""
USUAL = 0.95
"""Quantile of what is said of the reference policy's steps that end in a touch: depth, height, distance to the target.
Where that of the depths of steps that touch nobody is deeper, as with a cup's rim, depth says nothing about touches."""
LEAST_STEPS, EXPLAINED = 1000, 0.7
"""Steps to learn the motion from, and what of the way into the skin has to follow from the action."""
RIDGE = 1e-3
"""on the squares of the motion's coefficients"""
NAMES = ("touch_motion", "touch_depth", "touch_place")
"""of limits. The last has come later: filters made before go without."""
NO_LIMIT_M = 1e6


class TouchLimit(nn.Module):
    """observation (B, D), mean (B, A), action (B, A) -> action (B, A), the share of it that was taken back (B, 1)."""

    touch_motion: Tensor
    touch_depth: Tensor
    touch_place: Tensor

    def __init__(self, space: Space, limits: Mapping[str, Float32Array]) -> None:
        super().__init__()
        self.place, self.outward, self.joints = (space.slice_of(name) for name in (DISTANCE, OUTWARD, JOINTS))
        for name in NAMES:
            limit = limits.get(name, (0.0, NO_LIMIT_M))
            self.register_buffer(name, torch.from_numpy(np.array(limit, np.float32)))

    def forward(self, observation: Tensor, mean: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """See the module."""
        to_target, outward = observation[:, self.place], observation[:, self.outward]
        coefficients = _and_one(observation[:, self.joints]) @ self.touch_motion.flatten(1)
        coefficients = coefficients.reshape(-1, *self.touch_motion.shape[1:])
        motion = (_and_one(action).unsqueeze(1) @ coefficients).squeeze(1)
        depth = ((to_target - motion) * outward).sum(-1, keepdim=True)
        inward = -(coefficients[:, :-1] @ outward.unsqueeze(2)).squeeze(2)
        closer = ((action - mean) * inward).sum(-1, keepdim=True)
        height = (-(to_target * outward).sum(-1, keepdim=True) - self.touch_place[0]).clamp(min=0.0)
        away = length(to_target)
        near = ((NEAR_M + COMING_NEAR_M - away) / COMING_NEAR_M).clamp(0.0, 1.0)
        beside = ((away - self.touch_place[1]) / BESIDE_M).clamp(0.0, 1.0)
        excess = torch.maximum(depth - self.touch_depth, beside * (closer - CLOSING * height)).clamp(min=0.0)
        size = (inward * inward).sum(-1, keepdim=True).clamp(min=1e-12)
        taken = near * excess * inward / size
        share = length(taken) / length(action).clamp(min=1e-6)
        return action - taken / share.clamp(min=1.0), share.clamp(max=1.0)


def length(vectors: Tensor) -> Tensor:
    """(B, K) -> (B, 1)"""
    return (vectors * vectors).sum(-1, keepdim=True).sqrt()


def _and_one(vectors: Tensor) -> Tensor:
    """(B, K) -> (B, K + 1)"""
    return torch.cat([vectors, torch.ones_like(vectors[:, :1])], -1)


def touch_limits(space: Space, reference: Sequence[Trajectory]) -> dict[str, Float32Array]:
    """How actions move the tool near the person, (J + 1, A + 1, 3) in m, and how the reference policy touches.

    That is the usual depth of its touches, (1,) in m; how high above the target the skin is met, and how far from the
    target, (2,) in m. Empty where the task does not observe what it takes, or motions do not follow from the actions.
    """
    if not {field.name for field in space.fields} >= FIELDS:
        return {}
    before, after = (
        np.concatenate([each.observations[some] for each in reference]).astype(np.float64)
        for some in (slice(None, -1), slice(1, None))
    )
    actions = np.concatenate([each.actions for each in reference]).astype(np.float64)
    away = np.linalg.norm(before[:, space.slice_of(DISTANCE)], axis=1)
    near = away <= NEAR_M
    before, after, actions, away = before[near], after[near], actions[near], away[near]
    touch = after[:, space.slice_of(FORCE)][:, 0] >= TOUCH_N
    if len(touch) < LEAST_STEPS or touch.all() or not touch.any():
        return {}
    to_target, outward = before[:, space.slice_of(DISTANCE)], before[:, space.slice_of(OUTWARD)]
    motion = to_target - after[:, space.slice_of(DISTANCE)]
    one = np.ones((len(touch), 1))
    joints, with_one = np.hstack([before[:, space.slice_of(JOINTS)], one]), np.hstack([actions, one])
    features = (joints[:, :, None] * with_one[:, None, :]).reshape(len(touch), -1)
    learned = np.linalg.solve(features.T @ features + RIDGE * np.eye(features.shape[1]), features.T @ motion)

    def along_outward(vectors: FloatArray) -> FloatArray:
        along: FloatArray = (vectors * outward).sum(axis=1)
        return along

    predicted = features @ learned
    missed = along_outward(motion - predicted).var() / max(along_outward(motion).var(), 1e-12)
    if missed > 1.0 - EXPLAINED:
        return {}
    depth = along_outward(to_target - predicted)
    deepest = np.quantile(depth[touch], USUAL)
    if deepest <= np.quantile(depth[~touch], USUAL):
        deepest = NO_LIMIT_M
    place = [np.quantile(each[touch], USUAL) for each in (-along_outward(to_target), away)]
    shape = (joints.shape[1], with_one.shape[1], motion.shape[1])
    learned_motion = learned.reshape(shape)
    limits = zip(NAMES, (learned_motion, [deepest], place), strict=True)
    return {name: np.array(limit, np.float32) for name, limit in limits}


def described(limits: Mapping[str, Float32Array]) -> dict[str, Any]:
    """These limits as a bundle's manifest has them."""
    (deepest,) = limits["touch_depth"].tolist()
    said: dict[str, Any] = {"within_m": NEAR_M, "from_m": NEAR_M + COMING_NEAR_M}
    said |= {} if deepest == NO_LIMIT_M else {"deepest_m": deepest}
    said |= {"tool_motion_m": limits["touch_motion"].tolist()}
    said |= {"axes_of_tool_motion": ["joint angles in rad, and 1", "numbers of the action, and 1", "x, y, z"]}
    if "touch_place" in limits:
        skin, at_target = limits["touch_place"].tolist()
        beside = {"from_m": at_target, "beyond_m": at_target + BESIDE_M, "skin_m": skin}
        said["beside_target"] = beside | {"nearer_than_reference_by_share_of_height": CLOSING}
    return said
