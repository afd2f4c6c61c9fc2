"""The picture of tests.benchmarks.rivals: every training a point, in the nine cells of task and user."""

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from app.installed_tasks import catalogue
from tests.benchmarks import rivals_report
from tests.benchmarks.rivals_report import CHEAP_FIRST, TOLERANCE, Row
from worker.analysis.study.figures import GREY, INK, LINE_COLOURS, PALE, STYLE, rendered
from worker.experiments.benchmark_cell import PAPER_USERS, default_method

LEAST, MOST = -20.0, 45.0
"""% of gain; what lies outside is drawn at the edge, with its number."""
KEPT: Mapping[str, Any] = {"marker": "o", "color": LINE_COLOURS[2]}
LOST: Mapping[str, Any] = {"marker": "^", "color": LINE_COLOURS[1], "markerfacecolor": "white", "zorder": 4}
SIZE: Mapping[str, Any] = {"markersize": 4.5, "linestyle": "none"}


def svg(rows: Sequence[Row]) -> bytes:
    """Gains by method in every cell, with the default's mean as a line. Hollow: the task is not kept."""
    methods = list(dict.fromkeys([*CHEAP_FIRST, *(row["method"] for row in rows)]))
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(8.2, 10.4), layout="constrained")
        grid = figure.subplots(len(catalogue.names()), len(PAPER_USERS), sharex=True, sharey=True)
        for down, task in enumerate(catalogue.names()):
            for across, user in enumerate(PAPER_USERS):
                mine = [row for row in rows if (row["task"], row["user"]) == (task, user)]
                _cell(grid[down, across], mine, task, methods)
                grid[down, across].set_title(f"{task.capitalize()}, {user}")
        figure.supxlabel("Change of true preference, % of what the user minds and likes", fontsize=9)
        marks = {f"keeps the task within {100 * TOLERANCE:.0f} points": KEPT, "loses more of it": LOST}
        for words, mark in marks.items():
            grid[0, 0].plot([], [], label=words, **mark, **SIZE)
        grid[0, 0].plot([], [], color=GREY, linestyle="--", linewidth=1, label="mean of the default")
        figure.legend(*grid[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=3)
    return rendered(figure)["svg"]


def _cell(axes: Axes, rows: Sequence[Row], task: str, methods: Sequence[str]) -> None:
    """One point per training; methods from the top."""
    axes.set_xlim(LEAST, MOST)
    axes.set_ylim(len(methods) - 0.5, -0.5)
    axes.set_yticks(range(len(methods)), methods, fontsize=7)
    axes.hlines(range(len(methods)), LEAST, MOST, color=PALE, linewidth=0.5, zorder=0)
    axes.axvline(0.0, color=INK, linewidth=0.8, zorder=1)
    default = [_gain(row) for row in rows if row["method"] == default_method(task)]
    if default:
        axes.axvline(sum(default) / len(default), color=GREY, linestyle="--", linewidth=1, zorder=1)
    for row in rows:
        gain, place = _gain(row), methods.index(row["method"])
        mark = KEPT if rivals_report.keeps_task(row) else LOST
        axes.plot(min(max(gain, LEAST), MOST), place, clip_on=False, **mark, **SIZE)
        if not LEAST <= gain <= MOST:
            at, side = (LEAST, "left") if gain < LEAST else (MOST, "right")
            inward = 5 if side == "left" else -5
            axes.annotate(
                f"{gain:.0f}", (at, place), (inward, 0), textcoords="offset points", ha=side, va="center", fontsize=6
            )


def _gain(row: Row) -> float:
    """% over the training's scenarios."""
    return 100 * float(rivals_report.gains_of(row).mean())
