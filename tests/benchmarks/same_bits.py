"""Whether two installations compute the same bits from the same seeds: other Pythons, processors, builds of a library.

    python -m tests.benchmarks.same_bits

Prints a hash of everything that a study makes, for every task, in a few minutes; keep what two installations print,
and ``diff`` says what they make differently. Trainings are short and in one thread. docs/results/pythons.md says what
was found.
"""

import argparse
import hashlib
import io
import platform
import sys
import tempfile
from collections.abc import Iterable, Iterator
from dataclasses import fields
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import get_args

import numpy as np
import torch

from app.installed_tasks import catalogue
from worker.compute import simulation
from worker.domain.trajectory import Trajectory
from worker.experiments.benchmark_cell import BenchmarkConfig, BenchmarkUser, Cell
from worker.experiments.rollout_cache import RolloutCache
from worker.ml.filters.exported.filter_act import act_of
from worker.ml.filters.fitting import pbarl
from worker.ml.filters.fitting.filter_problem import FilterConfig
from worker.ml.methods import registry
from worker.ml.methods.prefft import FineTuning
from worker.ml.methods.registry import MethodConfig
from worker.ml.reinforcement.preference_rl import PolicyAct
from worker.ml.reinforcement.refinement import Beginning, Refinement, refine
from worker.ml.rewards import reward_training
from worker.ml.teachers import TASTES, User
from worker.sim.rollout import rollout

LIBRARIES = ("numpy", "scipy", "onnxruntime", "pybullet", "av", "pillow")
SEED = 0
SCENARIOS = range(5)
OBSERVATIONS = 1000
FILMED_STEPS = 15
FILTER = FilterConfig(
    mode_attempts=1,
    gates=(1.0,),
    gate_scenarios=4,
    residual_rounds=1,
    residual_rollouts=4,
    value_steps=50,
    adapter_steps=20,
)
FINE_TUNING = FineTuning(steps=800, warm_up_steps=200, critic_first_updates=20, cloning_steps=50)
REFINEMENT = Refinement(
    steps=400, warm_up_steps=200, imitation_steps=50, critic_first_updates=20, critic_again_updates=10
)
METHODS = MethodConfig(fine_tuning=FINE_TUNING, refinement=REFINEMENT)
TERMS = BenchmarkConfig(labels=20, smallest_pool=4, filter=FILTER, methods=METHODS)


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", choices=catalogue.names(), default=catalogue.names())
    tasks = parser.parse_args().tasks
    torch.set_num_threads(1)
    used = ", ".join(f"{name} {version(name)}" for name in LIBRARIES)
    sys.stdout.write(f"Python {platform.python_version()}, torch {torch.__version__}, {used}\n")
    for task in tasks:
        with tempfile.TemporaryDirectory() as work:
            for what, parts in made(task, Path(work)):
                sys.stdout.write(f"{task}, {what}: {hash_of(parts)}\n")
                sys.stdout.flush()


def made(task: str, work: Path) -> Iterator[tuple[str, Iterable[bytes]]]:
    """What is compared, and its bytes."""
    env, policy = simulation.environment(task), simulation.reference_policy(task)
    rng = np.random.default_rng(SEED)
    yield (
        "physics under drawn actions",
        (
            part
            for scenario in SCENARIOS
            for part in arrays_of(rollout(env, lambda _: rng.uniform(-1, 1, 7).astype(np.float32), scenario))
        ),
    )
    seen = (policy.offset + rng.standard_normal((OBSERVATIONS, len(policy.offset)))).astype(np.float32)
    frozen = [policy, *(simulation.reference_policy(task, early) for early in simulation.early_policies(task))]
    yield "actions of the frozen policies", (each.mean(seen).tobytes() for each in frozen)

    bench = BenchmarkUser(
        Cell(task, TASTES[User.CAUTIOUS], "pbarl", SEED), TERMS, RolloutCache(task, work / "rollouts"), work
    )
    yield "behaviours of a pool", (part for each in bench.pool for part in arrays_of(each))
    yield "stored trajectories", (stored(each) for each in bench.pool)
    filmed, renderer = bench.pool[0], simulation.renderer("sharp")
    yield "pictures", (picture.tobytes() for picture in renderer.pictures(filmed, 0, FILMED_STEPS))
    clip = renderer.render_clip(filmed, 0, FILMED_STEPS)
    yield "clip", [clip.video]
    yield "poster", [clip.poster]

    yield "answers of a scripted person", [bench.labelled.signals.tobytes(), bench.targets.tobytes()]
    for kind in get_args(reward_training.RewardKind):
        yield f"reward model, {kind}", [bench._fit(kind).to_bytes()]
    yield from learned(bench)


def learned(bench: BenchmarkUser) -> Iterator[tuple[str, Iterable[bytes]]]:
    """What is learned with rollouts."""
    setting = bench.setting()
    gate = setting.reference(FILTER.gate_block(bench.task))
    home = partial(setting.reference, FILTER.home_block(bench.task))
    draft = pbarl.fit_studio(setting.problem, setting.surface(), setting.pool, gate, home, setting.collect)
    draft = draft.shielded(bench.task.observation, home)
    yield "filter", [draft.weights.to_bytes()]
    yield "filter.onnx", [act_of(bench.task.modes, setting.problem.policy, draft.weights).exported.stored]
    beginning = Beginning(setting.make_env, setting.pool.rollouts, gate, gate, setting.collect)
    for refined in refine(setting.problem, draft, beginning, REFINEMENT):
        yield "refined filter", [refined.weights.to_bytes()]
    tuned = registry.fit("prefft", setting).act
    assert isinstance(tuned, PolicyAct)
    yield "fine-tuned policy", (array.tobytes() for _, array in sorted(tuned.policy.weights.items()))


def arrays_of(trajectory: Trajectory) -> Iterator[bytes]:
    """Everything in it that was computed."""
    for field in fields(trajectory):
        value = getattr(trajectory, field.name)
        yield value.tobytes() if isinstance(value, np.ndarray) else repr(value).encode()


def stored(trajectory: Trajectory) -> bytes:
    """Its file."""
    target = io.BytesIO()
    trajectory.save(target)
    return target.getvalue()


def hash_of(parts: Iterable[bytes]) -> str:
    """Sixteen digits."""
    digest = hashlib.sha256()
    for part in parts:
        digest.update(part)
    return digest.hexdigest()[:16]


if __name__ == "__main__":
    main()
