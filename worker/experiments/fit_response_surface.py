"""Explores once, for everybody, what a task's execution modes change: ``python -m worker explore --task NAME``.

Every scenario is executed by the reference policy and in several modes; the differences are fitted by a response
surface, which ships with the studio. First the modes are drawn at random; then, for some rounds, they are the ones that
people drawn from a population would be given by the surface so far. What is best for somebody lies at the edges of the
space of modes, where random modes are rare and a regression promises most.

Finished blocks are kept, so an interrupted exploration goes on where it was.
"""

import hashlib
import json
import platform
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from tqdm import tqdm

from app.installed_tasks.lab import FOUND_FILE, LabDescription
from worker.compute import simulation
from worker.compute.pools import Compute, Lane
from worker.domain.scenarios import RESPONSE_SURFACE, RESPONSE_SURFACE_SOUGHT, first_of
from worker.domain.task import Task
from worker.domain.type_aliases import FloatArray
from worker.experiments import lab_ranges
from worker.ml.filters.fitting import response_surface
from worker.ml.filters.fitting.response_surface import ResponseSurface, best_mode
from worker.ml.rewards.reward_models import NEVER_WANTED
from worker.ml.teachers import random_taste
from worker.sim.costs import signal_weights
from worker.sim.lab.environment import LabEnvironment
from worker.tasks import registry
from worker.whole_files import written_whole

R = TypeVar("R")

SCENARIOS = 300
"""executed in random modes"""
SOUGHT_SCENARIOS = 60
"""executed, in every later round, in modes that somebody would want"""
MOST_SOUGHT = 1000
"""so many of every round's are set aside"""
ROUNDS = 3
PEOPLE = 960
"""whose modes are sought in a round, at most: a surface errs where nobody's are"""
MODES_PER_SCENARIO = 12
BLOCK = 10
FOLDS = 10
"""Of the scenarios, by which it is measured what a surface foresees in others than it was fitted in."""
LITTLE = 0.2
"""Below this share of what a signal differs by, what is best for whoever judges by it is a guess."""
FEW_SCENARIOS = 50
JITTER = 0.08
"""Standard deviation around a mode that somebody wants, as a share of every axis' range."""


class NoRound(ValueError):
    """So many scenarios make no round."""


@dataclass(frozen=True)
class Differences:
    """What modes changed, N rollouts each compared with the reference policy's in the same scenario."""

    modes: FloatArray
    """(N, A)"""
    signals: FloatArray
    """(N, S) of the episode's summed signals"""
    success: FloatArray
    """(N,) in {-1, 0, 1}"""
    reference_success: FloatArray
    """(scenarios,)"""
    force_growth_n: FloatArray
    """(N,) of the episode's largest force on the person"""

    def fit(self, task: Task) -> ResponseSurface:
        """A surface of all of them."""
        return response_surface.fit(task.modes, self.modes, self.signals, self.successes, task.signals)

    @property
    def successes(self) -> FloatArray:
        """(N,) in {0, 1}"""
        return self.reference_success.repeat(MODES_PER_SCENARIO) + self.success


@dataclass(frozen=True)
class Block:
    """BLOCK scenarios in a row, each executed in its own modes."""

    task: str
    first: int
    modes: FloatArray
    """(BLOCK, modes of each, A)"""
    file: Path
    refined: str = ""
    """name of the policy, refined beforehand, that is executed and compared with; empty: the frozen one is"""

    def is_there(self) -> bool:
        """Whether it was run, in these modes."""
        if not self.file.exists():
            return False
        with np.load(self.file, allow_pickle=False) as stored:
            asked = self.modes.reshape(-1, self.modes.shape[-1])
            return "force_growth_n" in stored and np.array_equal(stored["modes"], asked)


def explore(
    task: str, work_directory: Path, processes: int, scenarios: int = SCENARIOS, sought: int | None = None
) -> dict[str, Any]:
    """Run what is missing, fit the response surface, write it and its record; returns the record.

    ``sought``: scenarios of every later round; None: in the usual proportion.
    """
    sought = sought_scenarios(scenarios) if sought is None else sought
    for count, most in ((scenarios, len(RESPONSE_SURFACE)), (sought, MOST_SOUGHT)):
        if not 0 < count <= most or count % BLOCK:
            raise NoRound(f"A round has {BLOCK}, {2 * BLOCK}, ... {most} scenarios, and not {count}.")
    work_directory.mkdir(parents=True, exist_ok=True)
    if registry.lab(task) is not None:
        find_ranges(task)
        if registry.found_out(task).chooses:  # every policy is driven when one is chosen: nothing is to be foreseen
            return {"policies": list(registry.task(task).modes.names)}
        found = registry.checkpoint(task) / FOUND_FILE
        work_directory /= hashlib.sha256(found.read_bytes()).hexdigest()[:16]  # blocks of another policy are no part
        work_directory.mkdir(exist_ok=True)
    described = registry.task(task)
    blocks = [
        Block(task, first, random_modes(described, first), work_directory / f"differences-{first}.npz")
        for first in first_of(RESPONSE_SURFACE, scenarios)[::BLOCK]
    ]
    compute = Compute(processes)
    try:
        run_blocks(compute, blocks, "random modes")
        for number in range(ROUNDS):
            surface = joined(blocks).fit(described)
            wanted = sought_blocks(compute, described, surface, number, work_directory, sought)
            run_blocks(compute, wanted, f"modes that people want, round {number + 1}")
            blocks += wanted
    finally:
        compute.close()
    return _publish(described, scenarios, sought, joined(blocks))


def find_ranges(task: str, scenarios: int = lab_ranges.SCENARIOS) -> None:
    """The ways to do a laboratory's task, unless they are known already and still true."""
    installed, described = registry.installed_task(task), registry.lab(task)
    assert described is not None  # noqa: S101 -- callers do this for laboratories' tasks only
    environment = registry.lab_environment(task)
    try:
        if _is_known(task, described, environment):
            return
        with tqdm(total=100, bar_format="{desc}: {percentage:.0f} %, {elapsed}") as bar:

            def progress(what: str, share: float) -> None:
                bar.set_description(f"ranges of the ways to do it, {what}")
                bar.update(100 * share - bar.n)

            found = lab_ranges.find(described, installed.folder, environment, progress, scenarios)
    finally:
        environment.close()
    found.save(installed.checkpoint / FOUND_FILE)
    registry.found_out.cache_clear()
    for each in (*found.notes, *(f"{way}: {why}" for way, why in found.dropped.items())):
        tqdm.write(each)


def _is_known(task: str, described: LabDescription, environment: LabEnvironment) -> bool:
    """Whether ranges were found for this lab.toml and policy, and the environment still does what it did then."""
    try:
        found = registry.found_out(task)
    except registry.NotExplored:
        return False
    why = lab_ranges.changed_since(found, described, registry.installed_task(task).folder, environment)
    if why:
        tqdm.write("What was found before is no longer true and is found anew.")
    return not why


def compare_block(block: Block) -> None:
    """Differences of one block of scenarios, written to a file that is either complete or absent."""
    archived, refined = simulation.archived_policies(block.task), block.refined
    policy = archived[refined] if refined else simulation.reference_policy(block.task)
    signals, success, reference_success, growth = [], [], [], []
    for scenario, modes in zip(range(block.first, block.first + BLOCK), block.modes, strict=True):
        reference = simulation.run_episode(block.task, policy.mean, scenario)
        reference_success.append(reference.success)
        for mode in modes:
            changed = simulation.run_episode(block.task, simulation.act_in_mode(block.task, mode, refined), scenario)
            signals.append(
                changed.signals.sum(axis=0, dtype=np.float64) - reference.signals.sum(axis=0, dtype=np.float64)
            )
            success.append(float(changed.success) - float(reference.success))
            growth.append(float(changed.contact_force_n.max() - reference.contact_force_n.max()))
    found = Differences(
        block.modes.reshape(-1, block.modes.shape[-1]), *map(np.array, (signals, success, reference_success, growth))
    )
    with written_whole(block.file) as draft:
        np.savez(draft, **vars(found))


def random_modes(task: Task, first: int) -> FloatArray:
    """(BLOCK, modes of each scenario, A) of a block."""
    return np.array(
        [
            task.modes.sample(MODES_PER_SCENARIO, np.random.default_rng([scenario, 2]))
            for scenario in range(first, first + BLOCK)
        ]
    )


def sought_scenarios(scenarios: int) -> int:
    """In every later round, where the first has so many: in the same proportion as usual, a block at least."""
    return max(BLOCK, SOUGHT_SCENARIOS * scenarios // SCENARIOS // BLOCK * BLOCK)


def block_episodes(scenarios: int) -> int:
    """How many episodes all blocks together drive, the frozen policy's among them."""
    return (scenarios + ROUNDS * sought_scenarios(scenarios)) * (MODES_PER_SCENARIO + 1)


def sought_blocks(
    compute: Compute,
    task: Task,
    surface: ResponseSurface,
    number: int,
    work_directory: Path,
    scenarios: int = SOUGHT_SCENARIOS,
) -> list[Block]:
    """Every scenario is executed in the modes of as many people, and near them."""
    count = scenarios // BLOCK
    per_block = BLOCK * MODES_PER_SCENARIO
    rng = np.random.default_rng([number, 3])
    people = min(PEOPLE, count * per_block)
    asked = [(surface, somebody(task, surface, rng), number) for _ in range(people)]
    with tqdm(total=people, unit="person", desc=f"what people would want, round {number + 1}") as bar:
        wanted = np.array(run_all(compute, best_mode, asked, 16, bar))
    width = surface.high - surface.low
    blocks = []
    for index in range(count):
        first = RESPONSE_SURFACE_SOUGHT.start + MOST_SOUGHT * number + BLOCK * index
        near = wanted[rng.choice(people, per_block, replace=False)]
        around = near + JITTER * width * rng.standard_normal(near.shape)
        modes = np.clip(around, surface.low, surface.high).reshape(BLOCK, MODES_PER_SCENARIO, -1)
        blocks.append(Block(task.name, first, modes, work_directory / f"sought-{first}.npz"))
    return blocks


def somebody(task: Task, surface: ResponseSurface, rng: np.random.Generator) -> FloatArray:
    """(S,) how much somebody drawn at random wants of each signal; of a laboratory's, each about equally much."""
    if not task.is_a_labs:
        taste = random_taste("somebody", rng)
        return signal_weights(task, taste.omega, per_signal=taste.per_signal)
    modes = rng.uniform(surface.low, surface.high, (200, len(surface.low)))
    spread = np.maximum(surface.predict(modes)[0].std(axis=0), 1e-9)
    weights = rng.standard_normal(len(spread))
    minded = [name in (*NEVER_WANTED, *task.costs) for name in task.signals]
    wants: FloatArray = np.where(minded, -np.abs(weights), weights) / spread
    return wants


def run_blocks(compute: Compute, blocks: Sequence[Block], what: str) -> None:
    """Those of them that were not run yet."""
    missing = [(block,) for block in blocks if not block.is_there()]
    with tqdm(total=len(blocks), initial=len(blocks) - len(missing), unit="block", desc=what) as bar:
        run_all(compute, compare_block, missing, 1, bar)


def run_all(
    compute: Compute, function: Callable[..., R], arguments: list[tuple[Any, ...]], each: int, bar: "tqdm[Any]"
) -> list[R]:
    """Results in the order of the arguments; ``each``: calls that a process makes before the bar moves."""
    together, results = each * compute.size(Lane.LEARNING), []
    for first in range(0, len(arguments), together):
        batch = arguments[first : first + together]
        results += compute.run_all(Lane.LEARNING, lambda: None, function, batch)
        bar.update(len(batch))
    return results


def joined(blocks: Sequence[Block]) -> Differences:
    """Of all of them, in their order."""
    loaded = [np.load(block.file, allow_pickle=False) for block in blocks]
    names = (field.name for field in fields(Differences))
    return Differences(*(np.concatenate([each[name] for each in loaded]).astype(np.float64) for name in names))


def little_foreseen(record: Mapping[str, Any], task: Task) -> str:
    """Which signals the surface with this record hardly foresees, and what to do, in words; empty: none.

    Records of earlier versions have only what was explained in the scenarios themselves.
    """
    shares = record.get("foreseen_share", record["explained_share"])
    little = [f"{name} ({max(share, 0.0):.0%})" for name, share in shares.items() if share < LITTLE]
    if not little:
        return ""
    first, last = record["scenarios"]
    count = last - first + 1
    return (
        f"How ways change {', '.join(little)} is hardly foreseen, so filters will be worth little to whoever judges by "
        "it. "
        + (
            f"{count} scenarios are few: python -m worker explore --task {task.name} --scenarios {2 * FEW_SCENARIOS}."
            if count < FEW_SCENARIOS
            else "It depends on the situation, as where actions are speeds of joints: wrap the environment so that "
            "actions move the tool, name policies to choose from, or leave such a signal out."
        )
    )


def foreseen(task: Task, found: Differences) -> FloatArray:
    """(N, S) What a surface fitted in the other scenarios says of each rollout."""
    fold = np.arange(len(found.reference_success)).repeat(MODES_PER_SCENARIO) % FOLDS
    predicted = np.empty_like(found.signals)
    for each in range(FOLDS):
        out = fold == each
        surface = response_surface.fit(
            task.modes, found.modes[~out], found.signals[~out], found.successes[~out], task.signals
        )
        predicted[out], _ = surface.predict(found.modes[out])
    return predicted


def share(task: Task, found: Differences, predicted: FloatArray) -> dict[str, float]:
    """Of what each signal differs by; below 0: worse than to say that nothing changes."""
    left = ((found.signals - predicted) ** 2).mean(axis=0)
    spread = (found.signals**2).mean(axis=0)
    return {
        name: round(float(1 - left[column] / spread[column]), 3)
        for column, name in enumerate(task.signals)
        if spread[column] > 1e-9
    }


def _publish(task: Task, scenarios: int, sought: int, found: Differences) -> dict[str, Any]:
    surface, successes, file = found.fit(task), found.successes, simulation.surface_file(task.name)
    recorded = file.with_suffix(".json")
    had_archive = recorded.exists() and "archive" in json.loads(recorded.read_text())
    surface.save(file)
    record = {
        "command": f"python -m worker explore --task {task.name} --scenarios {scenarios} --sought {sought}",
        "scenarios": [RESPONSE_SURFACE.start, RESPONSE_SURFACE[scenarios - 1]],
        "sought": {"rounds": ROUNDS, "scenarios_per_round": sought, "jitter": JITTER},
        "modes_per_scenario": MODES_PER_SCENARIO,
        "axes": {axis.name: [axis.low, axis.high] for axis in task.modes.axes},
        "reference_success": float(found.reference_success.mean()),
        "mode_success": float(successes.mean()),
        "explained_share": share(task, found, surface.predict(found.modes)[0]),
        "foreseen_share": share(task, found, foreseen(task, found)),
        "versions": {"python": platform.python_version(), "numpy": np.__version__},
    }
    recorded.write_text(json.dumps(record, indent=2) + "\n")
    if had_archive:
        tqdm.write(
            "The archive of modes went with the surface that they were found by: "
            f"`python -m worker archive --task {task.name}` makes another."
        )
    if task.is_a_labs and (said := little_foreseen(record, task)):
        tqdm.write(said)
    return record
