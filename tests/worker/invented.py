"""Invented trajectories and policies for tests of the learning code: the right shapes, no physics."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from app.domain import run_keys
from worker.domain.trajectory import COSTS, SIGNALS, Trajectory
from worker.jobs.runtime.records import Job
from worker.ml import dense_network
from worker.ml.policies.gaussian import GaussianPolicy
from worker.ml.rewards.segments import SegmentPairs
from worker.ml.rewards.signal_predictor import SignalPredictor
from worker.tasks.feeding.environment import FEEDING

TASK = FEEDING
D, A, S = TASK.observation.size, 7, len(SIGNALS)


def small_policy(seed: int = 0, hidden: int = 16) -> GaussianPolicy:
    """A reference policy with random weights."""
    rng = np.random.default_rng(seed)
    sizes = [D, hidden, hidden, 2 * A]
    weights = {"offset": np.zeros(D), "scale": np.full(D, 2.0), "action_limit": np.array([0.7])}
    for index in range(3):
        weights[f"weight_{index}"] = rng.standard_normal((sizes[index], sizes[index + 1])) / sizes[index] ** 0.5
        weights[f"bias_{index}"] = 0.1 * rng.standard_normal(sizes[index + 1])
    return GaussianPolicy({name: array.astype(np.float32) for name, array in weights.items()})


def observations(count: int, rng: np.random.Generator) -> npt.NDArray[np.float32]:
    """(count, D) with unit vectors where unit vectors belong, and the spoon almost level."""
    seen = rng.uniform(-0.3, 0.3, (count, D))
    for name in ("tool_forward", "tool_up", "target_outward"):
        place = TASK.observation.slice_of(name)
        vector = rng.standard_normal((count, 3)) + ((0.0, 0.0, 12.0) if name == "tool_up" else (0.0, 0.0, 0.0))
        seen[:, place] = vector / np.linalg.norm(vector, axis=1, keepdims=True)
    return seen.astype(np.float32)


def trajectory(
    rng: np.random.Generator,
    *,
    steps: int = 20,
    scenario: int = 0,
    success: bool = True,
    signals: npt.NDArray[np.floating] | None = None,
    actions: npt.NDArray[np.floating] | None = None,
    costs: npt.NDArray[np.floating] | None = None,
) -> Trajectory:
    """One episode of noise, with the given arrays where they matter; the speed is the first joint's action."""
    drawn = rng.uniform(-1, 1, (steps, A)) + rng.uniform(-0.5, 0.5, A) if actions is None else actions
    measured = rng.standard_normal((steps, S))
    measured[:, SIGNALS.index("speed_m_s")] = np.asarray(drawn)[:, 0]
    return Trajectory(
        observations=observations(steps + 1, rng),
        actions=np.asarray(drawn, np.float32),
        reference_actions=np.asarray(drawn, np.float32),
        signals=np.asarray(measured if signals is None else signals, np.float32),
        costs=np.asarray(rng.random((steps, len(COSTS))) if costs is None else costs, np.float32),
        task_rewards=np.zeros(steps, np.float32),
        joint_positions=np.zeros((steps + 1, 7), np.float32),
        particles=np.zeros((steps + 1, 8, 3), np.float32),
        head_quaternions=np.tile(np.array([0, 0, 0, 1], np.float32), (steps + 1, 1)),
        arm_positions_rad=np.zeros((steps + 1, 2, 4), np.float32),
        target_m=np.zeros((steps + 1, 3), np.float32),
        contact_force_n=np.zeros(steps, np.float32),
        success=success,
        scenario=scenario,
        task="feeding",
        body="broad",
        skin_tone=0,
    )


def predictor(seed: int = 0, hidden: int = 8) -> SignalPredictor:
    """What foresees some signals or other: random weights."""
    rng = np.random.default_rng(seed)
    sizes = [D + A, hidden, S]
    drawn = [
        array.astype(np.float32)
        for fan_in, fan_out in pairwise(sizes)
        for array in (rng.standard_normal((fan_in, fan_out)) / fan_in**0.5, rng.standard_normal((1, fan_out)))
    ]
    zeros, ones = np.zeros(D + A, np.float32), np.ones(D + A, np.float32)
    return SignalPredictor(
        dense_network.of_parameters(drawn), zeros, ones, zeros[:S], ones[:S], np.full(S, 9.0, np.float32)
    )


def pairs(count: int, rng: np.random.Generator, steps: int = 20) -> SegmentPairs:
    """Pairs of episodes of noise."""
    return SegmentPairs.cut([(trajectory(rng, steps=steps), trajectory(rng, steps=steps)) for _ in range(count)])


def answers_of(values: SegmentPairs, weights: Sequence[float] | npt.NDArray[np.floating]) -> npt.NDArray[np.float64]:
    """Targets of somebody whose reward is linear in the signals and who never errs."""
    likes_right: npt.NDArray[np.bool_] = values.signal_differences() @ np.asarray(weights) > 0
    return likes_right.astype(np.float64)


def job_of(key: str, study_id: int) -> Job:
    """The job of a stored key."""
    about = run_keys.read(key)
    assert about is not None, key
    return Job(about, study_id)
