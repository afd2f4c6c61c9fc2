"""Every method for every user of every task, compared."""

import argparse
import sys
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

from app.commands.parsers import Commands, add_command
from app.installed_tasks import catalogue
from app.settings import Settings
from worker.commands import options
from worker.commands.arguments import add_processes
from worker.experiments import benchmark
from worker.experiments.benchmark_cell import INDIRECT_USERS, OPPOSED_USERS
from worker.jobs import experiments
from worker.ml.methods.registry import METHODS

OF_TERMS: options.Table = {
    "labels": ("--labels", "the paper's offline training has 5000"),
    "scenarios": ("--scenarios", "unseen ones"),
    "reward": ("--reward", "the model that is learned from the labels"),
    "rule": ("--rule", "which pairs are asked"),
    "form": ("--form", "of the costs"),
    "manner.mistakes": ("--mistakes", "share of answers that say the opposite"),
    "manner.rationality": ("--rationality", "beta per spread of returns; without it users name the better clip"),
    "methods.fine_tuning.steps": ("--prefft-steps", "environment steps of PrefFT, as in the paper"),
    "methods.from_scratch.steps": ("--pbrl-steps", "environment steps of PbRL-HRI"),
    "methods.printed_steps": ("--printed-steps", "gradient steps of the printed method"),
}
_HOW: Mapping[str, int] = {
    "--work-directory": 1,
    "--output": 1,
    "--processes": 1,
    "--on-workers": 0,
    "--report-only": 0,
}
"""Options that change nothing of what is measured, and how many words follow them."""


def add(commands: Commands) -> None:
    """Add ``benchmark``."""
    usual = benchmark.Selection()
    command = add_command(commands, "benchmark", _benchmark, benchmark.__doc__)
    command.add_argument("--profile", choices=list(benchmark.PROFILES), default="full")
    command.add_argument(
        "--methods",
        nargs="+",
        choices=list(METHODS),
        metavar="METHOD",
        default=list(usual.methods),
        help=f"default: all of {', '.join(METHODS)}",
    )
    command.add_argument("--tasks", nargs="+", choices=catalogue.names(), metavar="NAME", default=list(usual.tasks))
    command.add_argument(
        "--users",
        nargs="+",
        type=options.taste,
        default=list(usual.tastes),
        help="names, or NAME=six weights and costs per signal: shy=1,3,2,2,1,1 or level=1,1,1,1,1,1,tilt_rad:0.3",
    )
    command.add_argument("--opposed", action="store_true", help="also the six users who truly differ")
    command.add_argument(
        "--indirect", action="store_true", help="also three users whose taste no mode axis moves directly"
    )
    command.add_argument("--population", type=int, default=0, help="also so many users drawn at random")
    command.add_argument("--seeds", type=int, default=usual.seeds)
    options.add(command, OF_TERMS, benchmark.PROFILES["full"], only_said=True)
    add_processes(command)
    command.add_argument(
        "--on-workers",
        action="store_true",
        help="have the studio's workers do the cells, --processes each at a time (DATABASE_URL says whose)",
    )
    command.add_argument(
        "--work-directory", type=Path, help="finished cells; default: benchmark/ in the data directory"
    )
    command.add_argument(
        "--output", type=Path, help="tables; default: docs/results/all_methods, or inside the work directory if quick"
    )
    command.add_argument("--report-only", action="store_true", help="run nothing, write the tables from what there is")


def what_is_measured(words: Sequence[str]) -> list[str]:
    """A command line without where and how it is worked on, which is nothing of a table's."""
    kept, left_out = list[str](), 0
    for word in words:
        option, is_whole, _ = word.partition("=")
        if option in _HOW:
            left_out = 0 if is_whole else _HOW[option]
        elif left_out:
            left_out -= 1
        else:
            kept.append(word)
    return kept


def _benchmark(said: argparse.Namespace) -> int:
    """Compare methods in unseen scenarios, by task, user and seed; finished work is kept."""
    terms = options.filled(benchmark.PROFILES[said.profile], OF_TERMS, said)
    others = [
        *(OPPOSED_USERS.values() if said.opposed else ()),
        *(INDIRECT_USERS.values() if said.indirect else ()),
        *benchmark.population(said.population),
    ]
    tastes = {taste.name: taste for taste in [*said.users, *others]}
    selection = benchmark.Selection(said.methods, said.tasks, tuple(tastes.values()), said.seeds)
    settings = Settings()
    work = said.work_directory or experiments.work_directory(settings)
    output = said.output or (work / "quick" if said.profile == "quick" else Path("docs/results/all_methods"))
    command = "python -m worker " + " ".join(what_is_measured(sys.argv[1:]) or ["benchmark"])
    run: benchmark.Run | None = partial(benchmark.on_this_machine, said.processes)
    if said.on_workers:
        run = partial(experiments.on_workers, settings, said.processes)
    return benchmark.benchmark(selection, terms, work, output, command, None if said.report_only else run)
