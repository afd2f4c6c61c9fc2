"""Execution modes: a small space of ways to do the task, applied on top of the frozen policy.

A mode is a point in five interpretable axes. It changes how fast the arm goes far from and near the person, by which
path it comes, and how deep it presses, without changing the policy's weights. The same function serves the simulator
(NumPy, one state) and the exported filter (torch, a batch), so that what is trained is what is shipped.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from worker.spaces import FEEDING_OBSERVATION


@dataclass(frozen=True)
class Axis:
    """One way in which executions differ; 0 is the reference policy's own way."""

    name: str
    low: float
    high: float
    meaning: str


FEEDING_AXES = (
    Axis("speed_far", -0.8, 0.4, "log of the speed factor while the spoon is far from the mouth"),
    Axis("speed_near", -0.8, 0.5, "log of the speed factor close to the mouth"),
    Axis("from_below", -1.0, 1.0, "how far below (+) or above (-) the mouth the approach passes"),
    Axis("to_side", -0.7, 0.8, "how far to the person's left (+) or right (-) the approach swings"),
    Axis("press", -1.0, 1.0, "how deep the spoon goes into the mouth: gentle (-) or pressing (+)"),
)

_TO_MOUTH = FEEDING_OBSERVATION.slice_of("spoon_to_mouth_m")
_NECK_TO_MOUTH = FEEDING_OBSERVATION.slice_of("neck_to_mouth_m")
_FACE = FEEDING_OBSERVATION.slice_of("face_direction")
_UP = FEEDING_OBSERVATION.slice_of("spoon_up")

_DETOUR_M = 0.14
_PRESS_M = 0.07
_LEVEL_RAD = 0.65
_LEVEL_FADE_RAD = 0.15


def sample_modes(count: int, rng: np.random.Generator) -> npt.NDArray[np.float64]:
    """Random modes, (count, 5): uniform in each axis' range, each axis left at 0 with probability 1/4."""
    low = np.array([axis.low for axis in FEEDING_AXES])
    high = np.array([axis.high for axis in FEEDING_AXES])
    modes = rng.uniform(low, high, (count, len(FEEDING_AXES)))
    kept: npt.NDArray[np.float64] = modes * (rng.random(modes.shape) < 0.75)
    return kept


def perceived(observation: Any, mode: Any, xp: Any = np) -> Any:
    """The observation as the policy should see it: the mouth moved to where this mode wants the spoon to go.

    observation (..., D), mode (..., 5) -> (..., D). ``xp`` is numpy or torch.
    """
    to_mouth = observation[..., _TO_MOUTH]
    face = observation[..., _FACE]
    distance = xp.sqrt((to_mouth * to_mouth).sum(-1))[..., None]
    away = xp.clip((distance - 0.05) / 0.15, 0.0, 1.0)
    at_mouth = xp.clip((0.09 - distance) / 0.05, 0.0, 1.0)
    up = xp.zeros_like(face) + xp.asarray([0.0, 0.0, 1.0], dtype=face.dtype)
    side = xp.stack([-face[..., 1], face[..., 0], xp.zeros_like(face[..., 0])], -1)
    shift = (
        -_DETOUR_M * away * mode[..., 2:3] * up
        + _DETOUR_M * away * mode[..., 3:4] * side
        - _PRESS_M * at_mouth * mode[..., 4:5] * face
    )
    parts = [
        observation[..., : _TO_MOUTH.start],
        to_mouth + shift,
        observation[..., _TO_MOUTH.stop : _NECK_TO_MOUTH.start],
        observation[..., _NECK_TO_MOUTH] + shift,
        observation[..., _NECK_TO_MOUTH.stop :],
    ]
    return xp.concatenate(parts, -1)


def speed_factor(observation: Any, mode: Any, xp: Any = np) -> Any:
    """The factor on the policy's mean action, (..., 1): far and near speeds blended by the distance to the mouth.

    Slowing down while the spoon is tilted would stretch a spill instead of preventing it, so factors below one fade
    out beyond 0.65 rad of tilt.
    """
    to_mouth = observation[..., _TO_MOUTH]
    distance = xp.sqrt((to_mouth * to_mouth).sum(-1))[..., None]
    far = xp.clip((distance - 0.12) / 0.12, 0.0, 1.0)
    factor = xp.exp(mode[..., 0:1] * far + mode[..., 1:2] * (1.0 - far))
    tilt = xp.arccos(xp.clip(observation[..., _UP][..., 2:3], -1.0, 1.0))
    level = xp.clip((_LEVEL_RAD - tilt) / _LEVEL_FADE_RAD, 0.0, 1.0)
    return xp.where(factor < 1.0, 1.0 + (factor - 1.0) * level, factor)
