"""The comparison as files: CSV tables, how they were made, and a page for people that follows from both.

Everything on the page is read back from the files beside it, so the two cannot disagree, and a changed layout needs no
new measurement (``python -m tests.benchmarks.comparison_report docs/results/all_methods``).
"""

import csv
import io
import json
from collections.abc import Container, Mapping, Sequence
from pathlib import Path
from typing import Any

from worker.analysis.comparison.comparison_rows import (
    Cells,
    Row,
    against,
    cost_rows,
    fit_rows,
    personalisation_rows,
    seed_rows,
    spent_rows,
    table_rows,
)

OURS, BASELINES = ("pbarl", "pbarl_archived", "pbarl_refined"), ("prefft", "prefft_anchored", "pbrl_hri")
"""The studio's filters, the quick one first, and the baselines they are paired with scenario by scenario."""

Tables = Mapping[str, Sequence[Row]]
"""By name of the file, without .csv"""

DESCRIPTIONS = {
    "table1": "success, learned and true preference of every task, user and method, with changes and intervals",
    "paired": "the studio's filter minus each baseline in the same scenarios, with intervals",
    "personalisation": "every filter judged by every user (the matrix), and the own filter's advantage",
    "seeds": "own gain, advantage and change of success for each seed of labels, trainings and scenarios alone",
    "costs": "the six costs, summed over an episode, and their changes",
    "effort": "labels, environment steps and seconds per fit",
    "fits": "what every fit says about itself: mode, gate, residual, last losses",
    "users": "weights of the scripted users: per item of r^H, and per unit of a further signal (below 0: likes it)",
}
_TEXTS = {"task", "user", "method", "baseline", "trained_for", "judged_by", "item", "notes"}


def tables(cells: Cells, groups: Sequence[Sequence[str]], users: Sequence[Row]) -> Tables:
    """All of them. ``groups``: users who are compared with each other; ``users``: the rows of users.csv."""
    default = default_in({method for _, _, method in cells})
    return {
        "table1": table_rows(cells),
        "paired": [row for baseline in BASELINES for row in against(cells, default, baseline)],
        "personalisation": personalisation_rows(cells, default, groups),
        "seeds": seed_rows(cells, default, groups),
        "costs": cost_rows(cells),
        "effort": spent_rows(cells),
        "fits": fit_rows(cells),
        "users": users,
    }


def default_in(methods: Container[str]) -> str:
    """The first of the studio's filters among these."""
    return next((each for each in OURS if each in methods), OURS[0])


def to_csv(rows: Sequence[Row]) -> str:
    """One line per row; numbers with six significant digits."""
    target = io.StringIO()
    if rows:
        writer = csv.DictWriter(target, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows({name: _short(value) for name, value in row.items()} for row in rows)
    return target.getvalue()


def read(folder: Path) -> tuple[Tables, dict[str, Any]]:
    """The tables of a folder (without a file: without rows), and how they were made."""
    files = {name: folder / f"{name}.csv" for name in DESCRIPTIONS}
    found = {name: _rows(file.read_text()) if file.exists() else [] for name, file in files.items()}
    return found, json.loads((folder / "made.json").read_text())


def _rows(text: str) -> list[Row]:
    return [
        {name: value if name in _TEXTS or not value else float(value) for name, value in row.items()}
        for row in csv.DictReader(io.StringIO(text))
    ]


def _short(value: Any) -> Any:
    return f"{value:.6g}" if isinstance(value, float) else value
