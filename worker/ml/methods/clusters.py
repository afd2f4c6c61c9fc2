"""K kinds of people instead of individuals: PREC (openreview yoBtqiFZdi) doubts that individual policies are reliable.

Other people's reward models are clustered by the direction of their weights (k-means), a model is learned from all the
answers of each cluster, and a new person's answers only say which of them is theirs. With one cluster it is the average
person, and the own answers count for nothing.
"""

from collections.abc import Sequence

import numpy as np
from scipy.cluster.vq import kmeans2

from worker.domain.type_aliases import FloatArray
from worker.ml.methods.people import Labels, Person
from worker.ml.rewards.reward_models import RewardModel
from worker.ml.rewards.segments import SegmentPairs

FEWEST = 1e-3
"""Nobody's answer is held for less likely than this: they slip."""


def nearest(person: Person, people: int, labels: int, count: int, seed: int) -> tuple[RewardModel, tuple[str, ...]]:
    """The model of the cluster under which the person's own answers are most likely."""
    others = person.others(people, labels)
    if count == 1:
        return person.fit(_joined(others)), (f"All {people} others together.",)
    kinds = _kinds([person.fit(each) for each in others], person.scale.spread, count, seed)
    members = [
        [each for each, kind in zip(others, kinds, strict=True) if kind == index] for index in sorted(set(kinds))
    ]
    models = [person.fit(_joined(each)) for each in members]
    said = [_log_likelihood(each, person.labels) for each in models]
    chosen = int(np.argmax(said))
    sizes = ", ".join(str(len(each)) for each in members)
    return models[chosen], (f"Clusters of {sizes} others; nearest: number {chosen + 1}.",)


def _kinds(models: Sequence[RewardModel], spread: FloatArray, count: int, seed: int) -> list[int]:
    """One cluster's number per model."""
    weights = np.array([each.signal_weights(()).mean(axis=0) * spread for each in models])
    directions = weights / np.maximum(np.linalg.norm(weights, axis=1, keepdims=True), 1e-9)
    _, kinds = kmeans2(directions, count, minit="++", rng=np.random.default_rng(seed))
    return [int(each) for each in kinds]


def _log_likelihood(model: RewardModel, labels: Labels) -> float:
    right = np.clip(model.probability_right(labels.pairs), FEWEST, 1.0 - FEWEST)
    return float((labels.targets * np.log(right) + (1.0 - labels.targets) * np.log(1.0 - right)).sum())


def _joined(labels: Sequence[Labels]) -> Labels:
    """Everybody's answers as one person's."""
    pairs = [each.pairs for each in labels]
    together = SegmentPairs(
        np.concatenate([each.signals for each in pairs]),
        np.concatenate([each.observations for each in pairs]),
        np.concatenate([each.actions for each in pairs]),
    )
    return Labels(together, np.concatenate([each.targets for each in labels]))
