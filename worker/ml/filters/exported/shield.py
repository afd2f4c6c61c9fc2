"""The shield inside filter.onnx: outside what was tested the action returns smoothly to the reference policy's.

    action' = mean + (1 - activity) (action - mean),     activity = x^2 (3 - 2 x),    x = clip(largest excess, 0, 1)

An excess is how far a number has left its limits, in units of a ramp behind them. Limited are every number of the
observation, the force on the person among them, the change that the filter makes to every number of the action, and
the size of the action near the person. After that, what of the action would strike the skin is taken back
(touch_limit). It has no memory, so what is shown about one step holds for every episode.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from worker.domain.spaces import Space
from worker.domain.trajectory import Trajectory
from worker.domain.type_aliases import Float32Array
from worker.ml.filters.exported import touch_limit
from worker.ml.filters.exported.touch_limit import DISTANCE, FORCE, NAMES, TouchLimit, length, touch_limits

RAMP = 0.25
"""of a range's width, behind which the filter is off"""
NARROWEST = 0.01
"""of a field's declared width: no ramp is narrower"""
FORCE_RAMP_N = 2.0
FORCE_QUANTILE = 0.95
"""Of the tested episodes' largest forces; the gate looks at the same."""
NEAR_M, COMING_NEAR_M = 0.20, 0.05
"""Within the first the size of the action counts, on the way there the more the nearer."""


class Shield(nn.Module):
    """observation (B, D), mean (B, A), action (B, A) -> action (B, A), activity (B, 1) in [0, 1]."""

    observation_low: Tensor
    observation_high: Tensor
    observation_ramp: Tensor
    change_low: Tensor
    change_high: Tensor
    change_ramp: Tensor
    near_action: Tensor

    def __init__(self, space: Space, limits: Mapping[str, Float32Array]) -> None:
        super().__init__()
        self.place = space.slice_of(DISTANCE) if "near_action" in limits else None
        self.touch = TouchLimit(space, limits) if NAMES[0] in limits else None
        for name, array in limits.items():
            if name not in NAMES:
                self.register_buffer(name, torch.from_numpy(np.array(array, np.float32)))

    def forward(self, observation: Tensor, mean: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """See the class."""
        change = action - mean
        excesses = [
            _excess(observation, self.observation_low, self.observation_high, self.observation_ramp),
            _excess(change, self.change_low, self.change_high, self.change_ramp),
        ]
        if self.place is not None:
            nearness = ((NEAR_M + COMING_NEAR_M - length(observation[:, self.place])) / COMING_NEAR_M).clamp(0.0, 1.0)
            excesses.append(nearness * (length(action) - self.near_action[0]) / self.near_action[1])
        excess = torch.cat(excesses, -1).amax(-1, keepdim=True).clamp(0.0, 1.0)
        activity = excess * excess * (3.0 - 2.0 * excess)
        action = mean + (1.0 - activity) * change
        if self.touch is None:
            return action, activity
        action, taken = self.touch(observation, mean, action)
        return action, torch.maximum(activity, taken)


def _excess(values: Tensor, low: Tensor, high: Tensor, ramp: Tensor) -> Tensor:
    return torch.maximum((low - values) / ramp, (values - high) / ramp).amax(-1, keepdim=True)


def limits_of(
    observation: Space, action: Space, tested: Sequence[Trajectory], reference: Sequence[Trajectory]
) -> dict[str, Float32Array]:
    """What these rollouts of a filter, and those of the reference policy, have stayed within."""
    rollouts = [*tested, *reference]
    seen = np.concatenate([each.observations[:-1] for each in rollouts])
    done = np.concatenate([each.actions for each in rollouts])
    change = done - np.concatenate([each.reference_actions for each in rollouts])
    limits = {**_box("observation", observation, seen), **_box("change", action, change)}
    names = {field.name: place for field, place in observation.slices()}
    if FORCE in names:
        largest = [each.observations[:, names[FORCE]].max() for each in tested]
        usual = float(np.quantile(largest, FORCE_QUANTILE))
        limits["observation_high"][names[FORCE]] = max(
            usual, *(float(each.observations[:, names[FORCE]].max()) for each in reference)
        )
        limits["observation_ramp"][names[FORCE]] = FORCE_RAMP_N
    if DISTANCE in names:
        near = np.linalg.norm(seen[:, names[DISTANCE]], axis=1) <= NEAR_M + COMING_NEAR_M
        size = float(np.linalg.norm(done[near], axis=1).max(initial=0.0))
        limits["near_action"] = np.array([size, max(RAMP * size, NARROWEST)], np.float32)
    return {**limits, **touch_limits(observation, reference)}


def widened(
    limits: Mapping[str, Float32Array], observation: Space, reference: Sequence[Trajectory]
) -> dict[str, Float32Array]:
    """The same, but the observation as far as these rollouts of the reference policy have stayed within, too.

    How somebody sits is no filter's doing, and a gate's few scenarios show little of it. Nor do they show how hard the
    reference policy presses at worst, to which nobody should be returned because of less (decision 180).
    """
    seen = _box("observation", observation, np.concatenate([each.observations for each in reference]))
    ramp = np.maximum(limits["observation_ramp"], seen["observation_ramp"])
    for field, place in observation.slices():
        if field.name == FORCE:
            ramp[place] = FORCE_RAMP_N
    return {
        **limits,
        "observation_low": np.minimum(limits["observation_low"], seen["observation_low"]),
        "observation_high": np.maximum(limits["observation_high"], seen["observation_high"]),
        "observation_ramp": ramp,
    }


def widest(observation: Space, action_size: int) -> dict[str, Float32Array]:
    """Limits that nothing leaves, for tracing; without NAMES those of a filter whose touches cannot be foretold."""
    sizes = {"observation": observation.size, "change": action_size}
    ends = {"low": -1e6, "high": 1e6, "ramp": 1.0}
    limits = {f"{name}_{end}": np.full(size, ends[end], np.float32) for name, size in sizes.items() for end in ends}
    places = {field.name: place for field, place in observation.slices()}
    if DISTANCE in places:
        limits["near_action"] = np.array([1e6, 1.0], np.float32)
    if places.keys() >= touch_limit.FIELDS:
        joints = len(range(observation.size)[places[touch_limit.JOINTS]])
        limits["touch_motion"] = np.ones((joints + 1, action_size + 1, 3), np.float32)
        limits["touch_depth"] = np.array([touch_limit.NO_LIMIT_M], np.float32)
        limits["touch_place"] = np.array([0.0, touch_limit.NO_LIMIT_M], np.float32)
    return limits


def untried(observation: Space, action_size: int, reference: Sequence[Trajectory]) -> dict[str, Float32Array]:
    """Limits of a filter that has not been tried yet: how hard it may reach the skin alone, if that can be said."""
    limits = touch_limits(observation, reference)
    return {**widest(observation, action_size), **limits} if limits else {}


def _box(name: str, space: Space, values: Float32Array) -> dict[str, Float32Array]:
    low, high = values.min(axis=0), values.max(axis=0)
    ramp = np.maximum(RAMP * (high - low), NARROWEST * space.widths)
    return {
        f"{name}_{end}": np.asarray(array, np.float32) for end, array in (("low", low), ("high", high), ("ramp", ramp))
    }


def described(observation: Space, action: Space, limits: Mapping[str, Float32Array]) -> dict[str, Any]:
    """The limits as a bundle's manifest has them: by the names of the fields."""

    def of(name: str, space: Space) -> list[dict[str, Any]]:
        ends = {end: limits[f"{name}_{end}"] for end in ("low", "high", "ramp")}
        return [
            {"name": field.name, "unit": field.unit, **{end: array[place].tolist() for end, array in ends.items()}}
            for field, place in space.slices()
        ]

    found: dict[str, Any] = {
        "observation": of("observation", observation),
        "change_of_action": of("change", action),
    }
    if "near_action" in limits:
        size, ramp = limits["near_action"].tolist()
        found["size_of_action_near_person"] = {"within_m": NEAR_M, "from_m": NEAR_M + COMING_NEAR_M}
        found["size_of_action_near_person"] |= {"high": size, "ramp": ramp}
    if NAMES[0] in limits:
        found["step_near_person"] = touch_limit.described(limits)
    return found
