"""What standard questionnaires say: every score with its interval and reliability, per robot where they are about one.

Input: a row per questionnaire, ``name``, ``title``, ``measures``, ``scores`` (each name, title, lowest, highest and
items) and ``filled_in``: rows of participant, group (method or letter; None: about no robot), scores and items by name,
reversed ones mirrored, None where there is no score.

What ``scale_reports`` returns, which is ``contents["instruments"]`` of a Report: per questionnaire its words, and
``parts``: one for those about no robot, one for those about robots; each with groups and, per score, the means, people
and comparisons of worker.analysis.study.statistics and a ``reliability`` per group.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from worker.analysis.study.reliability import reliability_report
from worker.analysis.study.statistics import scale_report

TESTS = ("paired_t", "wilcoxon")
"""Shown of the differences between robots; one score per person and robot leaves the others nothing to add."""
BETWEEN_TESTS = ("welch_t", "permutation")
"""Likewise, of people who met one of the two; the study's bound of equivalence is in points of its ratings."""
NO_ROBOT = ""
"""The group of questionnaires that are about none."""


def scale_reports(
    instruments: Sequence[Mapping[str, Any]], groups: Sequence[str], *, compare: bool, between: bool = False
) -> list[dict[str, Any]]:
    """``groups``: robots in their order. ``compare``: False while a letter is another method for every participant.

    ``between``: with the tests of people who met different robots.
    """
    return [_of_instrument(each, groups, compare, BETWEEN_TESTS if between else ()) for each in instruments]


def _of_instrument(
    instrument: Mapping[str, Any], groups: Sequence[str], compare: bool, between: Sequence[str]
) -> dict[str, Any]:
    rows = instrument["filled_in"]
    about_none = [each for each in rows if each["group"] is None]
    about_robots = [each for each in rows if each["group"] in groups]
    parts = []
    if about_none:
        parts.append(_part(instrument, [{**each, "group": NO_ROBOT} for each in about_none], [NO_ROBOT], False, ()))
    if about_robots:
        parts.append(_part(instrument, about_robots, groups, compare, between))
    return {name: instrument[name] for name in ("name", "title", "measures")} | {"parts": parts}


def _part(
    instrument: Mapping[str, Any],
    rows: Sequence[Mapping[str, Any]],
    groups: Sequence[str],
    compare: bool,
    between: Sequence[str],
) -> dict[str, Any]:
    scores = []
    for score in instrument["scores"]:
        scored = [each for each in rows if each["scores"][score["name"]] is not None]
        values = [(each["participant"], each["group"], each["scores"][score["name"]]) for each in scored]
        frame = pd.DataFrame(values, columns=["participant", "group", "score"])
        possible = float(score["lowest"]), float(score["highest"])
        found = scale_report(frame, "score", "group", groups, compare, possible, between, TESTS)
        answered = {
            group: [[each["items"][name] for name in score["items"]] for each in scored if each["group"] == group]
            for group in groups
        }
        scores.append(
            {
                **{name: score[name] for name in ("name", "title", "lowest", "highest")},
                **found,
                "left_out": len(rows) - len(scored),
                "reliability": [
                    {
                        "group": group,
                        **reliability_report(np.array(each, float).reshape(len(each), len(score["items"]))),
                    }
                    for group, each in answered.items()
                ],
            }
        )
    return {"groups": list(groups), "people": len({each["participant"] for each in rows}), "scores": scores}
