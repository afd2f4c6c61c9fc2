"""Do behaviours of a task differ enough for people to disagree, before anybody is invited?

People and their answers are Thurstone's (1927, case V): somebody drawn at random weighs what is measured, and prefers
the clip with the larger sum with the probability Phi(difference / noise). The noise is measured, not guessed: what a
slight tremor on top of the same behaviours changes in the sums. Two people then judge differently more often than one
of them asked twice by E[(p - q)^2], which is 0 where nothing differs beyond the noise and where all want the same, and
0.5 where every second pair divides people who are sure.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import sqrt
from statistics import NormalDist

import numpy as np

from worker.compute.behaviours import SlowWaves, draw_behaviours
from worker.domain.lab_modes import PolicyChoice
from worker.domain.scenarios import POOL
from worker.domain.task import Task
from worker.domain.trajectory import Trajectory
from worker.domain.type_aliases import Act, Float32Array, FloatArray
from worker.ml.acquisition import matched_pairs
from worker.ml.rewards.reward_models import NEVER_WANTED

FIRST_SCENARIO = POOL.start + 800_000
SCENARIOS, PER_SCENARIO, PEOPLE = 12, 4, 200
TREMOR = 0.1
"""Of the noise, as a share of the root mean square of the frozen policy's actions."""
FARTHEST = 5.0
"""Differences are cut at so many times their usual size: one broken clip must not decide."""
ENOUGH = 0.10
"""Above it people told apart by 30 answers are served better by their own model (docs/results/disagreement.md)."""

Episode = Callable[[Act, int], Trajectory]


@dataclass(frozen=True)
class Differences:
    """What pairs of a pool differ in, M pairs of clips of the same scenario."""

    scenarios: FloatArray
    """(M,)"""
    pairs: FloatArray
    """(M, S) right minus left of the signals summed over a clip"""
    noise: FloatArray
    """(N, S) what a tremor changes in the same behaviours"""


def measured(
    task: Task,
    policy_named: Callable[[str], Act],
    episode: Episode,
    shown_steps: int,
    scenarios: int | None = None,
    share: float = 1.0,
) -> Differences:
    """Run the pool's modes, and one of each scenario with a tremor.

    Args:
        task: its modes and signals.
        policy_named: a policy among several; the empty name is the frozen one's.
        episode: runs a whole episode of a scenario.
        shown_steps: of a clip, from the start.
        scenarios: five episodes each.
        share: of every mode's way from the reference policy, for measuring what less difference does.
    """
    last = FIRST_SCENARIO + (SCENARIOS if scenarios is None else scenarios)
    frozen = episode(policy_named(""), FIRST_SCENARIO)
    tremor = TREMOR * sqrt(float(np.square(frozen.actions, dtype=np.float64).mean()))
    sums, of_scenario, noise = list[FloatArray](), list[int](), list[FloatArray]()
    for scenario in range(FIRST_SCENARIO, last):
        drawn = draw_behaviours(task, scenario, per_scenario(task), sampled=False)
        for number, behaviour in enumerate(drawn):
            mode = (share * np.array(task.modes.vector(behaviour.mode))).astype(np.float32)
            mean = policy_named(task.modes.policy(mode))
            done = episode(_in_mode(task, mean, mode), scenario)
            sums.append(_sums(done, shown_steps))
            of_scenario.append(scenario)
            if number == scenario % len(drawn):
                waves = SlowWaves(tremor, np.random.default_rng([scenario, 4]), done.actions.shape[1])
                again = episode(_in_mode(task, mean, mode, waves), scenario)
                noise.append(_sums(again, shown_steps) - sums[-1])
    rows = matched_pairs(of_scenario)
    clips = np.array(sums)
    return Differences(np.array(of_scenario)[rows[:, 0]], clips[rows[:, 1]] - clips[rows[:, 0]], np.array(noise))


def per_scenario(task: Task) -> int:
    """Behaviours of each scenario: where one of few policies is chosen there are no more."""
    return min(PER_SCENARIO, len(task.modes.axes) + 1) if isinstance(task.modes, PolicyChoice) else PER_SCENARIO


def people(task: Task, count: int, rng: np.random.Generator) -> FloatArray:
    """(count, S) How much each wants of every signal, in units of its usual difference; harm and delay by nobody."""
    weights = rng.standard_normal((count, len(task.signals)))
    minded = [name in (*NEVER_WANTED, *task.costs) for name in task.signals]
    wants: FloatArray = np.where(minded, -np.abs(weights), weights)
    return wants


def answers(found: Differences, wants: FloatArray) -> FloatArray:
    """(P, S) -> (P, M) probability that each prefers the right clip."""
    pairs, noise = scaled(found)
    doubt = np.sqrt(((noise @ wants.T) ** 2).mean(axis=0))
    certain = (pairs @ wants.T) / np.maximum(doubt, 1e-9)
    phi = np.vectorize(NormalDist().cdf, otypes=[np.float64])
    probabilities: FloatArray = phi(certain).T
    return probabilities


def scaled(found: Differences) -> tuple[FloatArray, FloatArray]:
    """Pairs (M, S) and noise (N, S) in units of what pairs usually differ by; 0 where they never do."""
    usual = np.sqrt((found.pairs**2).mean(axis=0))
    unit = np.where(usual > 1e-9, usual, np.inf)
    return np.clip(found.pairs / unit, -FARTHEST, FARTHEST), np.clip(found.noise / unit, -FARTHEST, FARTHEST)


def excess(found: Differences, task: Task) -> float:
    """E[(p - q)^2] over pairs of clips and of people, in [0, 0.5]."""
    said = answers(found, people(task, PEOPLE, np.random.default_rng(5)))
    return float(2.0 * said.var(axis=0, ddof=1).mean())


def beyond_noise(found: Differences) -> FloatArray:
    """(S,) Usual difference of a pair in units of the usual change by a tremor; 0 where nothing differs."""
    pairs, noise = (np.sqrt((each**2).mean(axis=0)) for each in (found.pairs, found.noise))
    ratio: FloatArray = np.where(pairs > 1e-9, pairs / np.maximum(noise, 1e-9), 0.0)
    return ratio


def in_words(found: Differences, task: Task) -> tuple[str, ...]:
    """What an experimenter should know before anybody is invited."""
    share = excess(found, task)
    clear = beyond_noise(found)
    lost = [name for name, ratio in zip(task.signals, clear, strict=True) if ratio < 1.0]
    said = [
        f"Of 100 pairs of clips, two people who want different things judge {100 * share:.0f} more differently than "
        f"one person asked twice; {100 * ENOUGH:.0f} are needed."
    ]
    if share < ENOUGH:
        said.append(
            "Behaviours are too alike, or everybody would want the same: do not invite people yet. "
            + ("Take policies that differ more, " if isinstance(task.modes, PolicyChoice) else "Lower policy.gain, ")
            + "show longer clips, or declare signals that some like and others do not (height, side, distance), then "
            "explore again."
        )
    if lost:
        said.append(f"Differ less between behaviours than a slight tremor changes them: {', '.join(lost)}.")
    return tuple(said)


def _in_mode(task: Task, mean: Act, mode: Float32Array, waves: SlowWaves | None = None) -> Act:
    def act(observation: Float32Array) -> Float32Array:
        action: Float32Array = task.modes.executed(observation, mode, mean(task.modes.perceived(observation, mode)))
        return action if waves is None else action + waves()

    return act


def _sums(done: Trajectory, steps: int) -> FloatArray:
    sums: FloatArray = done.signals[:steps].sum(axis=0, dtype=np.float64)
    return sums
