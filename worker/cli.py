"""What the worker can be told to do: serve, train the reference policy, explore the modes, rehearse a study."""

import argparse
import sys
from collections.abc import Sequence
from importlib import import_module

from app.installed_tasks import catalogue

MODULES = {
    "run": "service",
    "import-clips": "service",
    "pretrain": "training",
    "explore": "training",
    "archive": "training",
    "archive-policies": "training",
    "archive-policies-in-modes": "training",
    "foresee": "training",
    "start-posture": "new_task",
    "speed-weight": "new_task",
    "check": "new_task",
    "behaviours": "new_task",
    "benchmark": "benchmarking",
    "rehearse": "rehearsing",
    "demo-study": "rehearsing",
}
"""Command -> the module of worker.commands that adds it. Others are not loaded: all together takes seconds."""


def run(arguments: Sequence[str] | None) -> int:
    """Parse the command line and do what it says; returns the exit code."""
    for task in catalogue.installed().broken:
        sys.stderr.write(f"{task.why}\n")
    said = parser(sys.argv[1:] if arguments is None else arguments).parse_args(arguments)
    result: int = said.act(said)
    return result


def parser(arguments: Sequence[str] = ()) -> argparse.ArgumentParser:
    """What can be said on the command line; where it begins with a command, that and those of the same subject."""
    whole = argparse.ArgumentParser(prog="python -m worker", description="The worker of PbARL Studio and its tools.")
    commands = whole.add_subparsers(dest="command", metavar="COMMAND", required=True)
    asked = MODULES.get(arguments[0]) if arguments else None
    for name in dict.fromkeys(MODULES.values()) if asked is None else [asked]:
        import_module(f"worker.commands.{name}").add(commands)
    return whole
