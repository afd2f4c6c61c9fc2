"""Failed logins and refusals for the audit log: written down so seldom that nobody fills a disk with them.

Of an account the 1st, 10th, 100th, ... within an hour is a row. Names that no account has are counted together and
never written down: people type passwords there.
"""

import math
from collections.abc import Callable
from datetime import datetime, timedelta
from threading import Lock

from app.db import now

COUNTED_FOR = timedelta(hours=1)
UNKNOWN_NAME = "a name that no account has"
WRONG_TOKEN = "a token that is not valid"  # noqa: S105  (no password)


class HourlyCounts:
    """Counts of one web process. ``clock``: the time."""

    def __init__(self, clock: Callable[[], datetime] = now) -> None:
        self._clock = clock
        self._lock = Lock()
        self._counts: dict[str, tuple[datetime, int]] = {}
        """by name: since when, how many; accounts and studies that there are, so they are few"""

    def count(self, name: str) -> int | None:
        """How many there are now within the hour, when that is to be written down."""
        with self._lock:
            since, before = self._counts.get(name, (self._clock(), 0))
            if self._clock() - since >= COUNTED_FOR:
                since, before = self._clock(), 0
            self._counts[name] = since, before + 1
        return before + 1 if math.log10(before + 1).is_integer() else None


def in_words(subject: str, count: int) -> str:
    """The subject of the row."""
    return subject if count == 1 else f"{subject} ({count} times within an hour)"
