"""What the answers of a study say together, and what its filters change."""

import pandas as pd
import pytest

from worker.analysis.study.answers import answer_report, change_report
from worker.analysis.study.statistics import rating_report


def person(code: str, accuracy: float | None, asked: int = 0, same: int = 0) -> dict[str, object]:
    return {
        "participant": code,
        "labels": 10,
        "accuracy": {"accuracy": accuracy},
        "test_retest": {"asked": asked, "same": same},
    }


def test_the_mean_over_people_has_their_t_interval() -> None:
    people = [person("P01", 0.6, 4, 3), person("P02", 0.7), person("P03", 0.8, 2, 2), person("P04", None)]
    pooled = answer_report(people, 30)["pooled"]
    assert (pooled["people"], pooled["labels"], pooled["asked"], pooled["same"]) == (3, 40, 6, 5)
    assert pooled["mean_accuracy"] == pytest.approx(0.7)
    assert pooled["mean_high"] == pytest.approx(0.7 + 4.302653 * 0.1 / 3**0.5)


def test_no_interval_goes_beyond_what_is_possible() -> None:
    pooled = answer_report([person("P01", 0.65), person("P02", 0.89), person("P03", 0.84)], 30)["pooled"]
    assert pooled["mean_low"] == pytest.approx(0.7933 - 4.302653 * 0.12662 / 3**0.5, abs=1e-3)
    assert pooled["mean_high"] == 1
    ratings = [{"participant": f"P0{n}", "method": "pbarl", "satisfaction": n, "personalisation": 5} for n in (1, 2, 5)]
    means = rating_report(pd.DataFrame(ratings), ["pbarl"])["scales"]["satisfaction"]["means"]
    assert [(each["low"], each["high"]) for each in means] == [(1, 5)]


def test_nobody_and_nothing_are_no_error() -> None:
    assert answer_report([], 30)["pooled"]["mean_accuracy"] is None
    assert answer_report([person("P01", None)], 30)["pooled"]["mean_low"] is None
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
