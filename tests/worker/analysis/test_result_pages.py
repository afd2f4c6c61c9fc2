"""The tables of published result pages say what the files beside them say."""

import csv
import re
from pathlib import Path

import pytest

from app.installed_tasks import catalogue
from tests.benchmarks import error_rates, feedback_report, printed_readings
from worker.analysis.comparison import comparison_page, result_pages

RESULTS = Path(__file__).resolve().parents[3] / "docs/results"


def rows(name: str) -> list[dict[str, str]]:
    """A published table."""
    with (RESULTS / name).open() as stream:
        return list(csv.DictReader(stream))


@pytest.mark.parametrize("page", sorted(RESULTS.glob("**/table1.md")), ids=lambda page: page.parent.name)
def test_a_comparison(page: Path) -> None:
    """python -m tests.benchmarks.comparison_report writes it anew."""
    assert page.read_text() == comparison_page.page(page.parent)
    pictures = {each.name for each in page.parent.glob("pareto-*.svg")}
    assert pictures == set(re.findall(r"\]\((pareto-[^)]+)\)", page.read_text())), "each is shown, none is missing"


def test_feedback_efficiency() -> None:
    """python -m tests.benchmarks.feedback_report docs/results writes it anew."""
    by_task = {task: feedback_report.read(RESULTS / f"feedback_efficiency-{task}.csv") for task in catalogue.names()}
    page = RESULTS / "feedback_efficiency.md"
    assert page.read_text() == result_pages.page(page, "", feedback_report.tables(by_task))


def test_error_rates() -> None:
    page = RESULTS / "error_rates.md"
    measured = error_rates.tables(rows("error_rates.csv"), rows("error_rates_of_intervals.csv"))
    assert page.read_text() == result_pages.page(page, "", measured)


def test_printed_readings() -> None:
    page = RESULTS / "printed_readings.md"
    assert page.read_text() == result_pages.page(page, "", printed_readings.tables(rows("printed_readings.csv")))


def test_every_page_says_what_was_asked_and_what_came_out_and_stands_in_the_index() -> None:
    index = (RESULTS / "README.md").read_text()
    for page in sorted(RESULTS.glob("**/*.md")):
        if page.name != "README.md":
            assert "\n**Asked:**" in page.read_text(), page
            assert "\n**Answer:**" in page.read_text(), page
            assert f"({page.relative_to(RESULTS).as_posix()})" in index, page
