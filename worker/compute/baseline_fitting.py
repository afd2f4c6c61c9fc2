"""What the compute processes do for a blinded evaluation: fit a method that is only evaluated, and write controllers.

Every function takes and returns plain arrays and bytes. A trained method is kept as its controller: one ONNX model from
observations to actions, so what is evaluated, filmed and run on a robot is one and the same file.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch

from worker.compute import learning, simulation
from worker.domain.trajectory import Trajectory
from worker.domain.type_aliases import Act
from worker.ml.export import blinded_controller as controller
from worker.ml.export.blinded_controller import Blinded
from worker.ml.filters.exported import filter_act
from worker.ml.filters.exported.filter_module import FilterWeights
from worker.ml.filters.fitting.filter_problem import FilterProblem
from worker.ml.filters.fitting.pool import Pool
from worker.ml.filters.fitting.response_surface import ResponseSurface
from worker.ml.methods import registry
from worker.ml.methods.prefft import FineTuning
from worker.ml.methods.registry import MethodConfig, Setting
from worker.ml.policies.checkpoint import Checkpoint, Paused, begin_again
from worker.ml.reinforcement.preference_rl import PolicyAct
from worker.ml.rewards.action_ranking import can_rank
from worker.ml.rewards.loading import load_reward_model
from worker.ml.rewards.reward_models import RewardModel
from worker.tasks import registry as tasks

COMPARED_EPISODES = 2
"""Episodes of the reference policy in whose observations a controller is compared with the method it was made of."""


@dataclass(frozen=True)
class Baseline:
    """A method to be fitted for one participant."""

    task: str
    method: str
    reward: bytes
    action_reward: bytes
    """a reward model of the same labels on states and actions; empty where the method does not need one"""
    labels: int
    seed: int
    fine_tuning_steps: int


@dataclass(frozen=True)
class FittedRival:
    """A fitted method, or as much of it as was done before a pause."""

    controller: bytes | None
    """None: it paused at a checkpoint"""
    notes: tuple[str, ...]
    seconds: float


def fit(baseline: Baseline, folder: Path) -> FittedRival:
    """Fit it on one core, keeping checkpoints in the folder, until it is done or asked to pause.

    Raises Abandoned when the folder is removed.
    """
    torch.set_num_threads(1)
    started = time.perf_counter()
    begin_again(folder)
    try:
        fitted = registry.fit(baseline.method, _setting(baseline, Checkpoint(folder)))
    except Paused:
        return FittedRival(None, (), round(time.perf_counter() - started, 1))
    stored = controller.of_act(fitted.act, observations(baseline.task))
    return FittedRival(stored, fitted.notes, round(time.perf_counter() - started, 1))


def controller_of_reference(task: str) -> bytes:
    """The frozen policy as a controller."""
    return controller.of_act(PolicyAct(simulation.reference_policy(task)), observations(task))


def controller_of_filter(task: str, weights: bytes) -> bytes:
    """The frozen policy with somebody's filter behind it as a controller."""
    personal = FilterWeights.from_bytes(weights)
    act = filter_act.act_of(tasks.task(task).modes, simulation.policy_in(task, personal.mode), personal)
    return controller.of_act(act, observations(task))


def packed(task: str, study: str, participant: str, letter: str, model: bytes) -> bytes:
    """A controller as its operator gets it, by letter."""
    return controller.write(Blinded(tasks.task(task), study, participant, letter, model, observations(task)))


def drive(task: str, model: bytes, scenarios: Sequence[int]) -> list[Trajectory]:
    """One rollout per scenario."""
    act = controller.act_of_stored(model, partial(simulation.reference_policy, task))
    return learning.run_scenarios(task, act, scenarios, 0.0, 0)


def observations(task: str) -> npt.NDArray[np.float32]:
    """What the reference policy sees in some episodes, (N, D): the same for everybody and every method."""
    episodes = simulation.reference_rollouts(task, count=COMPARED_EPISODES)
    return np.concatenate([each.observations[:-1] for each in episodes]).astype(np.float32)


def _setting(baseline: Baseline, checkpoint: Checkpoint) -> Setting:
    task = tasks.task(baseline.task)
    policy = simulation.reference_policy(baseline.task)
    return Setting(
        problem=FilterProblem(task, policy, load_reward_model(baseline.reward), baseline.seed),
        labels=baseline.labels,
        pool=Pool(),
        surface=_no_surface,
        action_reward=lambda: _action_reward(baseline),
        reference=lambda scenarios: _collect(baseline.task, policy.mean, scenarios, 0.0, 0),
        collect=lambda act, scenarios, noise, seed: _collect(baseline.task, act, scenarios, noise, seed),
        make_env=tasks.environment_class(baseline.task),
        config=MethodConfig(fine_tuning=FineTuning(steps=baseline.fine_tuning_steps)),
        checkpoint=checkpoint,
    )


def _collect(task: str, act: Act, scenarios: Sequence[int], noise: float, seed: int) -> list[Trajectory]:
    return learning.run_scenarios(task, act, scenarios, noise, seed)


def _action_reward(baseline: Baseline) -> RewardModel:
    model = load_reward_model(baseline.action_reward)
    if not can_rank(model):
        raise TypeError(f"{baseline.method} needs a reward model on states and actions, not {type(model).__name__}.")
    return model


def _no_surface() -> ResponseSurface:
    """Only the participant's own filter asks for the surface, and that is never a baseline here."""
    raise NotImplementedError("The participant's own filter is trained by worker.jobs.learning.filters.")
