"""The simulation of Likert tests, small; and that the page of results shows what the large one measured."""

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.benchmarks import likert
from tests.benchmarks.likert import DIFFERENT, EFFECT, EFFECT_AT_AN_END, VERY, Truth
from worker.analysis.study.hypothesis_tests import TESTS
from worker.analysis.study.statistics import MEASURED_ERROR_PERCENT, RECOMMENDED


def most(studies: int) -> float:
    """What a test of 5 % hardly exceeds: three standard errors."""
    return float(5.0 + 3 * (5.0 * 95.0 / studies) ** 0.5)


def large() -> list[dict[str, str]]:
    with (likert.RESULTS / "likert.csv").open() as file:
        return list(csv.DictReader(file))


def test_who_counts_people_keeps_the_promise_and_who_counts_ratings_does_not() -> None:
    found = {row["test"]: row["below_5_percent"] for row in likert.rates(VERY, 80)}
    for test in ("paired_t", "mixed_model", "cumulative_link", "wilcoxon"):
        assert found[test] <= most(80)
    for test in ("random_intercept", "cumulative_link_usual"):
        assert found[test] > most(80)


@pytest.mark.parametrize("truth", [EFFECT, EFFECT_AT_AN_END], ids=lambda truth: truth.name)
def test_half_a_point_is_half_a_point_as_ratings_are_given(truth: Truth) -> None:
    first, second = likert.invented(replace(truth, people=20_000), np.random.default_rng(0))
    assert np.mean(second) - np.mean(first) == pytest.approx(0.5, abs=0.03)


def test_what_differs_by_the_bound_is_hardly_shown_to_be_equal() -> None:
    rows = [row for row in large() if row["test"] == "equivalence" and float(row["better"])]
    assert rows
    for row in rows:
        assert float(row["below_5_percent"]) <= most(int(row["studies"]))


def test_what_is_recommended_or_counts_people_never_erred_clearly_more_often_than_promised() -> None:
    tests = {RECOMMENDED, "mixed_model", "cumulative_link", "wilcoxon"}
    rows = [row for row in large() if row["test"] in tests and not float(row["better"])]
    assert rows
    for row in rows:
        assert float(row["below_5_percent"]) <= most(int(row["studies"])), row


def test_the_page_shows_what_was_measured() -> None:
    rows = {(int(row["people"]), row["test"]): row for row in large() if row["truth"] == DIFFERENT.name}
    for shown in MEASURED_ERROR_PERCENT:
        assert shown.keys() == {"people", *TESTS} - {"equivalence"}
        for test in shown.keys() - {"people"}:
            row = rows[shown["people"], test]
            wanted = (row["below_5_percent"], row["low"], row["high"])
            assert shown[test] == dict(zip(("percent", "low", "high"), map(float, wanted), strict=True))


def test_the_command_writes_page_and_table(tmp_path: Path) -> None:
    likert.main(["--studies", "1", "--to", str(tmp_path)])
    page = (tmp_path / "likert.md").read_text()
    assert page.count(f"| {VERY.name} | 24 |") == 2
    assert {each.name for each in tmp_path.iterdir()} == {"likert.csv", "likert.md"}
