"""What the answers of a study say: foresight of the models, times, agreement of people with themselves, change.

The inputs are tables as they are exported: ``queries.csv`` with the answer that counts for each pair, and
``evaluations.csv`` with what was measured of each filter. Layouts are with each function; unknown is None.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd

from worker.analysis.agreement import prequential, wilson_interval
from worker.analysis.statistics import mean_interval, plain

Floats = npt.NDArray[np.float64]
Result = dict[str, Any]

WINDOW = 30
"""Answers in the running accuracy, as on the dashboard."""
FIRST_POINT = 5
LEARNED_FROM = ("introduction", "preference")
AT_RANDOM = "uniform"
"""Strategy of pairs that count for accuracy: those a model chose are the ones it is worst at."""
_TARGETS = {"left": 0.0, "equal": 0.5, "right": 1.0}
_MIRRORED = {"left": "right", "right": "left"}


def answer_report(queries: pd.DataFrame, participants: Sequence[str]) -> Result:
    """Per participant and pooled.

    Accuracy is over pairs that were drawn at random, whatever else the study asks.
    participants[]: participant, labels, left, right, equal, skip, median_response_ms, working_minutes, accuracy
    {correct, scored, accuracy, low, high} and curve [[scored, accuracy], ...], test_retest {...}; pooled: mean_accuracy
    with its t interval over people, accuracy of all answers together, test_retest of all repeats together.
    """
    answered = queries[queries["response"].notna()]
    rows = [_participant(answered[answered["participant"] == code], code) for code in participants]
    shares = np.array([row["accuracy"]["accuracy"] for row in rows if row["accuracy"]["accuracy"] is not None])
    low, high = mean_interval(shares)
    pooled = {
        "people": len(shares),
        "mean_accuracy": plain(shares.mean()) if len(shares) else None,
        "mean_low": low,
        "mean_high": high,
        "labels": int(answered["purpose"].isin(LEARNED_FROM).sum()),
        "test_retest": test_retest(answered),
    }
    return {"participants": rows, "pooled": pooled, "window": WINDOW}


def _participant(answered: pd.DataFrame, code: str) -> Result:
    labels = answered[answered["purpose"].isin(LEARNED_FROM)].sort_values("ordinal")
    said = labels[(labels["response"] != "skip") & (labels["strategy"] == AT_RANDOM)]
    targets = np.array([_TARGETS[response] for response in said["response"]])
    predicted = said["predicted_right"].to_numpy(np.float64, na_value=np.nan)
    counts = labels["response"].value_counts()
    times_ms = answered["response_time_ms"].dropna().to_numpy(np.float64)
    return {
        "participant": code,
        "labels": len(labels),
        **{response: int(counts.get(response, 0)) for response in ("left", "right", "equal", "skip")},
        "median_response_ms": plain(np.median(times_ms)) if len(times_ms) else None,
        "working_minutes": plain(times_ms.sum() / 60_000) if len(times_ms) else None,
        "accuracy": prequential(predicted, targets)["overall"],
        "curve": curve(predicted, targets),
        "test_retest": test_retest(answered),
    }


def curve(predicted_right: Floats, targets: Floats) -> list[list[float]]:
    """The share of the last WINDOW scored answers that was foreseen, after each of them: [scored, accuracy]."""
    scored = np.isfinite(predicted_right) & (targets != 0.5)
    hits = ((predicted_right > 0.5) == (targets > 0.5))[scored]
    return [
        [float(count), float(hits[max(0, count - WINDOW) : count].mean())]
        for count in range(FIRST_POINT, len(hits) + 1)
    ]


def test_retest(answered: pd.DataFrame) -> Result:
    """How often people said the same of a pair that was asked twice, whichever side the clips were on.

    asked, same, share, low, high (Wilson; repeats of several people are counted as independent), kappa (Cohen's, over
    first clip, second clip, equal, can't tell).
    """
    first = answered.set_index(["participant", "ordinal"])["response"]
    repeats = answered[(answered["purpose"] == "repeat") & answered["repeats_ordinal"].notna()]
    pairs = []
    for row in repeats.itertuples():
        earlier = first.get((row.participant, int(row.repeats_ordinal)))
        if earlier is not None:
            pairs.append(
                (str(earlier), _MIRRORED.get(row.response, row.response) if row.sides_swapped else row.response)
            )
    if not pairs:
        return {"asked": 0, "same": 0, "share": None, "low": None, "high": None, "kappa": None}
    same = sum(before == after for before, after in pairs)
    low, high = wilson_interval(same, len(pairs))
    return {
        "asked": len(pairs),
        "same": same,
        "share": same / len(pairs),
        "low": low,
        "high": high,
        "kappa": kappa(pairs),
    }


test_retest.__test__ = False  # type: ignore[attr-defined]  # a measure of that name, and no test of pytest's


def kappa(pairs: Sequence[tuple[str, str]]) -> float | None:
    """Cohen's kappa of two answers to the same pairs; None when chance alone would make them agree."""
    words = sorted({word for pair in pairs for word in pair})
    table = np.zeros((len(words), len(words)))
    for before, after in pairs:
        table[words.index(before), words.index(after)] += 1 / len(pairs)
    expected = float(table.sum(axis=0) @ table.sum(axis=1))
    return None if expected >= 1 else float((np.trace(table) - expected) / (1 - expected))


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
