"""Tries archived policies in modes that people would want: ``python -m worker archive-policies-in-modes --task NAME``.

Of everybody drawn at random the best mode of the best policy is foreseen. What is best for most of them is driven, and
archived if it keeps the task; what came of it says more of the modes around its policy, and where more was lost others
are sought more carefully. What is driven is kept, so an interrupted run goes on where it was.
"""

import json
import platform
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

from worker.compute import learning, simulation
from worker.compute.archived import Archived
from worker.domain.scenarios import POLICY_TEST, first_of
from worker.domain.trajectory import Trajectory
from worker.domain.type_aliases import FloatArray
from worker.experiments.archive_policies import TEST_SCENARIOS
from worker.experiments.fit_response_surface import somebody
from worker.experiments.rollout_cache import RolloutCache, weights_mark
from worker.ml.filters.fitting.filter_problem import FilterConfig
from worker.ml.filters.fitting.gate import largest_forces, signal_changes, successes
from worker.ml.filters.fitting.mode_archive import tail_growth_n
from worker.ml.filters.fitting.response_surface import ResponseSurface, best_mode
from worker.ml.policies.gaussian import GaussianPolicy
from worker.tasks import registry
from worker.whole_files import written_whole

PEOPLE = 96
"""drawn at random, each of whom wants one mode of one policy"""
MOST_TRIED, MOST_KEPT = 60, 12
LARGEST_LOSS = 0.01
"""of success, as of a filter that was sought for somebody; and share of scenarios in which somebody may be pressed"""
LEAST_GAIN = 0.002
"""of what is foreseen for people at best, in the mean, that a mode has to add"""
AT_ONCE = 100
"""scenarios, after which what has lost more than can be won back is driven no further"""


class NoPolicies(ValueError):
    """There is nothing to try modes of."""


@dataclass(frozen=True)
class Driven:
    """What a policy changes beside the frozen one in N scenarios: all, or those in which it has lost too much."""

    signals: FloatArray
    """(N, S) summed over an episode"""
    succeeded: FloatArray
    """(N,) in {0, 1}"""
    failed: int
    """how many more fail"""
    growth_n: FloatArray
    """(N,) of the largest force on the person"""

    @property
    def pressed(self) -> int:
        """In how many somebody is pressed much harder."""
        return int((self.growth_n > FilterConfig().pressed_n).sum())

    def keeps_task(self, alone: "Driven", winnable: int = 0) -> bool:
        """Whether next to nothing is lost of all that ``alone`` was driven through, and nobody is pressed more than so.

        ``winnable``: in how many of those that are left the frozen policy fails.
        """
        allowed = round(LARGEST_LOSS * len(alone.signals))
        return self.failed - winnable <= allowed and self.pressed <= max(allowed, alone.pressed)


def archive_policies_in_modes(
    task: str, work: Path, people: int = PEOPLE, tried: int = MOST_TRIED, scenarios: int = TEST_SCENARIOS
) -> dict[str, Any]:
    """Try modes of archived policies, and write those that keep the task beside the policies; the record is returned.

    Raises NoPolicies where none of the task's policies, or nothing around them, was explored.
    """
    torch.set_num_threads(1)
    policies = simulation.archived_policies(task)
    surfaces = {name: surface for name in policies if (surface := simulation.surface_around(task, name))}
    if not surfaces:
        raise NoPolicies(f"There are no policies; `python -m worker archive-policies --task {task}` refines some.")
    trials, wants = _Trials(task, work, scenarios), _wants(task, people)
    bar = tqdm(total=len(surfaces) + tried, unit="mode", desc="tried")
    around = list[_Around]()
    for name, surface in surfaces.items():
        around.append(_Around(name, policies[name], surface, trials.drive(Archived(task, name, policies[name])), wants))
        bar.update()
    reached = np.maximum(np.max([wants @ each.alone.signals.mean(axis=0) for each in around], axis=0), 0.0)
    found = list[dict[str, Any]]()
    while len(found) < tried and sum(each["kept"] for each in found) < MOST_KEPT:
        chosen, mode = _best_for_most(around, wants, reached)
        if chosen is None:
            break
        driven = trials.drive(Archived(task, chosen.name, chosen.policy, mode), chosen.alone)
        is_kept = driven.keeps_task(chosen.alone)
        if is_kept:
            reached = np.maximum(reached, wants @ driven.signals.mean(axis=0))
        chosen.observe(mode, driven, is_kept=is_kept)
        counts = {"scenarios": len(driven.signals), "failed": driven.failed, "pressed": driven.pressed}
        found.append({"policy": chosen.name, "mode": mode, **counts, "kept": is_kept})
        bar.update()
    bar.close()
    record = {
        "command": f"python -m worker archive-policies-in-modes --task {task}",
        "people": people,
        "scenarios": [trials.scenarios[0], trials.scenarios[-1]],
        "modes": found,
        "versions": {"python": platform.python_version(), "numpy": np.__version__, "torch": torch.__version__},
    }
    with written_whole(simulation.archived_modes_file(task)) as draft:
        draft.write_text(json.dumps(record, indent=2) + "\n")
    return record


def _wants(task: str, people: int) -> FloatArray:
    """(P, S) what people drawn at random want of the signals."""
    described = registry.task(task)
    surface = ResponseSurface.load(simulation.surface_file(task), described.modes, described.signals)
    rng = np.random.default_rng([people, 5])
    return np.array([somebody(described, surface, rng) for _ in range(people)])


class _Around:
    """An archived policy, and the mode of it that is best for each of the people by what is known so far."""

    def __init__(
        self, name: str, policy: GaussianPolicy, surface: ResponseSurface, alone: Driven, wants: FloatArray
    ) -> None:
        self.name, self.policy, self.alone, self.wants = name, policy, alone, wants
        self.surface, self.forces, self.lost, self.tried = surface, surface.forces, 0, list[dict[str, float]]()
        self._seek()

    def observe(self, mode: dict[str, float], driven: Driven, *, is_kept: bool) -> None:
        """Learn from what came of a mode, and seek everybody's anew."""
        at = np.array([mode[axis] for axis in self.surface.axes])
        changes = driven.signals - self.alone.signals[: len(driven.signals)]
        self.surface = self.surface.with_observed(at, changes, driven.succeeded)
        self.forces = self.forces.with_observed(at, float(tail_growth_n(driven.growth_n)))
        self.tried.append(mode)
        self.lost += not is_kept
        self._seek()

    def _seek(self) -> None:
        """More carefully about success, the more were tried that lost too much."""
        config = FilterConfig()
        modes = [
            best_mode(
                self.surface,
                wants,
                seed,
                success_caution=config.success_caution * (1 + self.lost),
                forces=self.forces,
                most_growth_n=config.pressed_n,
            )
            for seed, wants in enumerate(self.wants)
        ]
        self.modes = [{axis: round(float(x), 4) for axis, x in zip(self.surface.axes, at, strict=True)} for at in modes]
        self.signals = self.alone.signals.mean(axis=0) + self.surface.predict(np.array(modes))[0]
        self.is_new = np.array([any(mode.values()) and mode not in self.tried for mode in self.modes])


def _best_for_most(
    around: list[_Around], wants: FloatArray, reached: FloatArray
) -> tuple[_Around | None, dict[str, float]]:
    """The mode that is foreseen to add most to what people have reached; none where that is next to nothing."""
    signals = np.concatenate([each.signals[each.is_new] for each in around])
    of = [(each, mode) for each in around for mode, is_new in zip(each.modes, each.is_new, strict=True) if is_new]
    if not of:
        return None, {}
    foreseen = wants @ signals.T
    best = np.maximum(np.maximum(reached, foreseen.max(axis=1)), 1e-9)
    added = (np.maximum(foreseen - reached[:, None], 0.0) / best[:, None]).mean(axis=0)
    return of[int(added.argmax())] if added.max() >= LEAST_GAIN else (None, {})


class _Trials:
    """Drives through the same scenarios, each kept in the work directory."""

    def __init__(self, task: str, work: Path, scenarios: int) -> None:
        self.task, self.work = task, work
        self.scenarios = first_of(POLICY_TEST, scenarios)
        rollouts = RolloutCache(task, work / "rollouts")
        self.reference = rollouts.reference(self.scenarios)
        self.gate_reference = rollouts.reference(FilterConfig().gate_block(registry.task(task)))

    def drive(self, tried: Archived, alone: Driven | None = None) -> Driven:
        """Drive it, unless that was done; beside its policy ``alone`` no further once it has lost too much."""
        marked = weights_mark(tried.policy, repr(tried.mode).encode())
        kept = self.work / f"{tried.name}-{marked}-{len(self.scenarios)}.npz"
        if not kept.exists():
            found = self._driven(tried, alone)
            with written_whole(kept) as draft:
                np.savez_compressed(draft, **vars(found))
        with np.load(kept, allow_pickle=False) as stored:
            return Driven(stored["signals"], stored["succeeded"], int(stored["failed"]), stored["growth_n"])

    def _driven(self, tried: Archived, alone: Driven | None) -> Driven:
        act, rollouts = tried.exported(self.gate_reference), list[Trajectory]()
        while True:
            some = self.scenarios[len(rollouts) : len(rollouts) + AT_ONCE]
            rollouts += learning.run_scenarios(self.task, act, some, 0.0, 0)
            found, left = self._beside_reference(rollouts), self.reference[len(rollouts) :]
            winnable = sum(not each.success for each in left)
            if not left or (alone and not found.keeps_task(alone, winnable)):
                return found

    def _beside_reference(self, driven: Sequence[Trajectory]) -> Driven:
        reference, succeeded = self.reference[: len(driven)], successes(driven)
        return Driven(
            signal_changes(reference, driven),
            succeeded,
            round(float((successes(reference) - succeeded).sum())),
            largest_forces(driven) - largest_forces(reference),
        )
