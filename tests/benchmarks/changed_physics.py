"""Does a filter keep its gain in a world that it was not fitted in? The default filter under changed physics.

    python -m tests.benchmarks.changed_physics --output docs/results/changed_physics

Per task and user of the paper: 200 answers and the default filter, fitted as always. Filter and reference policy are
then driven through the same fresh scenarios while one thing is different, without being fitted again. One process on
one core at the lowest priority; every finished row is kept, so that it can be interrupted.
"""

import argparse
import os
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

from app.installed_tasks import catalogue
from tests.benchmarks import result_tables
from worker.analysis.comparison import result_pages
from worker.analysis.filters.promise import Promise, harms, outcome_of
from worker.compute import learning, simulation
from worker.compute.filter_finishing import forward_model_of, usually_at_most
from worker.domain.scenarios import EVALUATION, PROMISE_TEST, first_of
from worker.domain.spaces import Space
from worker.domain.trajectory import Trajectory
from worker.domain.type_aliases import Act, Float32Array, FloatArray
from worker.experiments.benchmark_cell import PAPER_USERS, BenchmarkConfig, BenchmarkUser, Cell, default_method
from worker.experiments.rollout_cache import RolloutCache
from worker.ml.export.forward_model import DynamicsMonitor, ForwardModel
from worker.ml.export.run_filter import strong_share, unusual_activity
from worker.ml.filters.exported.filter_act import FilterAct
from worker.ml.filters.fitting.filter_problem import FilterConfig
from worker.ml.methods import registry as methods
from worker.sim.assistive import AssistiveEnv
from worker.sim.bullet import Bullet
from worker.sim.costs import preference_rewards, stakes
from worker.sim.engine import pybullet
from worker.sim.human import Impairment
from worker.sim.rollout import rollout
from worker.tasks import registry

TITLE = "# Filters under changed physics"
SKIP = 500_000
"""Scenarios of PROMISE_TEST from here on are driven; its first ones belong to the benchmark of promises."""


@dataclass(frozen=True)
class Change:
    """What is different from the world that everything was fitted in."""

    friction: float = 1.0
    """of every body, times this"""
    mass: float = 1.0
    """of everything that moves, times this"""
    delay_steps: int = 0
    """control steps by which actions come late"""
    noise: float = 0.0
    """standard deviation of every number of the observation, as a share of the range declared for its field"""
    substeps: int = AssistiveEnv.substeps
    """physics steps of 0.02 s per action"""
    impairment: Impairment = "none"


CHANGES: Mapping[str, Change] = {
    "nothing": Change(),
    "half the friction": Change(friction=0.5),
    "twice the friction": Change(friction=2.0),
    "twice the mass": Change(mass=2.0),
    "actions one step late": Change(delay_steps=1),
    "noisy sensors": Change(noise=0.005),
    "12.5 actions a second": Change(substeps=4),
    "8.3 actions a second": Change(substeps=6),
    "tremor": Change(impairment="tremor"),
    "weak arm": Change(impairment="weakness"),
    "narrow range of motion": Change(impairment="limits"),
}


def main() -> None:
    """Measure the rows that are missing."""
    options = _options()
    torch.set_num_threads(1)
    table = options.output.with_suffix(".csv")
    rows: list[Mapping[str, Any]] = list(result_tables.read(table))
    known = {(row["task"], row["user"], row["change"]) for row in rows if row["method"] == default_method(row["task"])}
    people = [(task, user) for user in PAPER_USERS for task in options.tasks]
    for task, user in tqdm(people, unit="filter"):
        missing = [name for name in _changes_of(task) if (task, user, name) not in known]
        for row in _measured(task, user, missing, options) if missing else ():
            rows.append({name: str(value) for name, value in row.items()})
            _write(rows, options.output)
    _write(rows, options.output)


def _measured(task: str, user: str, changes: Sequence[str], options: argparse.Namespace) -> Iterator[Mapping[str, Any]]:
    work = options.work_directory
    method = default_method(task)
    cell = Cell(task, PAPER_USERS[user], method, 0)
    bench = BenchmarkUser(cell, BenchmarkConfig(), RolloutCache(task, work / "rollouts"), work)
    act = methods.fit(method, bench.setting()).act
    if not isinstance(act, FilterAct):
        raise TypeError(f"{method} is no filter.")
    scenarios = first_of(PROMISE_TEST, options.scenarios, skip=SKIP)
    tests = learning.run_scenarios(task, act, first_of(EVALUATION, FilterConfig().evaluation_scenarios), 0.0, 0)
    model = forward_model_of(bench.task, tests)
    for name in changes:
        env = changed_environment(task, CHANGES[name])
        policy = simulation.reference_policy(task).mean
        reference, filtered = ([_driven(env, each, some) for some in scenarios] for each in (policy, act))
        env.close()
        found = _row(bench, act, reference, filtered)
        told = {"answers_otherwise": _answering_otherwise(task, model, filtered)}
        yield {"task": task, "user": user, "method": method, "change": name, **found, **told}


def _changes_of(task: str) -> Sequence[str]:
    """A weak arm makes a difference only where it is touched."""
    return [name for name in CHANGES if task == "scratching" or name != "weak arm"]


def _driven(env: AssistiveEnv, act: Act, scenario: int) -> Trajectory:
    return rollout(env, act, scenario, simulation.reference_policy(env.task.name).mean)


# -- another world -----------------------------------------------------------------------------------------------------


def changed_environment(task: str, change: Change) -> AssistiveEnv:
    """The task's environment with one thing different."""
    usual = registry.environment_class(task)

    class Changed(usual):  # type: ignore[misc, valid-type]
        substeps = change.substeps
        _bodies_of_before: Mapping[str, int] | None = None

        def _begin(self, scenario: int) -> None:
            self._noise = np.random.default_rng([scenario, 5])
            self._late = deque([np.zeros(len(self.robot.joints), np.float32)] * change.delay_steps)
            super()._begin(scenario)

        def _lay_out(self, rng: np.random.Generator) -> None:
            """What stays in the world from one episode to the next, which is not the person, is changed once."""
            super()._lay_out(rng)
            if self._bodies_of_before is not self._world._bodies:  # cleared: every body is new
                self._bodies_of_before, self._changed = self._world._bodies, set[str]()
            new = [name for name in self._world._bodies if name in self.person_parts or name not in self._changed]
            _scale(self._world, new, change.friction, change.mass)
            self._changed.update(new)

        def _advance(self, executed: Float32Array) -> Any:
            self._late.append(executed)
            return super()._advance(self._late.popleft())

        def _observe(self) -> Float32Array:
            return _with_noise(super()._observe(), self.task.observation, change.noise, self._noise)

    environment: AssistiveEnv = Changed(impairments=(change.impairment,))
    return environment


def _scale(world: Bullet, names: Sequence[str], friction: float, mass: float) -> None:
    client = world.client
    for body in [world._bodies[name] for name in names]:
        for link in range(-1, pybullet.getNumJoints(body, physicsClientId=client)):
            weighs, rubs = pybullet.getDynamicsInfo(body, link, physicsClientId=client)[:2]
            if friction != 1.0:
                pybullet.changeDynamics(body, link, lateralFriction=friction * rubs, physicsClientId=client)
            if mass != 1.0 and weighs > 0.0:
                pybullet.changeDynamics(body, link, mass=mass * weighs, physicsClientId=client)


def _with_noise(seen: Float32Array, space: Space, noise: float, rng: np.random.Generator) -> Float32Array:
    if noise == 0.0:
        return seen
    return np.asarray(seen + noise * space.widths * rng.standard_normal(len(seen)), np.float32)


# -- what came of it ---------------------------------------------------------------------------------------------------


def _row(
    bench: BenchmarkUser, act: FilterAct, reference: Sequence[Trajectory], filtered: Sequence[Trajectory]
) -> Mapping[str, Any]:
    before, after = (_summed(bench, preference_rewards, some) for some in (reference, filtered))
    gains = 100.0 * (after - before) / _summed(bench, stakes, reference).mean()
    outcomes = [[outcome_of(each, bench.task) for each in some] for some in (reference, filtered)]
    activities = [act.shield_activity(each) for each in filtered]
    harmed = sum(bool(harms(Promise(), *pair)) for pair in zip(*outcomes, strict=True))
    return {
        "scenarios": len(gains),
        "gain_percent": f"{gains.mean():.2f}",
        "gain_error": f"{gains.std(ddof=1) / len(gains) ** 0.5:.3f}",
        "successes": sum(each.success for each in filtered),
        "successes_reference": sum(each.success for each in reference),
        "harmed": harmed,
        "worst_force_n": f"{max(each.largest_force_n for each in outcomes[1]):.1f}",
        "worst_force_reference_n": f"{max(each.largest_force_n for each in outcomes[0]):.1f}",
        "shield_active": f"{(np.concatenate(activities) > 0.0).mean():.4f}",
        "shield_strong": " ".join(f"{strong_share(each):.2f}" for each in activities),
    }


def _answering_otherwise(task: str, model: ForwardModel | None, driven: Sequence[Trajectory]) -> str:
    """After how many steps of each episode a loop would say that the robot answers otherwise; 0: never."""
    if model is None:
        raise ValueError("too few steps to learn a forward model from")
    names = [field.name for field in registry.task(task).observation.fields for _ in range(field.size)]
    told = []
    for each in driven:
        monitor = DynamicsMonitor(model, names, len(each))
        told.append(next((step for step, notes in enumerate(_notes(monitor, each), 1) if notes), 0))
    return " ".join(map(str, told))


def _notes(monitor: DynamicsMonitor, driven: Trajectory) -> Iterator[Mapping[str, str]]:
    seen = driven.observations
    for before, action, after in zip(seen[:-1], driven.actions, seen[1:], strict=True):
        monitor.step(before, action, after)
        yield monitor.notes()


def _summed(bench: BenchmarkUser, measure: Any, some: Sequence[Trajectory]) -> FloatArray:
    """(N,) of whole episodes, for the user's true preference."""
    taste = bench.cell.taste
    return np.array(
        [measure(bench.task, t.costs, t.signals, taste.omega, "calibrated", taste.per_signal).sum() for t in some]
    )


def _write(rows: Sequence[Mapping[str, Any]], output: Path) -> None:
    if not rows:
        return
    result_tables.write(output.with_suffix(".csv"), rows)
    page = output.with_suffix(".md")
    page.write_text(result_pages.page(page, TITLE, _tables(rows)))


def _tables(rows: Sequence[Mapping[str, Any]]) -> str:
    lines = []
    for task in dict.fromkeys(row["task"] for row in rows):
        some = [row for row in rows if row["task"] == task]
        users = list(dict.fromkeys(row["user"] for row in some))
        lines += [
            f"## {registry.task(task).title}",
            "",
            "| changed | "
            + " | ".join(f"{user}: gain, %" for user in users)
            + " | success, points | of the reference, % | harmed | worst force, N | of the reference | shield, % |"
            + " shield told | answers told |",
            "|---" * (len(users) + 9) + "|",
        ]
        usual = {row["user"]: _strong_shares(row) for row in some if row["change"] == "nothing"}
        for change in CHANGES:
            found = {row["user"]: row for row in some if row["change"] == change}
            if found:
                lines.append(_line(change, [found.get(user) for user in users], usual))
        lines.append("")
    return "\n".join(lines)


def _line(change: str, rows: Sequence[Mapping[str, Any] | None], usual: Mapping[str, list[float]]) -> str:
    here = [row for row in rows if row]
    driven = sum(int(row["scenarios"]) for row in here)
    successes = [sum(int(row[name]) for row in here) / driven for name in ("successes", "successes_reference")]
    worst = [max(float(row[name]) for row in here) for name in ("worst_force_n", "worst_force_reference_n")]
    shield = np.mean([float(row["shield_active"]) for row in here])
    told = [
        bool(unusual_activity(share, usually_at_most(usual[row["user"]])))
        for row in here
        for share in _strong_shares(row)
    ]
    after = [int(step) for row in here for step in row["answers_otherwise"].split()]
    return (
        f"| {change} | {' | '.join(_gain(row) if row else '-' for row in rows)}"
        f" | {100 * (successes[0] - successes[1]):+.1f} | {100 * successes[1]:.1f}"
        f" | {sum(int(row['harmed']) for row in here)} of {driven} | {worst[0]:.1f} | {worst[1]:.1f}"
        f" | {100 * shield:.1f} | {f'{sum(told)} of {len(told)}' if told else '-'}"
        f" | {f'{sum(step > 0 for step in after)} of {len(after)}' if after else '-'} |"
    )


def _strong_shares(row: Mapping[str, Any]) -> list[float]:
    """Of every episode."""
    return [float(share) for share in row["shield_strong"].split()]


def _gain(row: Mapping[str, Any]) -> str:
    mean, half = float(row["gain_percent"]), 1.96 * float(row["gain_error"])
    return f"{mean:+.1f} [{mean - half:+.1f}, {mean + half:+.1f}]"


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", choices=catalogue.names(), default=catalogue.names())
    parser.add_argument("--scenarios", type=int, default=40, help="per user and change")
    parser.add_argument("--work-directory", type=Path, default=Path("data/benchmark"), help="of rollouts")
    parser.add_argument(
        "--output", type=result_tables.stem, required=True, help="path without ending of the page and the table"
    )
    return parser.parse_args()


if __name__ == "__main__":
    os.nice(19 - os.nice(0))
    main()
