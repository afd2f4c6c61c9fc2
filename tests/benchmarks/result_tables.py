"""Tables of results, from which benchmarks go on."""

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from worker.whole_files import written_whole

LONGEST_FIELD = 1_000_000
"""The gains of some hundred scenarios are in one."""


def stem(text: str) -> Path:
    """An option's value, a path without ending: its folder is made before anything is measured, not after hours."""
    Path(text).parent.mkdir(parents=True, exist_ok=True)
    return Path(text)


def read(table: Path) -> list[dict[str, str]]:
    """The rows of a table; none when there is no file."""
    if not table.exists():
        return []
    csv.field_size_limit(LONGEST_FIELD)
    with table.open(newline="") as file:
        return list(csv.DictReader(file))


def write(table: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """A table of at least one row, with the first row's columns; complete or as it was, however a program ends."""
    with written_whole(table) as path, path.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
