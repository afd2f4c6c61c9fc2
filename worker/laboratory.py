"""Where simulation meets learning: what the compute processes do, with no database in sight.

Every function takes and returns plain arrays and bytes, so that it can run in another process, in a command, or in a
notebook. Environments and renderers are kept from call to call: building them costs more than using them. Nothing here
loads torch, so that the processes that film start quickly and stay small.
"""

import io
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from worker.ml.policies import GaussianPolicy
from worker.modes import FEEDING_AXES, perceived, sample_modes, speed_factor
from worker.sim.feeding import FeedingEnv
from worker.sim.render import ClipRenderer, RenderedClip
from worker.sim.rollout import rollout
from worker.trajectory import Array, Trajectory

CHECKPOINTS = Path(__file__).resolve().parent / "checkpoints" / "feeding"

REFERENCE_SCENARIOS = 2_000_000_000
"""First of the scenarios over which reward models are normalised."""
REFERENCE_COUNT = 40

_DIFFERENT_ENOUGH = 0.45
"""Two behaviours of one scenario differ by at least this share of some axis' range, so that a person can see it."""


@dataclass(frozen=True)
class RecordedClip:
    """One rollout of the pool and its video."""

    trajectory: bytes
    success: bool
    clip: RenderedClip


def warm_up() -> None:
    """Import and build what making clips needs, so that the first clip comes quickly."""
    environment()
    renderer()


@cache
def environment() -> FeedingEnv:
    """This process' environment."""
    return FeedingEnv()


@cache
def renderer() -> ClipRenderer:
    """This process' renderer."""
    return ClipRenderer()


@cache
def reference_policy() -> GaussianPolicy:
    """The frozen policy that ships with the studio."""
    return GaussianPolicy.load(CHECKPOINTS / "policy.safetensors")


def behaviours(scenario: int, count: int) -> npt.NDArray[np.float64]:
    """The modes in which a pool executes a scenario, (count, A): random, but no two of them alike."""
    rng = np.random.default_rng([scenario, 1])
    width = np.array([axis.high - axis.low for axis in FEEDING_AXES])
    chosen: list[npt.NDArray[np.float64]] = []
    while len(chosen) < count:
        mode = sample_modes(1, rng)[0]
        if all((np.abs(mode - other) / width).max() >= _DIFFERENT_ENOUGH for other in chosen):
            chosen.append(mode)
    return np.array(chosen)


def act_in_mode(mode: npt.NDArray[np.float64]) -> Any:
    """The frozen policy executed in a mode: observation (D,) -> action (7,)."""
    policy, values = reference_policy(), mode.astype(np.float32)

    def act(observation: Array) -> Array:
        action: Array = speed_factor(observation, values) * policy.mean(perceived(observation, values))
        return action

    return act


def record_clip(scenario: int, mode: Sequence[float], first_step: int, step_count: int) -> RecordedClip:
    """Run the scenario in a mode and render the stretch of it that participants will see."""
    trajectory = rollout(environment(), act_in_mode(np.array(mode)), scenario, reference_policy().mean)
    target = io.BytesIO()
    trajectory.save(target)
    return RecordedClip(
        target.getvalue(), trajectory.success, renderer().render_clip(trajectory, first_step, step_count)
    )


@lru_cache(maxsize=4)
def reference_rollouts(first: int = REFERENCE_SCENARIOS, count: int = REFERENCE_COUNT) -> tuple[Trajectory, ...]:
    """Rollouts of the frozen policy's mean action in consecutive scenarios."""
    policy = reference_policy()
    return tuple(rollout(environment(), policy.mean, scenario) for scenario in range(first, first + count))
