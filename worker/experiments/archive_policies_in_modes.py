"""Tries archived policies in modes that people would want: ``python -m worker archive-policies-in-modes --task NAME``.

Of everybody drawn at random the best mode of the best policy is foreseen; those that are best for most who are left are
driven, and archived if they keep the task. What is driven is kept, so an interrupted run goes on where it was.
"""

import json
import platform
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

from worker.compute import learning, simulation
from worker.compute.archived import Archived
from worker.domain.scenarios import POLICY_TEST, first_of
from worker.domain.type_aliases import FloatArray
from worker.experiments.archive_policies import LARGEST_LOSS, TEST_SCENARIOS
from worker.experiments.fit_response_surface import somebody
from worker.experiments.rollout_cache import RolloutCache, weights_mark
from worker.ml.filters.fitting.filter_problem import FilterConfig
from worker.ml.filters.fitting.gate import largest_forces, signal_changes, successes
from worker.ml.filters.fitting.response_surface import ResponseSurface, best_mode
from worker.tasks import registry
from worker.whole_files import written_whole

PEOPLE = 96
"""drawn at random, each of whom gives one mode of one policy"""
MOST_TRIED, MOST_KEPT = 24, 12
LEAST_GAIN = 0.002
"""of what people could gain, in the mean, that a mode has to add"""
SUCCESS_CAUTION = 3.0
"""standard deviations less success than is foreseen: of modes that were sought with one, many lost the task"""


class NoPolicies(ValueError):
    """There is nothing to try modes of."""


def archive_policies_in_modes(
    task: str, work: Path, people: int = PEOPLE, tried: int = MOST_TRIED, scenarios: int = TEST_SCENARIOS
) -> dict[str, Any]:
    """Try modes of archived policies, and write those that keep the task beside the policies; the record is returned.

    Raises NoPolicies where none of the task's policies, or nothing around them, was explored.
    """
    torch.set_num_threads(1)
    policies = simulation.archived_policies(task)
    around = {name: surface for name in policies if (surface := simulation.surface_around(task, name))}
    if not around:
        raise NoPolicies(f"There are no policies; `python -m worker archive-policies --task {task}` refines some.")
    trials = _Trials(task, work, scenarios)
    as_they_are = {
        name: trials.drive(Archived(task, name, policies[name])) for name in tqdm(around, desc="as they are")
    }
    wants = _wants(task, people)
    asked = [_best(number, wants[number], as_they_are, around) for number in tqdm(range(people), desc="people")]
    foreseen = np.array([each["signals"] for each in asked])
    alone = wants @ np.array([each["signals"] for each in as_they_are.values()]).T
    reached = np.maximum(alone.max(axis=1), 0.0)
    unit = np.maximum(np.maximum(reached, (wants @ foreseen.T).max(axis=1)), 1e-9)
    found, left = list[dict[str, Any]](), list(range(people))
    with tqdm(total=tried, desc="modes") as bar:
        while left and len(found) < tried and sum(each["kept"] for each in found) < MOST_KEPT:
            added = (np.maximum(wants @ foreseen[left].T - reached[:, None], 0.0) / unit[:, None]).mean(axis=0)
            if added.max() < LEAST_GAIN:
                break
            chosen = asked[left.pop(int(added.argmax()))]
            name, mode = chosen["policy"], chosen["mode"]
            driven = trials.drive(Archived(task, name, policies[name], mode))
            is_kept = max(driven["failed"], driven["pressed"]) <= LARGEST_LOSS
            if is_kept:
                reached = np.maximum(reached, wants @ np.array(driven["signals"]))
            share = float((reached / unit).mean())
            counts = {each: driven[each] for each in ("failed", "pressed")}
            found.append({"policy": name, "mode": mode, **counts, "kept": is_kept, "reached": round(share, 4)})
            bar.update()
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


def _best(
    seed: int, wants: FloatArray, as_they_are: Mapping[str, Mapping[str, Any]], around: Mapping[str, ResponseSurface]
) -> dict[str, Any]:
    """The best mode of the best policy for one person, and what is foreseen to change of the signals."""
    found = list[tuple[float, dict[str, Any]]]()
    for name, surface in around.items():
        mode = best_mode(
            surface,
            wants,
            seed,
            success_caution=SUCCESS_CAUTION,
            forces=surface.forces,
            most_growth_n=FilterConfig().pressed_n,
        )
        signals = np.array(as_they_are[name]["signals"]) + surface.predict(mode)[0]
        named = {axis: round(float(at), 4) for axis, at in zip(surface.axes, mode, strict=True)}
        found.append((float(signals @ wants), {"policy": name, "mode": named, "signals": signals}))
    return max(found, key=lambda each: each[0])[1]


class _Trials:
    """Drives through the same scenarios, each kept in the work directory."""

    def __init__(self, task: str, work: Path, scenarios: int) -> None:
        self.task, self.work = task, work
        self.scenarios = first_of(POLICY_TEST, scenarios)
        self.reference = RolloutCache(task, work / "rollouts").reference(self.scenarios)

    def drive(self, tried: Archived) -> dict[str, Any]:
        """What changes of the summed signals in the mean, and in what shares of scenarios the task or somebody suffers.

        ``failed``: how many more fail; ``pressed``: in how many somebody is pressed much harder.
        """
        marked = weights_mark(tried.policy, repr(tried.mode).encode())
        kept = self.work / f"{tried.name}-{marked}-{len(self.scenarios)}.json"
        if not kept.exists():
            driven = learning.run_scenarios(self.task, tried.exported(), self.scenarios, 0.0, 0)
            growth = largest_forces(driven) - largest_forces(self.reference)
            found = {
                "signals": signal_changes(self.reference, driven).mean(axis=0).tolist(),
                "failed": round(float((successes(self.reference) - successes(driven)).mean()), 4),
                "pressed": round(float((growth > FilterConfig().pressed_n).mean()), 4),
            }
            with written_whole(kept) as draft:
                draft.write_text(json.dumps(found))
        known: dict[str, Any] = json.loads(kept.read_text())
        return known
