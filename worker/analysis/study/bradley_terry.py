"""Head-to-heads: Bradley-Terry strengths of the methods, with intervals and tests that count people and not answers.

P(a preferred to b) = 1 / (1 + exp(strength_b - strength_a)); strengths sum to zero (Bradley and Terry 1952, Biometrika
39, 324). An "equal" is half a win for each. The estimate is the maximum of that (quasi-)likelihood; its covariance is
the sandwich over people (Liang and Zeger 1986), times G / (G - 1), with a t of people - 1 degrees of freedom, since
answers of one person resemble each other. What is estimated is what holds for somebody drawn at random.
"""

from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Any

import numpy as np
from scipy import stats
from scipy.sparse.csgraph import connected_components

from worker.analysis.study.effect_sizes import holm
from worker.analysis.study.hypothesis_tests import not_computable, plain
from worker.domain.type_aliases import FloatArray

FEWEST_PEOPLE = 4
"""Below, a covariance over people says nothing."""
NO_SPREAD = 1e-9
"""Standard error up to which all people answered alike, so that nothing says how they scatter."""
_STEPS = 100


def head_to_head_report(answers: Sequence[Mapping[str, Any]], groups: Sequence[str]) -> dict[str, Any]:
    """``answers``: rows with participant, left, right (of ``groups``) and response, those that count.

    people, answers, equal, left (shares of the sides, ties apart); wins[row][column]: how often row was preferred to
    column, an equal as one half; strengths[] (group, strength, low, high) and comparisons[] (first, second, difference
    of strengths second minus first, low, high, p, p_holm, and the chance with its interval that second is preferred),
    or ``not_computable``.
    """
    rows = [each for each in answers if each["left"] in groups and each["right"] in groups]
    people = list(dict.fromkeys(each["participant"] for each in rows))
    wins = np.zeros((len(people), len(groups), len(groups)))
    for each in rows:
        left, right = groups.index(each["left"]), groups.index(each["right"])
        share = {"left": 1.0, "equal": 0.5, "right": 0.0}[each["response"]]
        wins[people.index(each["participant"]), left, right] += share
        wins[people.index(each["participant"]), right, left] += 1 - share
    said = [each["response"] for each in rows]
    report: dict[str, Any] = {
        "people": len(people),
        "answers": len(rows),
        "equal": said.count("equal"),
        "left": said.count("left"),
        "right": said.count("right"),
        "groups": list(groups),
        "wins": wins.sum(axis=0).tolist(),
    }
    reason = why_not(wins)
    return report | (not_computable(reason) if reason else _estimated(wins, groups))


def why_not(wins: FloatArray) -> str | None:
    """Why there are no strengths, in words; None where there are. ``wins``: (people, methods, methods).

    They exist if no group of methods won everything against the rest (Ford 1957).
    """
    if len(wins) < FEWEST_PEOPLE:
        return f"{len(wins)} {'person has' if len(wins) == 1 else 'people have'} compared; {FEWEST_PEOPLE} are needed"
    if connected_components(wins.sum(axis=0) > 0, connection="strong")[0] > 1:
        return "some methods were always preferred to others, or never met them, so that no finite strength fits"
    return None


def strengths(wins: FloatArray) -> FloatArray:
    """The estimate, (methods,), summing to zero. ``wins`` (methods, methods); see why_not for when it exists."""
    met, found = wins + wins.T, np.zeros(len(wins))
    for _ in range(_STEPS):
        expected = _chances(found)
        score = (wins - met * expected).sum(axis=1)
        step = np.linalg.pinv(_information(met, expected)) @ score
        found += step / max(1.0, float(np.abs(step).max()))
        if np.abs(step).max() < 1e-10:
            break
    return np.asarray(found - found.mean(), np.float64)


def covariance(wins: FloatArray, found: FloatArray) -> FloatArray:
    """Of the strengths, (methods, methods): the sandwich over people. ``wins`` (people, methods, methods)."""
    met, expected, count = wins + wins.transpose(0, 2, 1), _chances(found), len(wins)
    scores = (wins - met * expected).sum(axis=2)
    bread = np.linalg.pinv(_information(met.sum(axis=0), expected))
    return np.asarray(count / (count - 1) * bread @ (scores.T @ scores) @ bread, np.float64)


def _chances(found: FloatArray) -> FloatArray:
    return np.asarray(1 / (1 + np.exp(found[None, :] - found[:, None])), np.float64)


def _information(met: FloatArray, expected: FloatArray) -> FloatArray:
    weights = met * expected * (1 - expected)
    return np.asarray(np.diag(weights.sum(axis=1)) - weights, np.float64)


def _estimated(wins: FloatArray, groups: Sequence[str]) -> dict[str, Any]:
    found = strengths(wins.sum(axis=0))
    spread = covariance(wins, found)
    t = float(stats.t.ppf(0.975, len(wins) - 1))
    margins = t * np.sqrt(np.maximum(np.diag(spread), 0.0))  # which rounding can leave below a variance of 0
    comparisons = []
    for first, second in combinations(range(len(groups)), 2):
        difference = float(found[second] - found[first])
        error = float(max(spread[first, first] + spread[second, second] - 2 * spread[first, second], 0.0)) ** 0.5
        comparisons.append(_compared(groups[first], groups[second], difference, error, len(wins) - 1))
    for each, corrected in zip(comparisons, holm([each["p"] for each in comparisons]), strict=True):
        each["p_holm"] = corrected
    return {
        "strengths": [
            {
                "group": group,
                "strength": plain(found[i]),
                "low": plain(found[i] - margins[i]),
                "high": plain(found[i] + margins[i]),
            }
            for i, group in enumerate(groups)
        ],
        "comparisons": comparisons,
    }


def _compared(first: str, second: str, difference: float, error: float, degrees_of_freedom: int) -> dict[str, Any]:
    """No p and no interval where there is no spread."""
    compared: dict[str, Any] = {"first": first, "second": second, "difference": difference}
    compared["chance"] = float(1 / (1 + np.exp(-difference)))
    compared |= dict.fromkeys(("low", "high", "chance_low", "chance_high", "p"))
    if error > NO_SPREAD:
        margin = float(stats.t.ppf(0.975, degrees_of_freedom)) * error
        compared["low"], compared["high"] = difference - margin, difference + margin
        compared["chance_low"], compared["chance_high"] = (
            float(1 / (1 + np.exp(-end))) for end in (difference - margin, difference + margin)
        )
        compared["p"] = plain(2 * stats.t.sf(abs(difference / error), degrees_of_freedom))
    return compared
