"""Where simulation meets learning: what the compute processes do, with no database in sight.

Every function takes and returns plain arrays and bytes, so that it can run in another process, in a command, or in a
notebook. Environments and renderers are kept from call to call: building them costs more than using them.
"""

import io
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from tqdm import tqdm

from worker.ml import reward_training, sac
from worker.ml.policies import GaussianPolicy
from worker.ml.reward_models import RewardModel, load_reward_model
from worker.ml.segments import SegmentPairs
from worker.ml.studio_filter import Act, noisy
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


def run_scenarios(act: Act, scenarios: Sequence[int], noise: float, seed: int) -> list[Trajectory]:
    """One rollout per scenario, with Gaussian noise of this deviation on every action."""
    return [
        rollout(environment(), noisy(act, noise, seed, scenario), scenario, reference_policy().mean)
        for scenario in scenarios
    ]


def fit_reward(
    kind: str, pairs: SegmentPairs, targets: Array, pool: SegmentPairs, seed: int
) -> tuple[bytes, dict[str, Any]]:
    """The stored reward model and its metrics. ``pool``: pairs like those that are asked, for the scale of signals."""
    spread = reward_training.signal_spread(pool)
    named: reward_training.Kind = "mlp" if kind == "mlp" else "structured"
    fitted = reward_training.fit(pairs, targets, named, seed, spread=spread, reference=reference_rollouts())
    return fitted.model.to_bytes(), fitted.metrics


def probability_right(stored_model: bytes, pairs: SegmentPairs) -> list[float]:
    """P(right preferred) of each pair, the mean over the ensemble."""
    return [float(value) for value in _model(stored_model).probability_right(pairs)]


def member_probabilities(stored_model: bytes, pairs: SegmentPairs) -> npt.NDArray[np.float64]:
    """P(right preferred) of each pair under every member, (E, N)."""
    return _model(stored_model).member_probabilities(pairs)


@lru_cache(maxsize=16)
def _model(stored: bytes) -> RewardModel:
    return load_reward_model(stored)


def pretrain(seed: int, directory: Path) -> int:
    """Train the reference policy for Feeding by SAC, or resume a training that was interrupted (about ten minutes)."""
    config = sac.SacConfig(seed=seed)
    with tqdm(total=config.total_steps, unit="step", smoothing=0.05) as bar:

        def progress(steps: int, figures: dict[str, Any]) -> None:
            bar.update(steps - bar.n)
            bar.set_postfix({name: f"{value:.3g}" for name, value in figures.items()})

        sac.pretrain(FeedingEnv, config, directory, progress, f"python -m worker pretrain --seed {seed}")
    return 0
