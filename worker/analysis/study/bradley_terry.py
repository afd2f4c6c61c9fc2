"""Head-to-heads: Bradley-Terry strengths of the methods, with intervals and tests that count people and not answers.

P(a preferred to b) = 1 / (1 + exp(strength_b - strength_a)); strengths sum to zero (Bradley and Terry 1952, Biometrika
39, 324). An "equal" is half a win for each. The estimate is the maximum of that (quasi-)likelihood; its variance is
the sandwich over people (Liang and Zeger 1986), since answers of one person resemble each other, and for every
difference it is corrected for the people whom that difference rests on, with Satterthwaite's degrees of freedom (Bell
and McCaffrey 2002, Survey Methodology 28, 169): where everybody compares all, people - 1, and fewer in arms. What is
estimated is what holds for somebody drawn at random.

No finite strength fits where some methods were always preferred, and nothing scatters where all answered alike. There
two methods are compared by the share of wins of each person who met both: its mean with Wilson's interval, people being
the trials, and Wilcoxon's exact signed-rank test of how far it is from one half.
"""

from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Any

import numpy as np
from scipy import stats
from scipy.sparse.csgraph import connected_components

from worker.analysis.study.effect_sizes import holm
from worker.analysis.study.hypothesis_tests import not_computable, plain, signed_rank
from worker.analysis.wilson import wilson_interval
from worker.domain.type_aliases import FloatArray

FEWEST_PEOPLE = 4
"""Below, a variance over people says nothing."""
FEWEST_DEGREES = 2.0
"""Degrees of freedom below which a difference rests on too few people, though others have compared other methods."""
NO_SPREAD = 1e-9
"""Standard error up to which all people answered alike, so that nothing says how they scatter."""
_STEPS = 100


def head_to_head_report(answers: Sequence[Mapping[str, Any]], groups: Sequence[str]) -> dict[str, Any]:
    """``answers``: rows with participant, left, right (of ``groups``) and response, those that count.

    people, answers, equal, left (shares of the sides, ties apart); wins[row][column]: how often row was preferred to
    column, an equal as one half; strengths[] (group, strength, low, high, degrees_of_freedom), or ``not_computable``;
    comparisons[] (first, second, difference of strengths second minus first, low, high, degrees_of_freedom, the chance
    with its interval that second is preferred, p, p_holm, and ``test``: what the p is of, bradley_terry or wilcoxon).
    None for whatever too few people tell; without comparisons where fewer than FEWEST_PEOPLE have compared anything.
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
    if len(wins) < FEWEST_PEOPLE:
        who = "person has" if len(wins) == 1 else "people have"
        return report | not_computable(f"{len(wins)} {who} compared; {FEWEST_PEOPLE} are needed")
    compared = {"comparisons": [_named(groups, each) for each in comparisons(wins)]}
    if not fits(wins):
        reason = "some methods were always preferred to others, or never met them, so that no finite strength fits"
        return report | not_computable(reason) | compared
    return report | {"strengths": _estimated(wins, groups)} | compared


def fits(wins: FloatArray) -> bool:
    """Whether there are strengths: if no group of methods won everything against the rest (Ford 1957).

    ``wins``: (people, methods, methods).
    """
    return bool(connected_components(wins.sum(axis=0) > 0, connection="strong")[0] == 1)


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


def error_of(wins: FloatArray, found: FloatArray, contrast: FloatArray) -> tuple[float, float] | None:
    """Standard error of ``contrast @ found`` and its degrees of freedom; None where too few people tell.

    ``wins`` (people, methods, methods), ``contrast`` (methods,). By the model person g adds v_g to the variance, of
    which h_g cannot be seen, since the estimate follows their answers: what is seen is divided by 1 - h_g / v_g.
    """
    met, expected = wins + wins.transpose(0, 2, 1), _chances(found)
    information = np.stack([_information(each, expected) for each in met])
    bread = np.linalg.pinv(information.sum(axis=0))
    seen = (wins - met * expected).sum(axis=2) @ bread @ contrast
    parts = information @ bread @ contrast  # (people, methods)
    shared = parts @ bread @ parts.T
    alone = parts @ bread @ contrast
    tells = alone > NO_SPREAD * alone.sum()
    seen, shared, alone = seen[tells], shared[np.ix_(tells, tells)], alone[tells]
    left = alone - np.diag(shared)
    if (left < NO_SPREAD * alone).any():
        return None  # one person alone tells about it
    scale = np.sqrt(alone / left)
    model = scale[:, None] * (np.diag(alone) - shared) * scale
    degrees = float(np.trace(model) ** 2 / (model**2).sum())
    return None if degrees < FEWEST_DEGREES else (float(((scale * seen) ** 2).sum()) ** 0.5, degrees)


def comparisons(wins: FloatArray) -> list[dict[str, Any]]:
    """Every two methods, by their numbers; see head_to_head_report. ``wins``: (people, methods, methods)."""
    count = wins.shape[-1]
    found = strengths(wins.sum(axis=0)) if len(wins) >= FEWEST_PEOPLE and fits(wins) else None
    compared = []
    for first, second in combinations(range(count), 2):
        contrast = np.eye(count)[second] - np.eye(count)[first]
        told = None if found is None else _by_strengths(wins, found, contrast)
        if told is None or told["p"] is None:
            told = _by_shares(wins[:, first, second], wins[:, second, first], told)
        compared.append({"first": first, "second": second, **told})
    for each, corrected in zip(compared, holm([each["p"] for each in compared]), strict=True):
        each["p_holm"] = corrected
    return compared


def _chances(found: FloatArray) -> FloatArray:
    return np.asarray(1 / (1 + np.exp(found[None, :] - found[:, None])), np.float64)


def _information(met: FloatArray, expected: FloatArray) -> FloatArray:
    weights = met * expected * (1 - expected)
    return np.asarray(np.diag(weights.sum(axis=1)) - weights, np.float64)


def _estimated(wins: FloatArray, groups: Sequence[str]) -> list[dict[str, Any]]:
    found, count = strengths(wins.sum(axis=0)), len(groups)
    shown = []
    for i, group in enumerate(groups):
        strength = _between(float(found[i]), error_of(wins, found, np.eye(count)[i] - 1 / count))
        shown.append({"group": group, "strength": plain(found[i])} | strength)
    return shown


def _named(groups: Sequence[str], compared: Mapping[str, Any]) -> dict[str, Any]:
    return {**compared, "first": groups[compared["first"]], "second": groups[compared["second"]]}


def _between(estimate: float, error: tuple[float, float] | None) -> dict[str, Any]:
    """The interval; none where too few people tell, or where there is no spread."""
    if error is None or error[0] <= NO_SPREAD:
        return {"low": None, "high": None, "degrees_of_freedom": None}
    margin = float(stats.t.ppf(0.975, error[1])) * error[0]
    return {"low": estimate - margin, "high": estimate + margin, "degrees_of_freedom": error[1]}


def _by_strengths(wins: FloatArray, found: FloatArray, contrast: FloatArray) -> dict[str, Any]:
    """No p and no interval where there is no spread, or where too few people tell."""
    difference, error = float(contrast @ found), error_of(wins, found, contrast)
    told = {"difference": difference, **_between(difference, error)}
    told |= {
        name: None if end is None else float(1 / (1 + np.exp(-end)))
        for name, end in (("chance", difference), ("chance_low", told["low"]), ("chance_high", told["high"]))
    }
    if error is None or error[0] <= NO_SPREAD:
        return {**told, "p": None, "test": None}
    return {**told, "p": plain(2 * stats.t.sf(abs(difference / error[0]), error[1])), "test": "bradley_terry"}


def _by_shares(first: FloatArray, second: FloatArray, told: Mapping[str, Any] | None) -> dict[str, Any]:
    """By how often each person preferred which, (P,), (P,); ``told``: what strengths tell nevertheless."""
    met = first + second > 0
    shares, people = second[met] / (first + second)[met], int(met.sum())
    known = dict(told or dict.fromkeys(("difference", "low", "high", "degrees_of_freedom"))) | {"p": None, "test": None}
    if people < FEWEST_PEOPLE:
        return dict.fromkeys(("chance", "chance_low", "chance_high")) | known
    low, high = wilson_interval(float(shares.sum()), people)
    known |= {"chance": float(shares.mean()), "chance_low": low, "chance_high": high}
    beyond = (shares - 0.5).round(12)  # else thirds on either side would be no ties
    if not beyond.any():
        return known
    return known | {"p": signed_rank(beyond)[1], "test": "wilcoxon"}
