"""What the supervisor notes when a program falls, for the dashboard to tell: how often, since when, and its last words.

A file and not a table: a program may fall because the database cannot be written.
"""

import json
import logging
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path

_FILE = "falls.json"

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Falls:
    """How often a program has stopped by itself in a row."""

    program: str
    count: int
    since: datetime
    last_words: str
    """The last line it wrote; it may name files, and is for experimenters only."""


def note(data_dir: Path, falls: Sequence[Falls]) -> None:
    """Replace what was noted before. A disk that is full does not stop the supervisor."""
    path = data_dir / _FILE
    text = json.dumps([{**asdict(each), "since": each.since.isoformat()} for each in falls])
    draft = path.with_suffix(".writing")
    try:
        descriptor = os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
        with os.fdopen(descriptor, "w") as stream:
            stream.write(text)
        draft.replace(path)
    except OSError as error:
        log.warning("%s could not be written: %s", path, error.strerror)


def noted(data_dir: Path) -> list[Falls]:
    """What is noted now; nothing when nothing is, or when it cannot be read."""
    try:
        rows = json.loads((data_dir / _FILE).read_text())
        return [Falls(**{**row, "since": datetime.fromisoformat(row["since"])}) for row in rows]
    except (OSError, ValueError, TypeError, KeyError):
        return []
