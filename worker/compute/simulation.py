"""Where simulation meets learning: what the compute processes do, with no database in sight.

Every function takes and returns plain arrays and bytes, so that it can run in another process, in a command, or in a
notebook. Environments and renderers are kept from call to call: building them costs more than using them. Nothing here
loads torch, so that the processes that film start quickly and stay small. Tasks go by their names.
"""

import io
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache, lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from app.installed_tasks import catalogue
from app.installed_tasks.lab import SURFACE_FILE
from worker.compute import lab_clips
from worker.compute.behaviours import Behaviour, SlowWaves, draw_behaviours
from worker.domain.scenarios import NORMALISATION
from worker.domain.task import Task
from worker.domain.trajectory import Trajectory
from worker.domain.type_aliases import Act, Float32Array
from worker.ml.policies.gaussian import GaussianPolicy
from worker.ml.policies.reference import ReferencePolicy
from worker.ml.rewards.signal_predictor import SignalPredictor
from worker.sim.assistive import AssistiveEnv
from worker.sim.lab.environment import LabEnvironment
from worker.sim.render.clip import STYLES, ClipRenderer, RenderedClip
from worker.sim.render.scene import Scene
from worker.sim.rollout import rollout
from worker.tasks import registry
from worker.tasks.registry import checkpoint, environment_class, filmed_task, task
from worker.whole_files import whole_files

if TYPE_CHECKING:
    from worker.ml.filters.fitting.response_surface import ResponseSurface

REFERENCE_COUNT = 40


class NoPolicy(ValueError):
    """Nothing was trained that does the task."""


class NoPredictor(ValueError):
    """Nothing was trained that foresees the task's signals."""


@dataclass(frozen=True)
class RecordedClip:
    """One rollout of the pool and its video."""

    trajectory: bytes
    success: bool
    clip: RenderedClip


def warm_up() -> None:
    """Import and build what making clips needs, so that the first clip comes quickly."""
    environment(catalogue.usual())
    renderer("sharp")


@cache
def environment(name: str) -> AssistiveEnv:
    """This process' environment of a task. Raises UnknownTask and TaskBroken."""
    return environment_class(name)()


@cache
def lab_environment(name: str) -> LabEnvironment:
    """This process' environment of a laboratory's task. Raises UnknownTask and LabTaskBroken."""
    return registry.lab_environment(name)


def run_episode(name: str, act: Act, scenario: int) -> Trajectory:
    """One whole episode of any task, with what the frozen policy would have done in every state."""
    reference = reference_policy(name).mean
    if registry.lab(name) is not None:
        return lab_environment(name).episode(act, scenario, reference)
    return rollout(environment(name), act, scenario, reference)


@cache
def renderer(quality: str) -> ClipRenderer:
    """This process' renderer of clips in a quality."""
    return ClipRenderer(filmed_task, STYLES[quality], _scene())


@cache
def _scene() -> Scene:
    """Meshes and drawing clients, which take most of a renderer's memory: one set for every quality."""
    return Scene()


def surface_file(name: str) -> Path:
    """Where a task's response surface is kept; its record lies beside it."""
    return checkpoint(name) / SURFACE_FILE


def predictor_file(name: str) -> Path:
    """Where a task's predictor of signals is kept; its record lies beside it."""
    return checkpoint(name) / "signal_predictor.safetensors"


def archive_folder(name: str) -> Path:
    """Where the policies are kept that were refined for a task beforehand, and their record."""
    return checkpoint(name) / "refined"


@cache
def archived_policies(name: str) -> Mapping[str, GaussianPolicy]:
    """By their names; none: the task has no archive of them."""
    return {file.stem: GaussianPolicy.load(file) for file in whole_files(archive_folder(name), "*.safetensors")}


def archived_modes_file(name: str) -> Path:
    """Where the modes are kept in which they were tried for everybody."""
    return archive_folder(name) / "in_modes.json"


def surface_around_file(name: str, policy: str) -> Path:
    """Where the response surface of modes around one of them is kept."""
    return archive_folder(name) / "around" / f"{policy}.safetensors"


def surface_around(name: str, policy: str) -> "ResponseSurface | None":
    """What modes change around an archived policy, beside that policy itself; None: they were not explored."""
    # processes that fit nothing do without scipy
    from worker.ml.filters.fitting.response_surface import ResponseSurface

    file, described = surface_around_file(name, policy), task(name)
    return ResponseSurface.load(file, described.modes, described.signals) if file.exists() else None


@cache
def signal_predictor(name: str) -> SignalPredictor:
    """What foresees a task's signals from state and action. Raises NoPredictor for a task that has none."""
    if not predictor_file(name).exists():
        raise NoPredictor(f"The signals of {name} cannot be foreseen yet: run python -m worker foresee --task {name}.")
    return SignalPredictor.load(predictor_file(name))


@cache
def reference_policy(name: str, early: str = "") -> ReferencePolicy:
    """The frozen policy that lies in a task's folder, or one from an early stage of its training, or another of those
    among which a laboratory chooses, by name. Raises NoPolicy, and NotAPolicy for a laboratory's."""
    if registry.lab(name) is not None:
        return _lab_policy(name, early)
    file = checkpoint(name) / (f"early/{early}.safetensors" if early else "policy.safetensors")
    if not file.exists():
        raise NoPolicy(f"The task {name} has no policy {file}: run python -m worker pretrain --task {name}.")
    return GaussianPolicy.load(file)


def policy_in(name: str, mode: Mapping[str, float]) -> ReferencePolicy:
    """The policy that a mode, by the names of its axes, is executed by: the frozen one but where one is chosen."""
    family = task(name).modes
    return reference_policy(name, family.policy(family.vector(mode)))


def _lab_policy(name: str, other: str) -> ReferencePolicy:
    from worker.compute import lab_policies  # torch, which processes that film our tasks do without

    described = registry.lab(name)
    assert described is not None  # noqa: S101 -- callers do this for laboratories' tasks only
    return lab_policies.policy_of(described, registry.installed_task(name).folder, registry.found_out(name), other)


def early_policies(name: str) -> list[str]:
    """Names of the early policies that ship with a task."""
    return [path.stem for path in whole_files(checkpoint(name) / "early", "*.safetensors")]


def behaviours(name: str, scenario: int, count: int) -> list[Behaviour]:
    """The ways in which a pool executes a scenario of a task."""
    sampled = isinstance(reference_policy(name), GaussianPolicy)
    return draw_behaviours(task(name), scenario, count, early_policies(name), sampled)


def act_in_mode(name: str, mode: npt.ArrayLike, refined: str = "") -> Act:
    """The frozen policy executed in a mode (A,), or one that was ``refined`` beforehand."""
    policy = archived_policies(name)[refined] if refined else reference_policy(name, task(name).modes.policy(mode))
    return _in_mode(task(name), policy.mean, np.asarray(mode, np.float32))


def act_as(name: str, behaviour: Behaviour) -> Act:
    """The behaviour as a policy for one episode."""
    policy = reference_policy(name, behaviour.checkpoint) if behaviour.checkpoint else policy_in(name, behaviour.mode)
    rng = np.random.default_rng(behaviour.seed)
    base: Act = policy.mean
    if behaviour.temperature and isinstance(policy, GaussianPolicy):

        def base(observation: Float32Array) -> Float32Array:
            return policy.sample(observation, rng, behaviour.temperature)

    family = task(name).modes
    moved = _in_mode(task(name), base, np.array(family.vector(behaviour.mode), np.float32))
    if not behaviour.disturbance:
        return moved
    waves = SlowWaves(behaviour.disturbance, rng, policy.action_size)
    return lambda observation: moved(observation) + waves()


def _in_mode(of: Task, base: Act, mode: Float32Array) -> Act:
    def act(observation: Float32Array) -> Float32Array:
        action: Float32Array = of.modes.executed(observation, mode, base(of.modes.perceived(observation, mode)))
        return action

    return act


def record_clip(
    name: str, quality: str, scenario: int, behaviour: Behaviour, first_step: int, step_count: int
) -> RecordedClip:
    """Run the scenario in some behaviour and render the stretch of it that participants will see."""
    return _recorded(name, quality, act_as(name, behaviour), scenario, first_step, step_count)


def film(name: str, quality: str, controller: bytes, scenario: int) -> RecordedClip:
    """Run a whole episode as a controller (see worker.ml.export.blinded_controller) acts, and render all of it."""
    from worker.ml.export import blinded_controller  # processes that never film controllers do without its runtime

    act = blinded_controller.act_of_stored(controller, partial(reference_policy, name))
    return _recorded(name, quality, act, scenario, 0, task(name).episode_steps)


def _recorded(name: str, quality: str, act: Act, scenario: int, first_step: int, step_count: int) -> RecordedClip:
    if registry.lab(name) is not None:
        reference = reference_policy(name).mean
        trajectory, clip = lab_clips.film(lab_environment(name), act, scenario, reference, first_step, step_count)
    else:
        trajectory = run_episode(name, act, scenario)
        clip = renderer(quality).render_clip(trajectory, first_step, step_count)
    target = io.BytesIO()
    trajectory.save(target)
    return RecordedClip(target.getvalue(), trajectory.success, clip)


def film_again(quality: str, trajectory: bytes, first_step: int, step_count: int) -> RenderedClip:
    """Another stretch of a rollout that was recorded before."""
    recorded = Trajectory.load(io.BytesIO(trajectory))
    if registry.lab(recorded.task) is not None:
        return lab_clips.film_again(lab_environment(recorded.task), recorded, first_step, step_count)
    return renderer(quality).render_clip(recorded, first_step, step_count)


@lru_cache(maxsize=4)
def reference_rollouts(
    name: str, first: int = NORMALISATION.start, count: int = REFERENCE_COUNT
) -> tuple[Trajectory, ...]:
    """Rollouts of the frozen policy's mean action in consecutive scenarios."""
    policy = reference_policy(name)
    return tuple(run_episode(name, policy.mean, scenario) for scenario in range(first, first + count))
