"""From which disagreement on do 30 answers tell people apart? For docs/results/disagreement.md.

    python -m tests.benchmarks.disagreement feeding drinking scratching reach reacher

``LAB_TASKS`` names the folders of the two examples, and reacher's policy server has to be there. A cell is a task with
its modes shortened to a share of their way. It is written when it is done: an interrupted run goes on where it was.
"""

import argparse
import csv
import sys
from pathlib import Path

import numpy as np
from scipy.optimize import minimize

from worker.compute import simulation
from worker.domain.task import Task
from worker.domain.type_aliases import FloatArray
from worker.experiments import disagreement
from worker.experiments.disagreement import Differences
from worker.tasks import registry

SHARES = (1.0, 0.25, 0.1, 0.05, 0.02, 0.005)
SCENARIOS, HELD_OUT_SHARE = 24, 1 / 3
PEOPLE, LABELS, RIDGE = 60, 30, 1.0
FILE = Path("docs/results/disagreement.csv")
COLUMNS = ("task", "share", "excess", "own", "other", "own_better")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("tasks", nargs="+")
    parser.add_argument("--shares", nargs="+", type=float, default=SHARES)
    parser.add_argument("--scenarios", type=int, default=SCENARIOS)
    parser.add_argument("--file", type=Path, default=FILE)
    said = parser.parse_args()
    done = set()
    if said.file.exists():
        with said.file.open() as stored:
            done = {(row["task"], float(row["share"])) for row in csv.DictReader(stored)}
    for name in said.tasks:
        for share in said.shares:
            if (name, share) not in done:
                row = cell(name, share, said.scenarios)
                with said.file.open("a", newline="") as target:
                    writer = csv.writer(target, lineterminator="\n")
                    if target.tell() == 0:
                        writer.writerow(COLUMNS)
                    writer.writerow(row)
                sys.stdout.write(f"{row}\n")
                sys.stdout.flush()


def cell(name: str, share: float, scenarios: int) -> tuple[object, ...]:
    """One task with its modes shortened to a share: how much people disagree, and what that is worth."""
    task = registry.task(name)
    found = disagreement.measured(
        task,
        lambda policy: simulation.reference_policy(name, policy).mean,
        lambda act, scenario: simulation.run_episode(name, act, scenario),
        registry.installed_task(name).description.usual_clip_steps,
        scenarios,
        share,
    )
    own, other, better = worth(found, task)
    excess = disagreement.excess(found, task)
    return (name, share, round(excess, 3), round(own, 3), round(other, 3), round(better, 3))


def worth(found: Differences, task: Task) -> tuple[float, float, float]:
    """Share of held-out pairs on which one's own model, and another's, says what one truly wants (a model: 30 answers);
    and the share of people whom their own serves better than the others' do on average."""
    rng = np.random.default_rng(6)
    wants = disagreement.people(task, PEOPLE, rng)
    said = disagreement.answers(found, wants)
    pairs, _ = disagreement.scaled(found)
    scenarios = np.unique(found.scenarios)
    test = np.isin(found.scenarios, scenarios[-round(HELD_OUT_SHARE * len(scenarios)) :])
    truth = np.sign(pairs[test] @ wants.T)
    models = np.array([_learned(pairs[~test], each[~test], rng) for each in said])
    right = np.array([(np.sign(pairs[test] @ model)[:, None] == truth).mean(axis=0) for model in models])
    own = np.diag(right)
    others = (right.sum(axis=0) - own) / (PEOPLE - 1)
    return float(own.mean()), float(others.mean()), float((own > others).mean())


def _learned(pairs: FloatArray, probabilities: FloatArray, rng: np.random.Generator) -> FloatArray:
    """(S,) by logistic regression with a ridge, from LABELS answers."""
    asked = rng.choice(len(pairs), LABELS, replace=False)
    seen = pairs[asked]
    sign = np.where(rng.random(LABELS) < probabilities[asked], 1.0, -1.0)

    def loss(weights: FloatArray) -> float:
        return float(np.logaddexp(0.0, -sign * (seen @ weights)).sum() + 0.5 * RIDGE * weights @ weights)

    fitted: FloatArray = minimize(loss, np.zeros(pairs.shape[1]), method="L-BFGS-B").x
    return fitted


if __name__ == "__main__":
    main()
