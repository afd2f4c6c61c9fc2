"""Keeps other people's libraries from flooding our terminal and log."""

import logging
import os
import re
import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def silenced_stderr() -> Iterator[None]:
    """Send what native code writes to standard error to nowhere."""
    sys.stderr.flush()
    kept = os.dup(2)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


REPEATED = 3
"""So often a library may say the same: dm_control's inverse kinematics warn at every second reset."""


class FewRepetitions(logging.Filter):
    """Lets the same warning through a few times, whatever numbers it names; errors always."""

    def __init__(self) -> None:
        super().__init__()
        self._seen = Counter[str]()

    def filter(self, record: logging.LogRecord) -> bool:
        """See logging.Filter."""
        if record.levelno >= logging.ERROR:
            return True
        said = re.sub(r"[-+]?\d[\d.e+-]*", "", str(record.msg))
        self._seen[said] += 1
        if self._seen[said] == REPEATED:
            record.msg = f"{record.msg} (said again and again: left out from here on)"
        return self._seen[said] <= REPEATED


@contextmanager
def few_repetitions() -> Iterator[None]:
    """For the loggers of everything that is imported inside."""
    before = set(logging.root.manager.loggerDict)
    try:
        yield
    finally:
        for name in set(logging.root.manager.loggerDict) - before:
            logging.getLogger(name).addFilter(FewRepetitions())
