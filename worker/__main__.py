"""The command line of the worker: ``python -m worker run`` is the service, the rest are tools."""

import argparse
import sys
from collections.abc import Sequence

from app.errors import AppError
from app.settings import Settings
from worker import commands, service


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m worker", description=__doc__)
    chosen = parser.add_subparsers(dest="command", required=True)
    chosen.add_parser("run", help=service.run.__doc__).set_defaults(act=lambda _options: service.run(Settings()))
    commands.add_to(chosen)
    options = parser.parse_args(arguments)
    try:
        result: int = options.act(options)
    except AppError as error:
        sys.stderr.write(f"Error: {error.message}\n")
        return 1
    return result


if __name__ == "__main__":
    sys.exit(main())
