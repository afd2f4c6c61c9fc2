"""The comparison as files: CSV for programs, Markdown beside the paper's numbers for people."""

import csv
import io
from collections.abc import Mapping, Sequence
from typing import Any

from worker.analysis.comparison import (
    Cells,
    Row,
    against,
    cost_rows,
    one_by_one,
    personalisation_rows,
    spent_rows,
    table_rows,
)
from worker.analysis.published import published
from worker.trajectory import COSTS

METHOD, RIVALS = "pbarl", ("prefft", "prefft_anchored", "pbrl_hri")
TOLERANCE = 0.05
"""Largest loss of success with which a method counts as keeping the task."""


def to_csv(rows: Sequence[Row]) -> str:
    """One line per row; numbers with six significant digits."""
    target = io.StringIO()
    if rows:
        writer = csv.DictWriter(target, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows({name: _short(value) for name, value in row.items()} for row in rows)
    return target.getvalue()


def to_markdown(cells: Cells, groups: Sequence[Sequence[str]], header: str) -> str:
    """Everything on one page. ``header``: how this was made."""
    parts = [
        "# Methods compared: the paper's Table I, measured here",
        header,
        READING,
        _tables(cells),
        _claim(cells),
        _spent(cells),
        _costs(cells),
        _matrices(cells, groups),
        _seeds(cells, groups),
        _notes(cells),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


READING = """\
Same numbers, unrounded: `table1.csv`, `costs.csv`, `personalisation.csv` (there, success and gains are shares: 0.05 is
five points or 5 %). Success in %, changes in points. R-hat is the return of the user's learned reward model, with mean
0 and standard deviation 1 per step over the reference policy's rollouts; all methods of a user and seed are judged by
the same model. r^H is the scripted user's true preference, which no method has seen. Changes are against the reference
policy in the same scenarios, [95 % interval] over scenarios only: neither another seed of labels nor another training
is in it. The paper's columns are copied from its Table I: its returns have another zero and unit than ours: compare
signs and order, not sizes. Its PbARL (n = 10) stands beside both `pbarl` (the studio's default) and `pbarl_printed`.
A row that is missing has not been run."""


def _tables(cells: Cells) -> str:
    rows = {(row["task"], row["user"], row["method"]): row for row in table_rows(cells)}
    parts = []
    for task, user in dict.fromkeys((task, user) for task, user, _ in cells):
        lines = [
            f"## {task}, {user}",
            "| method | seeds x scenarios | success | change | paper: success (change) | R-hat | change |"
            " paper: return (change) | true r^H | change |",
            "|---|---|---|---|---|---|---|---|---|---|",
        ]
        lines += [_line(row) for (where, whom, _), row in rows.items() if (where, whom) == (task, user)]
        parts.append("\n".join(lines))
    return "\n\n".join(parts)


def _line(row: Row) -> str:
    paper, base = (published(row["task"], row["user"], name) for name in (row["method"], "reference"))
    success = returns = "-"
    if paper and base:
        success = f"{paper[0]:.0f} ({paper[0] - base[0]:+.0f})"
        returns = f"{paper[1]:.1f} ({paper[1] - base[1]:+.1f})"
    cells = [
        f"`{row['method']}`",
        f"{row['seeds']} x {row['scenarios']}",
        f"{100 * row['success']:.1f}",
        _change(row, "success_delta", 100),
        success,
        f"{row['preference']:.1f}",
        _change(row, "preference_delta"),
        returns,
        f"{row['true_preference']:.2f}",
        _change(row, "true_preference_delta", digits=2),
    ]
    return "| " + " | ".join(cells) + " |"


def _claim(cells: Cells) -> str:
    """The paper's sentence, cell by cell."""
    rows = [row for row in table_rows(cells) if row["method"] == METHOD]
    if not rows:
        return ""
    lines = [
        f'## "PbARL keeps the task and raises the preference": `{METHOD}`, cell by cell',
        f"Keeps the task: loses at most {100 * TOLERANCE:.0f} points of success. Raises: the interval is above 0.",
        "",
        "| task, user | keeps the task | raises R-hat | raises r^H |",
        "|---|---|---|---|",
    ]
    for row in rows:
        marks = [
            _yes(row["success_delta"] >= -TOLERANCE - 1e-9),  # two of forty episodes are 5 points
            _yes(row["preference_delta_low"] > 0),
            _yes(row["true_preference_delta_low"] > 0),
        ]
        lines.append(f"| {row['task']}, {row['user']} | " + " | ".join(marks) + " |")
    parts = ["\n".join(lines), *(_beside(cells, rival) for rival in RIVALS)]
    return "\n\n".join(part for part in parts if part)


def _beside(cells: Cells, rival: str) -> str:
    """By how much the method is ahead of another one, where both were run."""
    rows = against(cells, METHOD, rival)
    if not rows:
        return ""
    lines = [
        f"### `{METHOD}` minus `{rival}`, paired by scenario",
        "| task, user | R-hat | r^H | success, points |",
        "|---|---|---|---|",
    ]
    for row in rows:
        changes = [_change(row, "preference"), _change(row, "true_preference", digits=2), _change(row, "success", 100)]
        lines.append(f"| {row['task']}, {row['user']} | " + " | ".join(changes) + " |")
    return "\n".join(lines)


def _spent(cells: Cells) -> str:
    lines = [
        "## What each method needs",
        "Means per fit. Labels are the user's; environment steps and seconds come on top of what is made once for"
        " everybody (frozen policy, pool of clips, response surface of the modes, reward model). Processor seconds are"
        " the fit's, without the evaluation.",
        "",
        "| task | method | fits | labels | environment steps | processor s | wall s |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in spent_rows(cells):
        numbers = [row[name] for name in ("fits", "labels", "environment_steps", "cpu_s", "wall_s")]
        lines.append(f"| {row['task']} | `{row['method']}` | " + " | ".join(f"{value:.0f}" for value in numbers) + " |")
    return "\n".join(lines)


def _costs(cells: Cells) -> str:
    lines = [
        "## The six costs",
        "Sums over an episode, unweighted, as in the paper's r^H (C_v is the speed itself in both cost forms);"
        " change against the reference policy.",
        "",
        "| task, user | method | " + " | ".join(COSTS) + " |",
        "|---" * (2 + len(COSTS)) + "|",
    ]
    for row in cost_rows(cells):
        values = [f"{row[name]:.2f} ({row[f'{name}_delta']:+.2f})" for name in COSTS]
        lines.append(f"| {row['task']}, {row['user']} | `{row['method']}` | " + " | ".join(values) + " |")
    return "\n".join(lines)


def _matrices(cells: Cells, groups: Sequence[Sequence[str]]) -> str:
    """One table per group of users who are compared with each other; the CSV file has everybody for everybody."""
    rows = personalisation_rows(cells, METHOD, groups)
    parts = []
    for task in dict.fromkeys(row["task"] for row in rows):
        gains = {(row["trained_for"], row["judged_by"]): row for row in rows if row["task"] == task}
        users = list(dict.fromkeys(user for user, _ in gains))
        together = [found for group in groups if len(found := [user for user in users if user in group]) > 1]
        tables = [_matrix(found, gains) for found in together or [users] if len(found) > 1]
        if tables:
            introduction = (
                f"## Whose filter serves whom: {task}\n"
                f"Change of the column user's true return under the row user's `{METHOD}`, % of what the column user"
                " minds and likes under the reference policy (taken positively: for the paper's users, of its true"
                " return). Last line: the own filter beyond the best of somebody else's in the same table."
            )
            parts += [introduction, *tables]
    return "\n\n".join(parts)


def _matrix(users: Sequence[str], gains: Mapping[tuple[str, str], Row]) -> str:
    lines = ["| trained for | " + " | ".join(users) + " | success |", "|---" * (len(users) + 2) + "|"]
    for row_user in users:
        values = [_bold(_change(gains[row_user, judge], "gain", 100), row_user == judge) for judge in users]
        success = f"{100 * gains[row_user, row_user]['success_delta']:+.1f}"
        lines.append(f"| {row_user} | " + " | ".join(values) + f" | {success} |")
    own = [gains[user, user] for user in users]
    return "\n".join([*lines, "| own advantage | " + " | ".join(_advantage(row) for row in own) + " | |"])


def _seeds(cells: Cells, groups: Sequence[Sequence[str]]) -> str:
    """What one seed says, another confirms or not: the diagonals of the matrices for each alone."""
    found = {
        (row["task"], row["trained_for"], seed): row
        for seed, of_seed in one_by_one(cells).items()
        for row in personalisation_rows(of_seed, METHOD, groups)
        if row["trained_for"] == row["judged_by"]
    }
    seeds = sorted({seed for _, _, seed in found})
    if len(seeds) < 2:
        return ""
    lines = [
        f"## `{METHOD}`, seed by seed",
        "Other labels, other trainings and other scenarios. Own gain in true return, in % as above; own"
        " filter beyond the best of somebody else's; change of success in points.",
        "",
        "| task, user |" + "".join(f" seed {seed}: gain | advantage | success |" for seed in seeds),
        "|---" * (1 + 3 * len(seeds)) + "|",
    ]
    for task, user in dict.fromkeys((task, user) for task, user, _ in found):
        of_user = [found.get((task, user, seed)) for seed in seeds]
        parts = [
            f"{_change(row, 'gain', 100)} | {_advantage(row)} | {100 * row['success_delta']:+.1f}"
            if row
            else "- | - | -"
            for row in of_user
        ]
        lines.append(f"| {task}, {user} | " + " | ".join(parts) + " |")
    return "\n".join(lines)


def _notes(cells: Cells) -> str:
    lines = [
        f"* {task}, {user}, `{method}`, seed {run.seed}: {' '.join(run.notes)}"
        for (task, user, method), cell in cells.items()
        for run in cell.runs
        if run.notes
    ]
    return "\n".join(["## What the fits say", *lines]) if lines else ""


def _change(row: Row, name: str, factor: float = 1.0, digits: int = 1) -> str:
    value, low, high = (factor * row[key] for key in (name, f"{name}_low", f"{name}_high"))
    return f"{value:+.{digits}f} [{low:+.{digits}f}, {high:+.{digits}f}]"


def _advantage(row: Row) -> str:
    return _change(row, "own_advantage", 100) if row["own_advantage"] != "" else "-"


def _bold(text: str, bold: bool) -> str:
    return f"**{text}**" if bold else text


def _yes(true: bool) -> str:
    return "yes" if true else "**no**"


def _short(value: Any) -> Any:
    return f"{value:.6g}" if isinstance(value, float) else value
