"""Are three opposed users of the two foreign examples each served best by their own filter? docs/results/foreign.md.

    python -m tests.benchmarks.foreign reach reacher

``LAB_TASKS`` names the folders of the two examples, and reacher's policy server has to be there. Each user's filter is
kept when it is done (--work), with what it did in unseen scenarios: an interrupted run goes on where it was.
"""

import argparse
import csv
import itertools
import sys
import time
from pathlib import Path

import numpy as np

from tests.worker.at_hand import AtHand
from worker.analysis.filters.promise import Outcome
from worker.compute import learning, simulation
from worker.compute.filter_fitting import FilterFit
from worker.domain.responses import TARGETS
from worker.domain.scenarios import EVALUATION, POOL, first_of
from worker.domain.trajectory import Trajectory
from worker.domain.type_aliases import Act, FloatArray
from worker.ml import acquisition
from worker.ml.filters.exported.filter_act import act_of
from worker.ml.filters.fitting.filter_problem import FilterConfig
from worker.ml.filters.fitting.pool import Pool
from worker.ml.rewards.segments import SegmentPairs
from worker.ml.rewards.signal_scale import SignalScale
from worker.ml.teachers import Manner, ScriptedTeacher
from worker.tasks import registry
from worker.whole_files import written_whole

USERS = {
    "reach": {
        "quick": {"distance_m": -1.0},
        "gentle": {"speed_squared_m2_s2": -1.0, "acceleration_squared_m2_s4": -0.5},
        "high": {"height_m": 1.0},
    },
    "reacher": {
        "quick": {"distance_m": -1.0},
        "gentle": {"speed_squared_m2_s2": -1.0, "effort": -0.5},
        "straight": {"elbow_rad": -1.0},
    },
}
"""What each wants more of (+) or less, in units of what pairs of the pool usually differ by."""
PER_SCENARIO, MISTAKES = 4, 0.1
LABELS, SEEDS = (60, 200), (0, 1, 2)
UNSEEN = first_of(EVALUATION, 150, skip=500)
FILE = Path("docs/results/foreign.csv")
COLUMNS = (
    "task",
    "labels",
    "seed",
    "filter",
    "success",
    "quick",
    "gentle",
    "third",
    "lead",
    "lead_low",
    "lead_high",
    "fit_s",
)
CRITICAL = 1.96
OUTCOMES: dict[tuple[str, int], list[Outcome]] = {}
"""Of the frozen policies, for the promise."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("tasks", nargs="+", help=" or ".join(USERS))
    parser.add_argument("--labels", nargs="+", type=int, default=LABELS)
    parser.add_argument("--seeds", nargs="+", type=int, default=SEEDS, help="of answers and trainings")
    parser.add_argument("--work", type=Path, default=Path("data/foreign"))
    parser.add_argument("--file", type=Path, default=FILE)
    said = parser.parse_args()
    if unknown := set(said.tasks) - set(USERS):
        parser.error(f"nobody's wishes are known for {min(unknown)}; there are {', '.join(USERS)}.")
    said.work.mkdir(parents=True, exist_ok=True)
    cells = itertools.product(said.tasks, said.labels, said.seeds)
    rows = [row for task, labels, seed in cells for row in table(task, labels, seed, said.work)]
    with said.file.open("w", newline="") as target:
        csv.writer(target, lineterminator="\n").writerows([COLUMNS, *rows])


def table(name: str, labels: int, seed: int, work: Path) -> list[tuple[object, ...]]:
    """What every filter is worth to every user, in spreads of a pair, against the frozen policy.

    ``lead``: how much more a user's own filter is worth to them than the best of the others', with its 95 % interval
    over scenarios.
    """
    pool = _pool(name, labels)
    scale, wants = _scale(name, pool), _wants(name)
    reference = _driven(name, "reference", labels, seed, work, scale, pool)
    filters = {who: _driven(name, who, labels, seed, work, scale, pool) for who in wants}
    rows = []
    for who, own in filters.items():
        worth = {
            judge: (own["signals"] - reference["signals"]) / scale.spread @ weights for judge, weights in wants.items()
        }
        leads = [
            (own["signals"] - other["signals"]) / scale.spread @ wants[who]
            for other in filters.values()
            if other is not own
        ]
        lead = min(leads, key=lambda each: float(each.mean()))
        half = CRITICAL * float(lead.std(ddof=1)) / len(lead) ** 0.5
        numbers = (*(each.mean() for each in worth.values()), lead.mean(), lead.mean() - half, lead.mean() + half)
        success = own["success"].mean() - reference["success"].mean()
        row = (name, labels, seed, who, round(float(success), 3), *(round(float(each), 2) for each in numbers))
        rows.append((*row, round(float(own["seconds"]))))
        sys.stdout.write(f"{rows[-1]}\n")
        sys.stdout.flush()
    return rows


def _wants(name: str) -> dict[str, FloatArray]:
    signals = registry.task(name).signals
    return {
        who: np.array([minds.get(signal, 0.0) for signal in signals], np.float64) for who, minds in USERS[name].items()
    }


def _pool(name: str, labels: int) -> list[Trajectory]:
    return [
        simulation.run_episode(name, simulation.act_as(name, behaviour), scenario)
        for scenario in first_of(POOL, max(20, -(-labels // 6)), skip=900_000)
        for behaviour in simulation.behaviours(name, scenario, PER_SCENARIO)
    ]


def _rows(pool: list[Trajectory]) -> acquisition.Indices:
    return acquisition.matched_pairs([each.scenario for each in pool])


def _cut(name: str, pool: list[Trajectory], rows: acquisition.Indices) -> SegmentPairs:
    steps = registry.installed_task(name).description.usual_clip_steps
    return SegmentPairs.cut([(pool[left], pool[right]) for left, right in rows], 0, steps)


def _scale(name: str, pool: list[Trajectory]) -> SignalScale:
    means = [each.signals.mean(axis=0, dtype=np.float64) for each in pool]
    return SignalScale.of(_cut(name, pool, _rows(pool)), means)


def _driven(
    name: str, who: str, labels: int, seed: int, work: Path, scale: SignalScale, pool: list[Trajectory]
) -> dict[str, "np.ndarray[tuple[int, ...], np.dtype[np.float64]]"]:
    """Summed signals and success in unseen scenarios, of somebody's filter or the frozen policy."""
    file = work / (f"{name}-{who}.npz" if who == "reference" else f"{name}-{who}-{labels}-{seed}.npz")
    if not file.exists():
        started = time.perf_counter()
        task, policy = registry.task(name), simulation.reference_policy(name)
        act: Act = policy.mean
        if who != "reference":
            fit = FilterFit(
                name,
                AtHand(),
                lambda: None,
                _reward(name, labels, seed, _wants(name)[who], scale, pool),
                seed,
                FilterConfig(),
                lambda what, share: None,
                {},
                outcomes=OUTCOMES,
            )
            act = act_of(task.modes, policy, fit.keep_promise(fit.find_mode(Pool())).weights)
        seconds = time.perf_counter() - started
        driven = learning.run_scenarios(name, act, UNSEEN, 0.0, 0)
        with written_whole(file) as draft:
            np.savez(
                draft,
                signals=[each.signals.sum(axis=0, dtype=np.float64) for each in driven],
                success=[float(each.success) for each in driven],
                seconds=seconds,
            )
    with np.load(file, allow_pickle=False) as stored:
        return {each: stored[each] for each in stored.files}


def _reward(name: str, labels: int, seed: int, wants: FloatArray, scale: SignalScale, pool: list[Trajectory]) -> bytes:
    """Learned from so many answers, of which a tenth are mistakes."""
    steps = registry.installed_task(name).description.usual_clip_steps
    rewards = np.array([each.signals[:steps] / scale.spread @ wants for each in pool])
    rows, rng = _rows(pool), np.random.default_rng([seed, 7])
    teacher = ScriptedTeacher.calibrated(Manner(mistakes=MISTAKES, skip_share=0.0), rewards[rows])
    asked = rows[rng.choice(len(rows), labels, replace=False)]
    answers = [TARGETS[teacher.answer(rewards[left], rewards[right], rng)] for left, right in asked]
    stored, _ = learning.fit_reward(
        name, "structured", _cut(name, pool, asked), np.array(answers, np.float32), scale, seed
    )
    return stored


if __name__ == "__main__":
    main()
