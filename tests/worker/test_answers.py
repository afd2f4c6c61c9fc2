"""What the answers say: foresight, agreement with oneself, change."""

import numpy as np
import pandas as pd
import pytest
from statsmodels.stats.inter_rater import cohens_kappa
from statsmodels.stats.proportion import proportion_confint

from worker.analysis.answers import answer_report, change_report, kappa, test_retest

COLUMNS = (
    "strategy",
    "participant",
    "ordinal",
    "purpose",
    "repeats_ordinal",
    "sides_swapped",
    "response",
    "predicted_right",
    "response_time_ms",
)


def queries(*rows: tuple[object, ...], strategy: str = "uniform") -> pd.DataFrame:
    return pd.DataFrame([(strategy, *row) for row in rows], columns=list(COLUMNS))


def test_accuracy_has_wilsons_interval_and_leaves_out_what_has_no_right_answer() -> None:
    said = [("right", 0.9), ("left", 0.2), ("right", 0.3), ("left", 0.4), ("equal", 0.9), ("skip", 0.9), ("left", None)]
    rows = [("P01", place, "preference", None, None, *each, 2000) for place, each in enumerate(said, 1)]
    (person,) = answer_report(queries(*rows), ["P01"])["participants"]
    assert (person["accuracy"]["correct"], person["accuracy"]["scored"]) == (3, 4)
    assert (person["accuracy"]["low"], person["accuracy"]["high"]) == pytest.approx(
        proportion_confint(3, 4, method="wilson")
    )
    assert (person["labels"], person["left"], person["skip"]) == (7, 3, 1)
    assert person["median_response_ms"] == 2000


def test_pairs_that_a_model_chose_do_not_count_for_its_accuracy() -> None:
    row = ("P01", 1, "preference", None, None, "right", 0.9, 2000)
    (person,) = answer_report(queries(row, strategy="entropy"), ["P01"])["participants"]
    assert (person["labels"], person["accuracy"]["scored"]) == (1, 0)


def test_practice_and_repeats_are_no_labels() -> None:
    rows = queries(
        ("P01", 1, "practice", None, None, "left", None, 900),
        ("P01", 2, "introduction", None, None, "left", None, 900),
        ("P01", 3, "repeat", 2, False, "left", None, 900),
    )
    (person,) = answer_report(rows, ["P01"])["participants"]
    assert person["labels"] == 1


def test_saying_the_other_side_of_exchanged_clips_is_saying_the_same() -> None:
    rows = queries(
        ("P01", 1, "preference", None, None, "left", None, 1),
        ("P01", 2, "preference", None, None, "left", None, 1),
        ("P01", 3, "preference", None, None, "equal", None, 1),
        ("P01", 4, "repeat", 1, True, "right", None, 1),
        ("P01", 5, "repeat", 2, True, "left", None, 1),
        ("P01", 6, "repeat", 3, True, "equal", None, 1),
    )
    agreement = test_retest(rows)
    assert (agreement["asked"], agreement["same"]) == (3, 2)
    assert agreement["share"] == pytest.approx(2 / 3)


def test_kappa_is_the_one_of_statsmodels() -> None:
    pairs = [("left", "left")] * 7 + [("left", "right")] * 2 + [("right", "right")] * 5 + [("right", "left")]
    assert kappa(pairs) == pytest.approx(cohens_kappa(np.array([[7, 2], [1, 5]])).kappa)
    assert kappa([("left", "left")] * 3) is None, "nothing but one word: chance alone agrees"


def test_nobody_and_nothing_are_no_error() -> None:
    report = answer_report(queries(), ["P01"])
    assert report["pooled"]["mean_accuracy"] is None
    assert report["participants"][0]["accuracy"]["accuracy"] is None
    empty = pd.DataFrame(columns=["participant", "newest", "measure", "label_count", "scenarios"])
    assert change_report(empty, ["P01"]) == {"participants": [], "pooled": {}}


def test_change_is_that_of_the_newest_filter_and_its_mean_over_people() -> None:
    names = (
        "participant",
        "label_count",
        "newest",
        "scenarios",
        "measure",
        "reference",
        "filtered",
        "delta",
        "low",
        "high",
    )
    rows = [("P01", 50, False, 100, "success", 0.9, 0.1, -0.8, -0.9, -0.7)]
    rows += [
        (f"P0{n}", 200, True, 100, "success", 0.9, 0.9 + d, d, d - 0.1, d + 0.1)
        for n, d in ((1, 0.0), (2, 0.1), (3, 0.2))
    ]
    report = change_report(pd.DataFrame(rows, columns=list(names)), ["P01", "P02", "P03"])
    assert [each["measures"]["success"]["delta"] for each in report["participants"]] == [0.0, 0.1, 0.2]
    pooled = report["pooled"]["success"]
    assert (pooled["people"], pooled["mean"]) == (3, pytest.approx(0.1))
    assert pooled["high"] == pytest.approx(0.1 + 4.302653 * 0.1 / 3**0.5)
