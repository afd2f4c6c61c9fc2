"""The comparison as a page for people: what came out, where a baseline is better, how it was made.

Every table and every sentence with a number follows from the CSV files and made.json beside the page.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from worker.analysis.comparison import pareto, result_pages
from worker.analysis.comparison.comparison_rows import REFERENCE, Row, compared
from worker.analysis.comparison.published import published
from worker.analysis.comparison.table_files import DESCRIPTIONS, Tables, default_in, read

TOLERANCE = 0.05
"""Largest loss of success with which a method counts as keeping the task."""

HEAD = "# Methods compared: the paper's Table I, measured here"

READING = """\
Rows of `reference` are levels; all others are changes against the reference policy in the same scenarios, with their
95 % interval over scenarios: neither another seed of labels nor another training is in it. Success is in points. R-hat
is the return of the user's learned reward model, with mean 0 and standard deviation 1 per step over the reference
policy's rollouts; all methods of a user and seed are judged by the same model. r^H is the scripted user's true
preference, which no method has seen. The paper's changes are copied from its Table I; its returns have another zero and
unit, so compare signs and order, not sizes. Its PbARL (n = 10) stands beside both `pbarl` (the studio's default) and
`pbarl_printed`."""


def page(folder: Path) -> str:
    """The page of a folder, with what somebody has written above the mark."""
    return result_pages.page(folder / "table1.md", HEAD, generated(*read(folder)))


def generated(tables: Tables, made: Mapping[str, Any]) -> str:
    """All below the mark."""
    parts = [
        _claim(tables),
        _baselines(tables),
        _personal(tables, made["groups"]),
        _seeds(tables),
        _methods(tables),
        _effort(tables),
        _made(made),
        _files(tables),
    ]
    return "\n\n".join(part for part in parts if part)


def _default(tables: Tables) -> str:
    return default_in({row["method"] for row in tables["table1"]})


def _claim(tables: Tables) -> str:
    """The paper's sentence, "PbARL keeps the task and raises the preference", with every exception by name."""
    default = _default(tables)
    rows = [row for row in tables["table1"] if row["method"] == default]
    if not rows:
        return ""
    failing = {
        f"keeps the task (loses at most {100 * TOLERANCE:.0f} points of success)": [
            row
            for row in rows
            if row["success_delta"] < -TOLERANCE - 1e-9  # two of forty episodes are 5 points
        ],
        "raises R-hat (interval above 0)": [row for row in rows if row["preference_delta_low"] <= 0],
        "raises r^H (interval above 0)": [row for row in rows if row["true_preference_delta_low"] <= 0],
    }
    lines = [f"## `{default}`, cell by cell", ""]
    for claim, failed in failing.items():
        names = [f"{row['task']}, {row['user']}" for row in failed]
        lines += _counted(f"{claim}: {len(rows) - len(failed)} of {len(rows)}", names)
    return "\n".join(lines)


def _baselines(tables: Tables) -> str:
    """Pair by pair in the same scenarios: how often ahead, and wherever the baseline is."""
    rows = tables["paired"]
    if not rows:
        return ""
    default = _default(tables)
    lines = [
        f"## Where a baseline is better than `{default}`",
        f"Differences `{default}` minus baseline, paired by scenario, in the seeds that both were run with.",
        "Ahead and behind: by more than the 95 % interval.",
        "",
    ]
    for baseline in dict.fromkeys(row["baseline"] for row in rows):
        of_baseline = [row for row in rows if row["baseline"] == baseline]
        by_measure = [
            f"by {words} ahead in {sum(row[f'{name}_low'] > 0 for row in of_baseline)},"
            f" behind in {sum(row[f'{name}_high'] < 0 for row in of_baseline)}"
            for name, words in (("preference", "R-hat"), ("true_preference", "r^H"))
        ]
        lines.append(f"* `{baseline}`, {len(of_baseline)} pairs of task and user: {'; '.join(by_measure)}.")
    behind = [row for row in rows if row["preference_high"] < 0 or row["true_preference_high"] < 0]
    if behind:
        lines += ["", "| task, user | baseline | R-hat | r^H | success, points |", "|---|---|---|---|---|"]
    for row in behind:
        cells = [_change(row, "preference"), _change(row, "true_preference", digits=2), _change(row, "success", 100)]
        lines.append(f"| {row['task']}, {row['user']} | `{row['baseline']}` | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _personal(tables: Tables, groups: Sequence[Sequence[str]]) -> str:
    """Whose filter serves whom: own gains, the first group's matrix, and whoever is better served by another filter."""
    rows = tables["personalisation"]
    parts = []
    for number, group in enumerate(groups):
        of_group = [row for row in rows if row["trained_for"] in group and row["judged_by"] in group]
        own = [row for row in of_group if row["trained_for"] == row["judged_by"] and row["own_advantage"] != ""]
        if own:
            parts.append(_group(own) + ("\n\n" + _matrix(of_group) if number == 0 else ""))
    if not parts:
        return ""
    method = _default(tables)
    introduction = f"""\
## Whose filter serves whom
Every user of a task is served by every `{method}` filter of the group. Gains are changes of that user's true return, in
% of what they mind and like under the reference policy; the own filter's advantage is over the best of somebody else's
in the group, chosen on the same scenarios. Success is in points. Everybody for everybody:
[personalisation.csv](personalisation.csv)."""
    return "\n\n".join([introduction, *parts])


def _group(own: Sequence[Row]) -> str:
    users = list(dict.fromkeys(row["judged_by"] for row in own))
    tasks = list(dict.fromkeys(row["task"] for row in own))
    unsure = [
        f"{row['task']}, {row['judged_by']}: {_change(row, 'own_advantage', 100)}"
        for row in own
        if row["own_advantage_low"] <= 0
    ]
    best = sum(row["own_advantage"] > 0 for row in own)
    lines = [
        f"### {', '.join(users)}",
        *_counted(
            f"Own filter best in {best} of {len(own)} columns, with an interval above 0 in {len(own) - len(unsure)}",
            unsure,
        ),
        "",
        "| user |" + "".join(f" {task}: own gain, % | advantage | success |" for task in tasks),
        "|---" * (1 + 3 * len(tasks)) + "|",
    ]
    for user in users:
        found = {row["task"]: row for row in own if row["judged_by"] == user}
        cells = [_own(found[task]) if task in found else "- | - | -" for task in tasks]
        lines.append(f"| {user} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _matrix(rows: Sequence[Row]) -> str:
    users, tasks = (list(dict.fromkeys(row[name] for row in rows)) for name in ("judged_by", "task"))
    gains = {(row["task"], row["trained_for"], row["judged_by"]): row for row in rows}
    lines = [
        "| trained for | judged by |" + "".join(f" {task}: gain, % |" for task in tasks),
        "|---" * (2 + len(tasks)) + "|",
    ]
    for trained_for in users:
        for judge in users:
            found = [gains.get((task, trained_for, judge)) for task in tasks]
            cells = [_bold(_change(row, "gain", 100), trained_for == judge) if row else "-" for row in found]
            lines.append(f"| {trained_for} | {judge} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _own(row: Row) -> str:
    success = f"{100 * row['success_delta']:+.1f}"
    return f"{_change(row, 'gain', 100)} | {_change(row, 'own_advantage', 100)} | {success}"


def _seeds(tables: Tables) -> str:
    """What one seed says, another confirms or not."""
    rows = [row for row in tables["seeds"] if row["own_advantage"] != ""]
    seeds = sorted({row["seed"] for row in rows})
    if len(seeds) < 2:
        return ""
    lines = ["## Seed by seed", "Other labels, other trainings and other scenarios ([seeds.csv](seeds.csv)).", ""]
    for seed in seeds:
        of_seed = [row for row in rows if row["seed"] == seed]
        unsure = [
            f"{row['task']}, {row['user']}: {_change(row, 'own_advantage', 100)}"
            for row in of_seed
            if row["own_advantage_low"] <= 0
        ]
        worst = min(100 * row["success_delta"] for row in of_seed)
        lines += _counted(
            f"Seed {seed:.0f}: success at worst {worst:+.1f} points; own filter best with an interval above 0 in"
            f" {len(of_seed) - len(unsure)} of {len(of_seed)} columns",
            unsure,
        )
    return "\n".join(lines)


def _methods(tables: Tables) -> str:
    shown = compared(tables["table1"])
    parts = ["## Every method\n" + READING]
    pictures = pareto.names(tables["table1"])
    for task in dict.fromkeys(row["task"] for row in shown):
        head = ["| user | method | seeds | success | paper | R-hat | paper | r^H |", "|---" * 8 + "|"]
        parts.append(
            "\n".join(
                [f"### {task}", *_picture(task, pictures), *head, *(_line(row) for row in shown if row["task"] == task)]
            )
        )
    return "\n\n".join(parts)


def _picture(task: str, pictures: Mapping[str, str]) -> list[str]:
    if task not in pictures:
        return []
    return [
        f"![{task}: success and change of r^H of every method, a panel per user; the numbers are in the table"
        f" below]({pictures[task]})",
        "",
        f"*Up and to the right is better; bars are 95 % intervals. What loses more than {100 * pareto.LARGEST_LOSS:.0f}"
        " points of success is in the table alone.*",
        "",
    ]


def _line(row: Row) -> str:
    paper, base = (published(row["task"], row["user"], name) for name in (row["method"], REFERENCE))
    if row["method"] == REFERENCE:
        numbers = [f"{100 * row['success']:.1f} %", f"{row['preference']:.1f}", f"{row['true_preference']:.2f}"]
        theirs = [f"{base[0]:.0f} %", f"{base[1]:.1f}"] if base else ["-", "-"]
    else:
        numbers = [
            _change(row, "success_delta", 100),
            _change(row, "preference_delta"),
            _change(row, "true_preference_delta", digits=2),
        ]
        theirs = [f"{paper[0] - base[0]:+.0f}", f"{paper[1] - base[1]:+.1f}"] if paper and base else ["-", "-"]
    cells = [numbers[0], theirs[0], numbers[1], theirs[1], numbers[2]]
    return f"| {row['user']} | `{row['method']}` | {row['seeds']:.0f} | " + " | ".join(cells) + " |"


def _effort(tables: Tables) -> str:
    """Environment steps and processor seconds per fit."""
    rows = {(row["task"], row["method"]): row for row in tables["effort"] if row["method"] != REFERENCE}
    tasks = list(dict.fromkeys(task for task, _ in rows))
    lines = [
        "## What a fit needs",
        "Environment steps and processor seconds, means over users and seeds. Left out: the evaluation and what is",
        "made once for everybody (frozen policy, pool of clips, response surface) or once per user (reward model).",
        "",
        "| method |" + "".join(f" {task}: steps | s |" for task in tasks),
        "|---" * (1 + 2 * len(tasks)) + "|",
    ]
    for method in dict.fromkeys(method for _, method in rows):
        found = [rows.get((task, method)) for task in tasks]
        cells = [f"{row['environment_steps']:.0f} | {row['cpu_s']:.0f}" if row else "- | -" for row in found]
        lines.append(f"| `{method}` | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _made(made: Mapping[str, Any]) -> str:
    """How to repeat it."""
    policies = ", ".join(f"{task} {mark}" for task, mark in made["policies"].items())
    states = ", ".join(f"{state} ({count} runs)" for state, count in made["code"].items())
    return "\n".join(
        [
            "## How it was made",
            *(f"    {command}" for command in made["commands"]),
            "",
            f"* {made['cells']} cells of task, user and method; seeds {', '.join(map(str, made['seeds']))}.",
            f"* {made['labels']} scripted labels per user and seed ({made['manner']}), {made['pool_scenarios']}"
            f" scenarios of clips, pairs chosen by `{made['rule']}`, reward model `{made['reward']}`, costs in the"
            f" `{made['form']}` form.",
            f"* {made['scenarios']} scenarios per seed, from {made['first_scenario']} on, that no clip, surface, gate"
            " or training uses.",
            f"* Environment steps: PrefFT {made['prefft_steps']}, PbRL-HRI {made['pbrl_hri_steps']}; gradient steps of"
            f" printed PbARL {made['printed_steps']}.",
            f"* {made['versions']}. Frozen policies: {policies}.",
            f"* State of the learning and simulation code, as a hash: {states}.",
        ]
    )


def _files(tables: Tables) -> str:
    lines = [f"* [{name}.csv]({name}.csv): {words}" for name, words in DESCRIPTIONS.items() if tables[name]]
    head = "## Files\nUnrounded, shares instead of points and %: 0.05 is five points or 5 %.\n"
    return "\n".join([head, *lines, "* [made.json](made.json): how they were made"])


def _counted(claim: str, exceptions: Sequence[str]) -> list[str]:
    """A claim and every exception by name."""
    return [f"* {claim}{': all but' if exceptions else '.'}", *(f"  * {each}" for each in exceptions)]


def _change(row: Row, name: str, factor: float = 1.0, digits: int = 1) -> str:
    value, low, high = (factor * row[key] for key in (name, f"{name}_low", f"{name}_high"))
    return f"{value:+.{digits}f} [{low:+.{digits}f}, {high:+.{digits}f}]"


def _bold(text: str, bold: bool) -> str:
    return f"**{text}**" if bold else text
