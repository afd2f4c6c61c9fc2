"""Do the behaviours of a pool differ in ways people have opinions on?

For every task: success of the behaviours a study's pool would show, what each end of each mode axis does, and how often
two users prefer the same clip of a matched pair. Users are the paper's three with the calibrated and the paper's cost
form, and opposed pairs of worker/ml/teachers.py. Prints Markdown for docs/results/behaviours.md.
"""

import sys
from collections.abc import Mapping, Sequence
from itertools import combinations

import numpy as np
import numpy.typing as npt
from tqdm import tqdm

from worker.compute import simulation
from worker.domain.scenarios import POOL
from worker.domain.task import Task
from worker.domain.trajectory import SIGNALS, Trajectory
from worker.ml.acquisition import matched_pairs
from worker.ml.teachers import OMEGA, OPPOSED, User
from worker.sim.costs import CostForm, preference_rewards
from worker.sim.rollout import rollout
from worker.tasks import registry

FIRST_SCENARIO = POOL.start + 700_000
SCENARIOS, AXIS_SCENARIOS, SHOWN_STEPS = 100, 20, (60, 100)
PER_SCENARIO = 4
REACHED_M = 0.06


def tell_behaviours_apart(tasks: Sequence[str], scenarios: int, axis_scenarios: int, shown_steps: Sequence[int]) -> int:
    """Print success, the effect of every mode axis, and how often users prefer the same clip: a section per task.

    A hundred scenarios take one to three minutes per task. ``axis_scenarios``: in which the ends of the axes are tried;
    ``shown_steps``: control steps that users see, from the start.
    """
    for name in tasks:
        task, pool = registry.task(name), _pool(name, scenarios)
        sys.stdout.write(f"## {task.title}\n\n{_successes(name, pool)}\n\n{_axes(name, axis_scenarios)}\n\n")
        found = [_agreements(task, pool, steps) for steps in shown_steps]
        sys.stdout.write("| prefer the same clip | " + " | ".join(f"first {steps / 10:g} s" for steps in shown_steps))
        sys.stdout.write(" |\n" + "|---" * (1 + len(found)) + "|\n")
        for pair in found[0]:
            sys.stdout.write(f"| {pair} | " + " | ".join(f"{100 * each[pair]:.0f} %" for each in found) + " |\n")
        sys.stdout.write("\n")
    return 0


def _pool(name: str, scenarios: int) -> list[Trajectory]:
    return [
        rollout(simulation.environment(name), simulation.act_as(name, behaviour), scenario)
        for scenario in tqdm(range(FIRST_SCENARIO, FIRST_SCENARIO + scenarios), desc=name)
        for behaviour in simulation.behaviours(name, scenario, PER_SCENARIO)
    ]


def _successes(name: str, pool: list[Trajectory]) -> str:
    """Success of the pool, and of each kind of behaviour in it."""
    kinds: dict[str, list[bool]] = {}
    for index, trajectory in enumerate(pool):
        behaviour = simulation.behaviours(name, trajectory.scenario, PER_SCENARIO)[index % PER_SCENARIO]
        kind = next((each for each in ("checkpoint", "temperature", "disturbance") if getattr(behaviour, each)), "mode")
        kinds.setdefault(kind, []).append(trajectory.success)
    parts = (f"{kind} {100 * np.mean(each):.0f} % of {len(each)}" for kind, each in sorted(kinds.items()))
    overall = np.mean([each.success for each in pool])
    return f"Success of the pool's behaviours: **{100 * overall:.1f} %** ({'; '.join(parts)})."


def _axes(name: str, scenarios: int) -> str:
    """What each end of each mode axis does, over a few scenarios."""
    family, environment = registry.task(name).modes, simulation.environment(name)
    lines = [
        "| mode | success | arrives, s | speed near, m/s | force at target, N | largest force, N | sideways, cm |",
        "|---|---|---|---|---|---|---|",
    ]
    ends: list[tuple[str, Mapping[str, float]]] = [("reference", {})]
    ends += [(f"{axis.name} {end:+g}", {axis.name: end}) for axis in family.axes for end in (axis.low, axis.high)]
    for label, mode in ends:
        act = simulation.act_in_mode(name, family.vector(mode))
        made = [rollout(environment, act, FIRST_SCENARIO + 5000 + each) for each in range(scenarios)]
        lines.append(f"| {label} | " + " | ".join(_figures(made)) + " |")
    return "\n".join(lines)


def _figures(made: list[Trajectory]) -> list[str]:
    distance, speed, force, sideways = (
        np.array([each.signals[:, SIGNALS.index(column)] for each in made])
        for column in ("distance_m", "speed_m_s", "force_at_target_n", "lateral_offset_m")
    )
    arrived = np.where((distance < REACHED_M).any(axis=1), (distance < REACHED_M).argmax(axis=1), distance.shape[1])
    near = (distance < 0.2) & (np.arange(distance.shape[1]) <= arrived[:, None])
    return [
        f"{100 * np.mean([each.success for each in made]):.0f} %",
        f"{np.mean(arrived) / 10:.1f}",
        f"{speed[near].mean():.3f}" if near.any() else "-",
        f"{force.mean(where=force > 0) if (force > 0).any() else 0.0:.1f}",
        f"{np.mean([each.contact_force_n.max() for each in made]):.1f}",
        f"{100 * sideways.max(axis=1).mean():.0f}",
    ]


def _agreements(task: Task, pool: list[Trajectory], steps: int) -> dict[str, float]:
    """Share of matched pairs on which two users prefer the same clip."""
    rows = matched_pairs([each.scenario for each in pool])

    def wants(omega: tuple[float, ...], form: CostForm, extra: Mapping[str, float]) -> npt.NDArray[np.bool_]:
        totals = np.array(
            [
                preference_rewards(task, each.costs[:steps], each.signals[:steps], omega, form, extra).sum()
                for each in pool
            ]
        )
        prefers: npt.NDArray[np.bool_] = totals[rows[:, 1]] > totals[rows[:, 0]]
        return prefers

    found = {}
    forms: tuple[CostForm, ...] = ("calibrated", "paper")
    for form in forms:
        for first, second in combinations(User, 2):
            same = wants(OMEGA[first], form, {}) == wants(OMEGA[second], form, {})
            found[f"{first}-{second}, {form}"] = float(same.mean())
    for pair in OPPOSED:
        one, other = (wants(taste.omega, "calibrated", taste.per_signal) for taste in pair)
        found[f"{pair[0].name}-{pair[1].name}"] = float((one == other).mean())
    return found
