"""Who is in doubt: whose answers something richer explains, and what following it is worth, before any filter."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from tqdm import tqdm

from app.services.answers.accuracy import wilson
from app.services.answers.misfit import DOUBT
from tests.benchmarks.answered_pool import Answered, AnsweredPool
from tests.benchmarks.nonlinear_people import PEOPLE, Person, of_taste
from worker.compute import simulation
from worker.compute.population import prior_of
from worker.domain.trajectory import SIGNALS
from worker.domain.type_aliases import FloatArray
from worker.ml.methods.people import Labels
from worker.ml.rewards import reward_training
from worker.ml.rewards.beyond_sums import misfit
from worker.ml.rewards.beyond_sums.choice import fit_by_evidence
from worker.ml.rewards.reward_models import RewardModel
from worker.ml.teachers import random_taste

ANSWERS = 200
LOOKED_AFTER = (60, 100, ANSWERS)
"""answers; fewer are not looked at"""
LINEAR, SEED = "linear", 78
Row = Mapping[str, Any]


@dataclass(frozen=True)
class Kind:
    """People of one kind, each with the seed of their answers."""

    name: str
    people: Sequence[tuple[Person, int]]


def kinds(linear: int, of_a_kind: int) -> list[Kind]:
    """So many people drawn at random who are linear, and so many of each who is not."""
    drawn = Kind(LINEAR, [(_linear(number), 0) for number in range(linear)])
    return [
        drawn,
        *(Kind(name, [(person, seed) for seed in range(of_a_kind)]) for name, person in PEOPLE.items()),
    ]


def counted(pool: AnsweredPool, some: Sequence[Kind]) -> list[Row]:
    """By the number of answers: how many give more evidence than DOUBT, and what is foreseen of their wishes."""
    return [_counted(pool, each) for each in tqdm(some, unit="kind")]


def learned(pool: AnsweredPool, labels: Labels, seed: int, *, only_sums: bool = False) -> RewardModel:
    """As a study's worker learns it; or by weighted sums of signals in any case."""
    name, scale = pool.task.name, pool.scale
    known: dict[str, Any] = {
        "scale": scale,
        "prior": prior_of(name, scale.spread),
        "reference": simulation.reference_rollouts(name),
    }
    if only_sums:
        return reward_training.fit(labels.pairs, labels.targets, "structured", seed, **known).model
    scene = misfit.scene_of(pool.task.observation)
    return fit_by_evidence(labels.pairs, labels.targets, seed, signal_names=SIGNALS, scene=scene, **known).model


def table(rows: Sequence[Row]) -> str:
    """The counts with their intervals, and what is foreseen by sums, and by what is followed."""
    lines = [
        "| task | people | of | "
        + " | ".join(f"in doubt after {count} answers | foreseen" for count in LOOKED_AFTER)
        + " |",
        "|---" * (3 + 2 * len(LOOKED_AFTER)) + "|",
    ]
    for row in rows:
        said = " | ".join(f"{_share(row, count)} | {_foreseen(row, count)}" for count in LOOKED_AFTER)
        lines.append(f"| {row['task']} | {row['kind']} | {row['people']} | {said} |")
    return "\n".join(lines) + "\n"


def _share(row: Row, count: int) -> str:
    share = wilson(int(row[f"after_{count}"]), int(row["people"]))
    return f"{share.correct / share.scored:.0%} [{100 * share.low:.0f}, {100 * share.high:.0f}]"


def _foreseen(row: Row, count: int) -> str:
    sums, followed = row[f"sums_{count}"], row[f"followed_{count}"]
    return f"{float(sums):.1f}, {float(followed):.1f}" if sums != "" else "-"


def _linear(number: int) -> Person:
    taste = random_taste(f"{LINEAR}-{number}", np.random.default_rng([number, SEED]))
    return Person(taste.name, of_taste(taste))


def _counted(pool: AnsweredPool, kind: Kind) -> Row:
    row: dict[str, Any] = {"task": pool.task.name, "kind": kind.name, "people": len(kind.people)}
    answered = [(person, pool.answered(person, ANSWERS, seed), seed) for person, seed in kind.people]
    for count in LOOKED_AFTER:
        doubted = [each for each in answered if misfit.evidence(pool.ratios(each[1], count)) > DOUBT]
        found = np.array([_foreseen_of(pool, *each, count) for each in doubted])
        sums, followed = found.mean(axis=0).round(1) if len(found) else ("", "")
        row |= {f"after_{count}": len(doubted), f"sums_{count}": sums, f"followed_{count}": followed}
    return row


def _foreseen_of(pool: AnsweredPool, person: Person, answered: Answered, seed: int, count: int) -> tuple[float, float]:
    """What is foreseen by sums, and by what is followed: of all that this person has at stake in the pool's pairs by
    now, the share in pairs whose better clip is known, in %."""
    labels = Labels(pool.segments.take(answered.rows[:count]), answered.answers[:count])
    learn = partial(learned, pool, labels, seed)
    wished = _wished(pool, person, (count - 1) / (ANSWERS - 1))
    stakes = wished[pool.clip_pairs[:, 1]] - wished[pool.clip_pairs[:, 0]]
    sums, followed = (
        100.0 * np.abs(stakes[np.sign(model.logits(pool.segments).mean(axis=0)) == np.sign(stakes)]).sum()
        for model in (learn(only_sums=True), learn())
    )
    return sums / np.abs(stakes).sum(), followed / np.abs(stakes).sum()


def _wished(pool: AnsweredPool, person: Person, share: float) -> FloatArray:
    """(N,) what the pool's clips are worth after this share of all answers."""
    first, last = (
        np.array([wishes(pool.task, each)[: pool.clip_steps].sum() for each in pool.clips])
        for wishes in (person.wished_first or person.wishes, person.wishes)
    )
    return share * last + (1.0 - share) * first
