"""Arguments that several commands have."""

import argparse

from app.installed_tasks import catalogue


def add_processes(command: argparse.ArgumentParser) -> None:
    """Add ``--processes``."""
    command.add_argument("--processes", type=int, default=2)


def add_task(command: argparse.ArgumentParser) -> None:
    """Add ``--task``: one of those installed."""
    command.add_argument("--task", type=catalogue.as_argument, metavar="NAME", default=catalogue.usual())
