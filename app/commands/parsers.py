"""Commands of a command line, each with its help."""

import argparse
from collections.abc import Callable
from typing import TypeAlias

Commands: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"


def add_command(
    commands: Commands, name: str, act: Callable[..., int], longer: str | None = None
) -> argparse.ArgumentParser:
    """Add a command that does ``act``; its docstring stands in the list of commands and begins the command's own help.

    ``longer``: what stands there instead, with its lines as they are.
    """
    summary = " ".join((act.__doc__ or "").split())
    how = argparse.RawDescriptionHelpFormatter if longer else argparse.HelpFormatter
    command = commands.add_parser(name, help=summary, description=longer or summary, formatter_class=how)
    command.set_defaults(act=act)
    return command
