"""Every row of the table of faults names tests that exist."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
ROWS = [
    line.strip("|").split("|")
    for line in (ROOT / "docs/faults.md").read_text().splitlines()
    if line.startswith("|") and not line.startswith(("|---", "| Fault "))
]
KINDS = (
    "Database",
    "Log of the database",
    "Engine's file",
    "Clip",
    "Trajectory",
    "Reward model",
    "Bundle",
    "Disk full",
)


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row[0].strip())
def test_a_row_says_everything_and_names_tests_that_exist(row: list[str]) -> None:
    assert len(row) == 6
    assert all(cell.strip() for cell in row)
    named = re.findall(r"`(tests/\S+\.py)::(test_\w+)`", row[-1])
    assert named, "no test shows it"
    for file, test in named:
        assert re.search(rf"def {test}\(", (ROOT / file).read_text()), f"{file} has no {test}"


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_file_and_trouble_has_a_row(kind: str) -> None:
    assert any(row[0].strip().startswith(kind) for row in ROWS)
