"""Tables of results, from which benchmarks go on."""

import csv
from pathlib import Path

LONGEST_FIELD = 1_000_000
"""The gains of some hundred scenarios are in one."""


def read(table: Path) -> list[dict[str, str]]:
    """The rows of a table; none when there is no file."""
    if not table.exists():
        return []
    csv.field_size_limit(LONGEST_FIELD)
    with table.open(newline="") as file:
        return list(csv.DictReader(file))
