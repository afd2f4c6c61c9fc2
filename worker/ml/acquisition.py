"""Which pair to show next: pure functions on arrays, every choice with the probability it had.

Random choice measures accuracy without bias. Greedy rules chase outliers; drawn with a random share, entropy, the
default, needs fewer labels from about a hundred on (docs/results/feedback_efficiency.md). Whatever the rule, a
share of the choices stays random, so that every pair keeps a positive propensity and estimates made from the labels can
be corrected for how the pairs were chosen.

Every rule but the uniform one is a score of each candidate, made here from predicted probabilities; choose() turns any
score into chances.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from worker.domain.type_aliases import FloatArray

Strategy = Literal["uniform", "disagreement", "entropy", "information_gain", "contested"]
Indices = npt.NDArray[np.int64]

RANDOM_SHARE = 0.3
SHARPNESS = 4.0
"""Probability proportional to exp(SHARPNESS * standardised score). Greedy choices repeat themselves."""
STAND_IN_RATIONALITY = 2.0
"""Log odds of a stand-in's answer per root mean square difference of the returns of a pair."""

AT_RANDOM, FOLLOWING = 0, 2
"""How one pair was drawn; between them: by the rule."""


@dataclass(frozen=True)
class Choice:
    """The chosen candidates in the order in which they should be shown."""

    indices: Indices
    """(K,) rows of the candidates"""
    propensities: FloatArray
    """(K,) probability of each choice at the moment it was made, given the choices before it"""
    swapped: npt.NDArray[np.bool_]
    """(K,) True: the candidate's second clip goes to the left"""
    at_random: npt.NDArray[np.bool_]
    """(K,) True: drawn uniformly, whatever the rule: answers to these measure a model without bias"""
    following: npt.NDArray[np.bool_]
    """(K,) True: made for the person; its index is ``candidates`` at least"""


def matched_pairs(scenarios: npt.ArrayLike, behaviours: npt.ArrayLike | None = None) -> Indices:
    """Every pair of clips of the same scenario, (M, 2) rows into the clips; with ``behaviours`` only differing ones."""
    scenario = np.asarray(scenarios)
    first, second = np.triu_indices(len(scenario), k=1)
    keep = scenario[first] == scenario[second]
    if behaviours is not None:
        behaviour = np.asarray(behaviours)
        keep &= behaviour[first] != behaviour[second]
    return np.stack([first[keep], second[keep]], axis=1).astype(np.int64)


def disagreement(member_probabilities: FloatArray) -> FloatArray:
    """(E, M) P(right) under every member -> (M,) their standard deviation."""
    spread: FloatArray = member_probabilities.std(axis=0)
    return spread


def entropy(member_probabilities: FloatArray) -> FloatArray:
    """(E, M) P(right) under every member -> (M,) nats: how open the answer is, whatever the reason."""
    return _binary_entropy(member_probabilities.mean(axis=0))


def information_gain(member_probabilities: FloatArray) -> FloatArray:
    """(E, M) P(right) under every member -> (M,) nats: what an answer says about which member is right (BALD).

    Entropy of the mean minus mean of the entropies (Houlsby et al. 2011): members that are each sure of different
    answers count, members that are all unsure do not.
    """
    doubt_of_each: FloatArray = _binary_entropy(member_probabilities).mean(axis=0)
    return _binary_entropy(member_probabilities.mean(axis=0)) - doubt_of_each


def score(rule: str, member_probabilities: FloatArray) -> FloatArray:
    """(E, M) P(right) under every member of one's own model -> (M,) by a rule that needs nothing else."""
    own = {"disagreement": disagreement, "entropy": entropy, "information_gain": information_gain}
    if rule not in own:
        raise ValueError(f"The rule {rule!r} is no function of one's own model alone.")
    return own[rule](member_probabilities)


def contested(others_probabilities: FloatArray, member_probabilities: FloatArray | None = None) -> FloatArray:
    """(U, M) P(right) under U other people's models, U at least 2 -> (M,) their standard deviation.

    Such pairs tell people apart; pairs on which everybody is unsure do not. With the members of one's own model (E, M):
    times how open one's own answer still is, 1 for a toss-up, since others go on disagreeing about what has been said.
    Raises ValueError for fewer than two others.
    """
    if len(others_probabilities) < 2:
        raise ValueError("Two other people at least are needed to disagree.")
    apart = disagreement(others_probabilities)
    return apart if member_probabilities is None else apart * entropy(member_probabilities) / np.log(2.0)


def expected_answers(return_differences: FloatArray) -> FloatArray:
    """(U, M) right minus left return of U stand-ins with known tastes -> (U, M) P(right), each in their own unit."""
    unit = np.maximum(np.sqrt((return_differences**2).mean(axis=1, keepdims=True)), 1e-9)
    probabilities: FloatArray = 0.5 * (1.0 + np.tanh(0.5 * STAND_IN_RATIONALITY * return_differences / unit))
    return probabilities


def _binary_entropy(probability: FloatArray) -> FloatArray:
    sure = np.clip(probability, 1e-12, 1.0 - 1e-12)
    nats: FloatArray = -(sure * np.log(sure) + (1.0 - sure) * np.log(1.0 - sure))
    return nats


def choose(
    count: int,
    candidates: int,
    rng: np.random.Generator,
    *,
    rule: Strategy = "uniform",
    scores: FloatArray | None = None,
    random_share: float = RANDOM_SHARE,
    made: int = 0,
    following_share: float = 0.0,
) -> Choice:
    """Draw up to ``count`` of ``candidates`` pairs without replacement and put them on sides.

    ``scores`` (candidates,): needed by rules other than uniform; higher is more worth asking. ``made``: so many pairs
    that were made for the person stand after the candidates; as long as there are some, ``following_share`` of what is
    drawn is one of them, whatever the rule, and nothing else is.
    Raises ValueError when scores are missing, random_share is not in (0, 1], or the two shares exceed 1.
    """
    if not 0.0 < random_share <= 1.0:
        raise ValueError("random_share must lie in (0, 1]: a share of the choices always stays random.")
    if not 0.0 <= following_share <= 1.0 - random_share + 1e-9:
        raise ValueError("following_share must lie in [0, 1 - random_share].")
    if rule != "uniform" and (scores is None or np.shape(scores) != (candidates,)):
        raise ValueError(f"The rule {rule!r} needs one score per candidate.")
    alike, of_rule = np.zeros(candidates + made), np.zeros(candidates + made)
    if scores is not None and rule != "uniform":
        of_rule[:candidates] = _standardised(scores)
    count = min(count, candidates)
    remaining, is_made = np.ones(candidates + made, bool), np.arange(candidates + made) >= candidates
    indices, propensities = np.zeros(count, np.int64), np.zeros(count)
    kinds = np.zeros(count, np.int64)
    lots = rng.random(count) if rule != "uniform" or following_share > 0.0 else np.zeros(count)
    for turn in range(count):
        usual, own = remaining & ~is_made, remaining & is_made
        share = following_share if own.any() else 0.0
        drawn_at_random = 1.0 - share if rule == "uniform" else random_share
        shares = np.array([drawn_at_random, max(0.0, 1.0 - drawn_at_random - share), share])
        chances = np.stack([_chances(alike, usual), _chances(of_rule, usual), _chances(alike, own)])
        kinds[turn] = int(lots[turn] >= drawn_at_random) + int(lots[turn] >= 1.0 - share)
        indices[turn] = rng.choice(len(remaining), p=chances[kinds[turn]])
        propensities[turn] = shares @ chances[:, indices[turn]]
        remaining[indices[turn]] = False
    return Choice(indices, propensities, balanced_sides(count, rng), kinds == AT_RANDOM, kinds == FOLLOWING)


def balanced_sides(count: int, rng: np.random.Generator) -> npt.NDArray[np.bool_]:
    """Which pairs to swap: exactly half of them (up to an odd one), in random order."""
    swapped = np.arange(count) < (count + int(rng.integers(2))) // 2
    shuffled: npt.NDArray[np.bool_] = rng.permutation(swapped)
    return shuffled


def _standardised(scores: FloatArray) -> FloatArray:
    """Mean 0 and deviation 1."""
    spread = float(np.std(scores))
    standardised: FloatArray = (scores - np.mean(scores)) / (spread if spread > 0.0 else 1.0)
    return standardised


def _chances(preference: FloatArray, among: npt.NDArray[np.bool_]) -> FloatArray:
    """(M,) of a draw among some, the preferred ones more often; all 0 where there are none."""
    pull = np.where(among, SHARPNESS * preference, -np.inf)
    sharp = np.exp(pull - pull.max()) if among.any() else np.zeros(len(pull))
    chances: FloatArray = sharp / max(sharp.sum(), 1.0)
    return chances
