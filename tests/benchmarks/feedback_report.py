"""The page and the picture of feedback_efficiency, from the files of rows that there are.

    python -m tests.benchmarks.feedback_report docs/results

writes feedback_efficiency.svg, and the tables of feedback_efficiency.md below its mark; what stands above is kept.
"""

import argparse
import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from app.installed_tasks import catalogue
from worker.analysis.comparison import result_pages
from worker.analysis.study.figures import LINE_COLOURS, MARKERS, STYLE, rendered

Row = dict[str, Any]

NAMED = ("cautious", "impatient", "slow", "wide")
LINEAR = ("structured", "predicted")
_TEXTS = ("task", "user", "model", "strategy")
DRAWN = (
    ("structured", "entropy", "structured, by entropy"),
    ("structured", "uniform", "structured, at random"),
    ("predicted", "entropy", "predicted, by entropy"),
    ("mlp", "uniform", "mlp, at random"),
    ("preference_transformer", "uniform", "Preference Transformer, at random"),
)
"""Lines of the picture: model, rule, name."""
POOLED = ("structured", "entropy", "structured, by entropy, pooled prior")


def write(folder: Path) -> None:
    """See the module."""
    files = {task: folder / f"feedback_efficiency-{task}.csv" for task in catalogue.names()}
    by_task = {task: read(file) for task, file in files.items() if file.exists()}
    if by_task:
        (folder / "feedback_efficiency.svg").write_bytes(rendered(_curves(by_task))["svg"])
        page = folder / "feedback_efficiency.md"
        page.write_text(result_pages.page(page, "# Feedback efficiency", tables(by_task)))


def read(file: Path) -> list[Row]:
    """The rows that feedback_efficiency has written; what was not measured is None."""
    with file.open() as stream:
        return [{name: _value(name, text) for name, text in row.items()} for row in csv.DictReader(stream)]


def _value(name: str, text: str) -> Any:
    if name in _TEXTS:
        return text
    if name == "pooled_prior":
        return text == "True"
    if not text:
        return None
    return int(text) if name in {"labels", "seed"} else float(text)


def _curves(by_task: dict[str, list[Row]]) -> Figure:
    """Gain and accuracy against labels; named users, the first seed, which all models have."""
    fields = (("gain_percent", "True preference gained, %"), ("accuracy", "Unseen pairs foreseen"))
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(3.1 * len(by_task), 5.4), layout="constrained")
        grid = figure.subplots(len(fields), len(by_task), squeeze=False)
        for across, (task, rows) in enumerate(by_task.items()):
            for down, (field, words) in enumerate(fields):
                axes = grid[down, across]
                _lines(axes, rows, field)
                axes.set_title(task.capitalize() if down == 0 else "")
                axes.set_ylabel(words if across == 0 else "")
                axes.set_xlabel("Labels" if down == len(fields) - 1 else "")
        figure.legend(*grid[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return figure


def _lines(axes: Axes, rows: Sequence[Row], field: str) -> None:
    mine = [row for row in rows if row["user"] in NAMED and row["seed"] == 0 and not row["pooled_prior"]]
    for (model, rule, words), colour, marker in zip(DRAWN, LINE_COLOURS, MARKERS, strict=True):
        line = [row for row in mine if (row["model"], row["strategy"]) == (model, rule)]
        counts = sorted({row["labels"] for row in line})
        means = [np.mean([row[field] for row in line if row["labels"] == count]) for count in counts]
        axes.plot(counts, means, color=colour, marker=marker, markersize=4, linewidth=1.3, label=words)
    axes.set_xscale("log")
    axes.set_xticks([10, 50, 200, 1000, 5000], ["10", "50", "200", "1000", "5000"])
    axes.minorticks_off()


def tables(by_task: dict[str, list[Row]]) -> str:
    """The lines of the picture with standard errors, for the named users and for the people of the population."""
    parts = []
    for task, rows in by_task.items():
        first = [row for row in rows if row["seed"] == 0]
        named = [row for row in first if row["user"] in NAMED]
        people = [row for row in first if row["user"].startswith("person-")]
        parts += [_table(f"{task}: four named users", named), _table(f"{task}: six people of the population", people)]
    introduction = """\
## Every number of labels
True preference gained in %, plus or minus its standard error over users, and the share of unseen pairs foreseen; the
first seed, which all models have. The error is mostly how much users differ: lines are compared in the same users."""
    return "\n\n".join([introduction, *parts])


def _table(title: str, rows: Sequence[Row]) -> str:
    counts = sorted({row["labels"] for row in rows})
    lines = [f"### {title}", "| reward model, pairs | " + " | ".join(map(str, counts)) + " |"]
    lines.append("|---" * (1 + len(counts)) + "|")
    for model, rule, words in (*DRAWN, POOLED):
        kind = (model, rule, words == POOLED[2])
        line = [row for row in rows if (row["model"], row["strategy"], row["pooled_prior"]) == kind]
        cells = [_cell([row for row in line if row["labels"] == count]) for count in counts]
        if line:
            lines.append(f"| {words} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _cell(rows: Sequence[Row]) -> str:
    """Mean gain, its standard error, mean accuracy."""
    if not rows:
        return "-"
    gains = [row["gain_percent"] for row in rows]
    error = f" ± {np.std(gains, ddof=1) / len(gains) ** 0.5:.1f}" if len(gains) > 1 else ""
    return f"{np.mean(gains):.1f}{error} ({np.mean([row['accuracy'] for row in rows]):.3f})"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    write(parser.parse_args().folder)
