"""Instead of a filter: which of several policies suits a person, and how surely the answers say so.

Every policy is driven through the same held-out scenarios. Each member of the reward model, a sample of the posterior,
says what the person would have had of each; with the scenarios drawn anew (bootstrap), the share of draws in which a
policy is the best is the chance that it is. Policies that lose the task are not chosen.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from app.installed_tasks.lab import REFERENCE
from worker.domain.trajectory import Trajectory
from worker.domain.type_aliases import FloatArray
from worker.ml.filters.exported.filter_module import FilterWeights
from worker.ml.filters.fitting.filter_draft import FilterDraft, GateTrial
from worker.ml.filters.fitting.filter_problem import FilterProblem
from worker.ml.filters.fitting.gate import keeps_task, trial_of
from worker.ml.rewards.reward_models import RewardModel

DRAWS = 4000
SURE = 0.9
"""Chance of being the best from which a choice is called clear."""


def choose(
    problem: FilterProblem, reference: Sequence[Trajectory], others: Mapping[str, Sequence[Trajectory]]
) -> FilterDraft:
    """The policy with the largest expected return of those that keep the task; the frozen one wins ties.

    ``reference`` and ``others``, by the policies' names: rollouts of the same N scenarios.
    """
    started = time.perf_counter()
    trials = {name: trial_of(problem, 1.0, 0.0, reference, driven) for name, driven in others.items()}
    kept = [name for name, trial in trials.items() if keeps_task(problem, trial, reference)]
    before = _returns(problem.reward, reference)
    gains = np.array([np.zeros_like(before), *(_returns(problem.reward, others[name]) - before for name in kept)])
    names = (REFERENCE, *kept)
    chosen = names[int(np.argmax(gains.mean(axis=(1, 2))))]
    chances = dict.fromkeys((REFERENCE, *others), 0.0) | dict(
        zip(names, chances_of_best(gains, np.random.default_rng([problem.seed, 24])), strict=True)
    )
    notes = [
        f"The policy {name} was not chosen from: success changes by {100 * trials[name].success_change:+.0f} points on "
        "held-out scenarios, or forces grow."
        for name in others
        if name not in kept
    ]
    if chances[chosen] < SURE:
        notes.append(f"The answers do not clearly say which policy suits this person best: {in_words(chances)}.")
    mode = problem.task.modes.named(problem.task.modes.reference)
    weights = FilterWeights(mode=mode if chosen == REFERENCE else {**mode, chosen: 1.0})
    ordered = [trial for name, trial in trials.items() if name != chosen]
    last: list[GateTrial] = [] if chosen == REFERENCE else [trials[chosen]]
    choice = {name: round(each, 3) for name, each in chances.items()}
    draft = FilterDraft(weights, trials=(*ordered, *last), notes=tuple(notes))
    return replace(draft, choice=choice).timed("mode", started)


def chances_of_best(gains: FloatArray, rng: np.random.Generator) -> list[float]:
    """(K, E, N) what K policies gain for E members in N scenarios -> the chance that each is the best, (K,)."""
    _, members, scenarios = gains.shape
    drawn = rng.integers(scenarios, size=(DRAWS, scenarios))
    member = rng.integers(members, size=DRAWS)
    means = gains[:, member[:, None], drawn].mean(axis=-1)
    best = np.argmax(means, axis=0)
    return [float(each) for each in np.bincount(best, minlength=len(gains)) / DRAWS]


def in_words(chances: Mapping[str, float]) -> str:
    """Chances in percent, the largest first."""
    return ", ".join(f"{name} {chance:.0%}" for name, chance in sorted(chances.items(), key=lambda each: -each[1]))


def _returns(reward: RewardModel, trajectories: Sequence[Trajectory]) -> FloatArray:
    """(E, N) as answers are explained by them: neither normalised nor cut step by step.

    Limits on what a step or a signal may earn keep an optimiser from what nobody has seen; of these policies everybody
    has seen all, and with the limits a quick one came out level with a slow one for somebody who minds speed.
    """
    return np.array(
        [
            reward.raw_rewards(each.signals, each.observations[: len(each)], each.actions).sum(axis=-1)
            for each in trajectories
        ]
    ).T
