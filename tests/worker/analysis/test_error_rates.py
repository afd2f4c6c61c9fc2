"""The simulation of error rates, small; and that what is relied on kept its promise in the large one."""

import csv
from dataclasses import replace
from pathlib import Path

import pytest

from tests.benchmarks import error_rates
from tests.benchmarks.error_rates import SPREAD, UNEQUAL, Truth
from worker.analysis.study.statistics import RECOMMENDED

STUDIES = 250
MISSING = replace(SPREAD, name="spread .5, trials missing", missing=0.3, dropouts=0.1)
LONG = [pytest.param(truth, marks=pytest.mark.long) for truth in (UNEQUAL, MISSING)]


@pytest.mark.parametrize("truth", [SPREAD, *LONG], ids=lambda truth: truth.name)
def test_tests_that_count_people_err_as_often_as_they_promise(truth: Truth) -> None:
    """Within three standard errors; three comparisons of one study are not independent, so counted as one."""
    most = 5.0 + 3 * (5.0 * 95.0 / STUDIES) ** 0.5
    found = {row["test"]: row for row in error_rates.rates(truth, STUDIES)}
    for test in ("paired_t", "wilcoxon", "mixed_model"):
        assert found[test]["false_alarms_percent"] <= most
        assert found[test]["false_alarms_of_family_percent"] <= most


def test_the_command_writes_every_table(tmp_path: Path) -> None:
    error_rates.main(["--studies", "10", "--to", str(tmp_path)])
    page = (tmp_path / "error_rates.md").read_text()
    assert page.count("| spread .5 | 8 |") == 1
    assert "kappa" in page
    assert {each.name for each in tmp_path.iterdir()} == {
        "error_rates.csv",
        "error_rates.md",
        "error_rates_of_intervals.csv",
    }


def test_what_is_recommended_never_erred_clearly_more_often_than_promised() -> None:
    with (error_rates.RESULTS / "error_rates.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if row["test"] == RECOMMENDED]
    assert rows
    for row in rows:
        assert float(row["false_alarms_percent"]) <= 5.0 + 3 * (5.0 * 95.0 / int(row["studies"])) ** 0.5
