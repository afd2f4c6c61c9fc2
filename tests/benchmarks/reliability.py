"""How far Cronbach's alpha, its interval and McDonald's omega are off with few people, where the truth is known.

    OMP_NUM_THREADS=1 python -m tests.benchmarks.reliability --studies 2000

Writes docs/results/reliability.csv and .md. Everything is computed by the functions that the page of results uses.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tests.benchmarks import result_tables
from worker.analysis.comparison import result_pages
from worker.analysis.study.reliability import alpha, reliability_report
from worker.domain.type_aliases import FloatArray

RESULTS = Path("docs/results")
PEOPLE, ITEMS = (8, 16, 24, 48), (3, 6, 10)
TRUE_RELIABILITY = 0.8
POINTS = 5
MANY = 400_000
KINDS = {
    "equal": "normal, all items equally good",
    "five points": "the same, rounded to five points",
    "unequal": "normal, loadings from 0.5 to 1.5 of the mean",
}
TITLE = "# Error rates of alpha and omega"
COLUMNS = (
    "kind",
    "items",
    "people",
    "true",
    "alpha_of_many",
    "alpha",
    "missed_percent",
    "omega",
    "omega_computed_percent",
)


def loadings(kind: str, items: int) -> FloatArray:
    """Of standardised noise, so that the sum has the reliability that is meant."""
    shape = np.linspace(0.5, 1.5, items) if kind == "unequal" else np.ones(items)
    total = float((TRUE_RELIABILITY / (1 - TRUE_RELIABILITY) * items) ** 0.5)
    return np.asarray(shape * total / shape.sum(), np.float64)


def invented(kind: str, items: int, people: int, rng: np.random.Generator) -> FloatArray:
    """Answers (people, items) to one factor; five points are cut at the quintiles, near enough, of a normal answer."""
    loading = loadings(kind, items)
    answers = rng.normal(size=(people, 1)) * loading + rng.normal(size=(people, items))
    if kind != "five points":
        return answers
    spread = float((1 + loading[0] ** 2) ** 0.5)
    return np.clip(np.round(answers / spread * 1.1 + 3), 1, POINTS)


def row(kind: str, items: int, people: int, studies: int) -> dict[str, Any]:
    """Mean estimates, and how often the interval of alpha misses the alpha of very many people."""
    rng = np.random.default_rng([list(KINDS).index(kind), items, people])
    limit = alpha(np.cov(invented(kind, items, MANY, rng), rowvar=False))
    alphas, omegas, missed = [], [], 0
    for _ in range(studies):
        found = reliability_report(invented(kind, items, people, rng))
        if "alpha" not in found:
            continue
        alphas.append(found["alpha"])
        missed += not found["low"] <= limit <= found["high"]
        omegas += [] if found["omega"] is None else [found["omega"]]
    return {
        "kind": kind,
        "items": items,
        "people": people,
        "true": "" if kind == "five points" else TRUE_RELIABILITY,
        "alpha_of_many": round(limit, 3),
        "alpha": round(float(np.mean(alphas)), 3),
        "missed_percent": round(100 * missed / len(alphas), 1),
        "omega": round(float(np.mean(omegas)), 3) if omegas else "",
        "omega_computed_percent": round(100 * len(omegas) / studies, 1),
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Simulate, and write the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--studies", type=int, default=2000, help="of each truth")
    parser.add_argument("--people", type=int, nargs="+", default=list(PEOPLE))
    parser.add_argument("--to", type=Path, default=RESULTS, help="folder to write to")
    options = parser.parse_args(arguments)
    rows = [row(kind, items, n, options.studies) for kind in KINDS for items in ITEMS for n in options.people]
    write(options.to, rows)


def write(folder: Path, rows: Sequence[dict[str, Any]]) -> None:
    """As CSV, and as the table of the page, whose words stay."""
    result_tables.write(folder / "reliability.csv", rows)
    heads = (
        "items are",
        "items",
        "people",
        "true",
        "alpha of many",
        "mean alpha",
        "interval misses, %",
        "mean omega",
        "omega computed, %",
    )
    lines = ["| " + " | ".join(heads) + " |", "|---" * len(heads) + "|"]
    lines += ["| " + " | ".join(str(each[name]) for name in COLUMNS) + " |" for each in rows]
    page = folder / "reliability.md"
    page.write_text(result_pages.page(page, TITLE, "\n".join(lines)))


if __name__ == "__main__":
    main()
