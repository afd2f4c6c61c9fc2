"""The command line of the worker: ``python -m worker run`` is the service, the rest are tools."""

import os
import sys
from collections.abc import Sequence

INTERRUPTED = 130
"""Exit code, as shells have it."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code."""
    # Compute processes import this module again when they start. What they need they load themselves, and most of
    # what we need (torch, the engine) they do not.
    from app.errors import EXPLAINED, in_words
    from worker import cli, stop_signals

    stop_signals.any_signal_is_ctrl_c()
    try:
        return cli.run(arguments)
    except EXPLAINED as error:
        words = in_words(error)
        if words is None:
            raise
        sys.stderr.write(f"Error: {words}\n")
        return 1
    except KeyboardInterrupt:
        sys.stderr.write("Interrupted.\n")
        return INTERRUPTED


if __name__ == "__main__":
    exit_code = main()
    sys.stdout.flush()
    sys.stderr.flush()
    # Everything is closed by now. Taking the interpreter apart takes seconds more on a busy machine, waits for threads
    # that wait for a locked file, and is deaf to signals.
    os._exit(exit_code)
