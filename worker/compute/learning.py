"""What the learning processes do: fit reward models, ask them, and drive filters through scenarios.

What takes seconds to load is imported where it is used: the worker only names these functions, and needs none of it.
"""

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, cast, get_args

import numpy as np
import numpy.typing as npt

from worker.analysis.filters.promise import Outcome, outcome_of
from worker.compute.population import prior_of
from worker.compute.simulation import reference_rollouts, run_episode, signal_predictor
from worker.domain.trajectory import Trajectory
from worker.domain.type_aliases import Act, Float32Array, FloatArray
from worker.ml.rewards.loading import load_reward_model
from worker.ml.rewards.reward_models import NEVER_WANTED, RewardModel
from worker.ml.rewards.segments import SegmentPairs
from worker.ml.rewards.signal_scale import SignalScale
from worker.tasks import registry


def warm_up(task: str) -> None:
    """Make the rollouts that a task's reward models are normalised over: the first retraining is then a quick one."""
    reference_rollouts(task)


def run_scenarios(task: str, act: Act, scenarios: Sequence[int], noise: float, seed: int) -> list[Trajectory]:
    """One rollout per scenario, with Gaussian noise of this deviation on every action."""
    return [run_episode(task, noisy(act, noise, seed, scenario), scenario) for scenario in scenarios]


def noisy(act: Act, noise: float, seed: int, scenario: int) -> Act:
    """The same with Gaussian noise, drawn independently for every scenario."""
    if noise == 0.0:
        return act
    rng = np.random.default_rng([seed, scenario])

    def act_with_noise(observation: Float32Array) -> Float32Array:
        action = act(observation)
        return action + noise * rng.standard_normal(action.shape, np.float32)

    return act_with_noise


def outcomes(task: str, act: Act, scenarios: Sequence[int]) -> list[Outcome]:
    """What could harm in one rollout per scenario."""
    driven = (run_episode(task, act, scenario) for scenario in scenarios)
    return [outcome_of(each, registry.task(task)) for each in driven]


def fit_reward(
    task: str,
    kind: str,
    pairs: SegmentPairs,
    targets: Float32Array,
    scale: SignalScale,
    seed: int,
    earlier: Sequence[bytes] = (),
    recorded_signals: Sequence[str] | None = None,
    mattered: npt.NDArray[np.bool_] | None = None,
    hints: FloatArray | None = None,
) -> tuple[bytes, dict[str, Any]]:
    """The stored reward model and its metrics.

    ``scale``: what the signals are like in the study's pool; ``earlier``: models of others for
    a pooled prior; ``recorded_signals``: what the signals are called when the clips were recorded elsewhere. Then there
    is no reference policy to normalise over, and what the person was shown takes its place.
    ``mattered``: (N, S) the signals that made the difference, as far as the person said so.
    ``hints``: (H, S) which way the person wishes the signals, as in reward_training.fit().
    Raises ValueError for a kind there is not, and simulation.NoPredictor where the task's signals cannot be foreseen.
    """
    from worker.ml.rewards import reward_training
    from worker.ml.rewards.beyond_sums import choice, misfit

    if kind not in get_args(reward_training.RewardKind):
        raise ValueError(f"There is no reward model of the kind {kind!r}.")
    simulated = None if recorded_signals is not None else registry.task(task)
    names = recorded_signals or () if simulated is None else simulated.signals
    prior = prior_of(task if recorded_signals is None else None, scale.spread, [_model(each) for each in earlier])
    known: dict[str, Any] = {
        "scale": scale,
        "reference": reference_rollouts(task) if recorded_signals is None else (),
        "prior": prior,
        "signal_names": names,
        "costs": NEVER_WANTED if simulated is None else (*NEVER_WANTED, *simulated.costs),
        "mattered": mattered,
        "hints": hints,
    }
    scene = [] if simulated is None else misfit.scene_of(simulated.observation)
    if kind == "structured":
        fitted = choice.fit_by_evidence(pairs, targets, seed, scene=scene, **known)
    else:
        predictor = signal_predictor(task) if kind == "predicted" else None
        fitted = reward_training.fit(
            pairs, targets, cast(reward_training.RewardKind, kind), seed, predictor=predictor, **known
        )
    metrics = {**fitted.metrics, "pooled_from": len(earlier)}
    if kind == "predicted":
        metrics["misfit"] = misfit.look(pairs, np.asarray(targets, np.float64), scale, names, scene)
    return fitted.model.to_bytes(), metrics


def probability_right(stored_model: bytes, pairs: SegmentPairs) -> list[float]:
    """P(right preferred) of each pair, the mean over the ensemble."""
    return [float(value) for value in _model(stored_model).probability_right(pairs)]


def member_probabilities(stored_model: bytes, pairs: SegmentPairs) -> npt.NDArray[np.float64]:
    """P(right preferred) of each pair under every member, (E, N)."""
    return _model(stored_model).member_probabilities(pairs)


@lru_cache(maxsize=16)
def _model(stored: bytes) -> RewardModel:
    return load_reward_model(stored)
