"""Tables and a picture of feedback_efficiency, from the files of rows that there are.

    python -m tests.benchmarks.feedback_report docs/results

writes feedback_efficiency-<task>.md beside every feedback_efficiency-<task>.csv, and feedback_efficiency.svg.
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

from installed_tasks import catalogue
from worker.analysis.figures import LINE_COLOURS, MARKERS, STYLE, rendered

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
FEW = ("uniform", "entropy", "entropy, pooled prior")


def write(folder: Path) -> None:
    """See the module."""
    by_task = {}
    for task in catalogue.names():
        file = folder / f"feedback_efficiency-{task}.csv"
        if file.exists():
            by_task[task] = rows = read(file)
            head = (
                f"# Feedback efficiency: {task}\n\nWhat was run and what it says: "
                "[feedback_efficiency.md](feedback_efficiency.md). In brackets: standard error over chains. "
                f"Every row: [{file.name}]({file.name}).\n\n"
            )
            file.with_suffix(".md").write_text(head + tables(rows))
    if by_task:
        (folder / "feedback_efficiency.svg").write_bytes(rendered(_curves(by_task))["svg"])


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


def tables(rows: Sequence[Row]) -> str:
    """Markdown tables: means over chains, of users and seeds that every line of a table has."""
    named = [row for row in rows if row["user"] in NAMED and not row["pooled_prior"]]
    uniform = [row for row in named if row["strategy"] == "uniform"]
    structured = [row for row in named if row["model"] in LINEAR]
    networks = [row for row in named if row["model"] not in LINEAR]
    people = [
        {**row, "strategy": f"{row['strategy']}, pooled prior" if row["pooled_prior"] else row["strategy"]}
        for row in rows
        if row["user"].startswith("person-")
    ]
    drawn = [row for row in people if row["model"] == "structured"]
    accuracies = [
        ("Reward models, pairs at random, named users", uniform),
        ("Ways of choosing pairs, linear models, named users", structured),
        ("Ways of choosing pairs and the pooled prior, structured, people of the population", drawn),
        ("Few labels against many, people of the population", [row for row in people if row["strategy"] in FEW]),
        ("Ways of choosing pairs, networks, users finished in time", networks),
    ]
    lines: list[str] = []
    for title, chosen in accuracies:
        lines += [f"### {title}: accuracy on all unseen pairs", "", *_table(chosen, "accuracy"), ""]
        lines += [f"### {title}: accuracy on contested pairs", "", *_table(chosen, "contested_accuracy"), ""]
    for title, chosen in accuracies[:4]:
        lines += [
            f"### {title}: true preference gained, % of the reference's",
            "",
            *_table(chosen, "gain_percent", 1),
            "",
        ]
        lines += [f"### {title}: change of success, points", "", *_table(chosen, "success_points", 1), ""]
    lines += ["### Promised and driven: gain of true preference in %, change of success in points", ""]
    lines += [*_driven(rows), ""]
    lines += ["### Expected calibration error without temperature", ""]
    lines += [*_table(uniform, "calibration_error_uncalibrated"), "", "### Expected calibration error as shipped", ""]
    return (
        "\n".join([*lines, *_table(uniform, "calibration_error"), "", "### Seconds per fit", "", *_seconds(uniform)])
        + "\n"
    )


def _driven(rows: Sequence[Row]) -> list[str]:
    lines = [
        "| user | model | rule | labels | gain, promised | driven | success, promised | driven |",
        "|---" * 8 + "|",
    ]
    for row in rows:
        if row["driven_gain_percent"] is not None:
            figures = ("gain_percent", "driven_gain_percent", "success_points", "driven_success_points")
            names = " | ".join(str(row[name]) for name in ("user", "model", "strategy", "labels"))
            lines.append(f"| {names} | " + " | ".join(f"{row[name]:+.1f}" for name in figures) + " |")
    return lines


def _seconds(rows: Sequence[Row]) -> list[str]:
    return _table(rows, "fit_seconds", 2)


def _table(rows: Sequence[Row], field: str, digits: int = 3) -> list[str]:
    lines_of = dict.fromkeys((row["model"], row["strategy"]) for row in rows)
    chains_of = [
        {(row["user"], row["seed"]) for row in rows if (row["model"], row["strategy"]) == line} for line in lines_of
    ]
    shared = set.intersection(*chains_of) if chains_of else set()
    kept = [row for row in rows if (row["user"], row["seed"]) in shared and row[field] is not None]
    counts = sorted({row["labels"] for row in kept})
    head = "| model | pairs chosen | chains | " + " | ".join(map(str, counts)) + " |"
    lines = [head, "|---" * (3 + len(counts)) + "|"]
    for model, strategy in lines_of:
        mine = [row for row in kept if (row["model"], row["strategy"]) == (model, strategy)]
        cells = [_cell([row[field] for row in mine if row["labels"] == count], digits) for count in counts]
        lines.append(f"| {model} | {strategy} | {len(shared)} | " + " | ".join(cells) + " |")
    return lines


def _cell(values: Sequence[float], digits: int) -> str:
    """Mean and, of several chains, its standard error."""
    if not values:
        return "-"
    mean = f"{np.mean(values):.{digits}f}"
    return f"{mean} ({np.std(values, ddof=1) / len(values) ** 0.5:.{digits}f})" if len(values) > 1 else mean


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    write(parser.parse_args().folder)
