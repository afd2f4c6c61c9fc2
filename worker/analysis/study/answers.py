"""What the answers of a study say together, and what its filters change.

The figures of one person come as the dashboard has them (app.services.answers.answer_figures), what filters change as
the table ``evaluations.csv`` that is exported. Layouts are with each function; unknown is None.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from worker.analysis.study.hypothesis_tests import plain
from worker.analysis.study.statistics import mean_interval

Result = dict[str, Any]


def answer_report(people: Sequence[Mapping[str, Any]], window: int) -> Result:
    """``people`` as they come, and pooled: mean_accuracy with its t interval over ``people``, and sums.

    ``window``: answers in the running accuracy of each.
    """
    shares = np.array([each["accuracy"]["accuracy"] for each in people if each["accuracy"]["accuracy"] is not None])
    low, high = mean_interval(shares, possible=(0, 1))
    pooled = {
        "people": len(shares),
        "mean_accuracy": plain(shares.mean()) if len(shares) else None,
        "mean_low": low,
        "mean_high": high,
        "labels": sum(each["labels"] for each in people),
        **{name: sum(each["test_retest"][name] for each in people) for name in ("asked", "same")},
    }
    return {"participants": [dict(each) for each in people], "pooled": pooled, "window": window}


def change_report(evaluations: pd.DataFrame, participants: Sequence[str]) -> Result:
    """What the newest filter of each participant changes on unseen scenarios, and the mean over people.

    participants[]: participant, label_count, scenarios, measures {name: {reference, filtered, delta, low, high}};
    pooled {name: {people, mean, low, high, reference}}. ``success``: share; ``preference``: standard deviations of the
    reference's return, as the person's own reward model sees it; C_*: the paper's costs per episode.
    """
    rows: list[Result] = []
    for code in participants:
        theirs = evaluations[(evaluations["participant"] == code) & evaluations["newest"].astype(bool)]
        if len(theirs):
            measures = {row.measure: _measured(row) for row in theirs.itertuples()}
            first = theirs.iloc[0]
            rows.append(
                {
                    "participant": code,
                    "label_count": int(first["label_count"]),
                    "scenarios": None if pd.isna(first["scenarios"]) else int(first["scenarios"]),
                    "measures": measures,
                }
            )
    names = list(dict.fromkeys(name for row in rows for name in row["measures"]))
    return {"participants": rows, "pooled": {name: _pooled(rows, name) for name in names}}


def _measured(row: Any) -> Result:
    return {name: plain(getattr(row, name)) for name in ("reference", "filtered", "delta", "low", "high")}


def _pooled(rows: Sequence[Mapping[str, Any]], name: str) -> Result:
    measured = [row["measures"][name] for row in rows if name in row["measures"]]
    deltas = np.array([each["delta"] for each in measured if each["delta"] is not None], np.float64)
    references = np.array([each["reference"] for each in measured if each["reference"] is not None], np.float64)
    low, high = mean_interval(deltas)
    return {
        "people": len(deltas),
        "mean": plain(deltas.mean()) if len(deltas) else None,
        "low": low,
        "high": high,
        "reference": plain(references.mean()) if len(references) else None,
    }
