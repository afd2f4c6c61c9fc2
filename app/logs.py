"""Log lines of both programs: as text for people, or as JSON, with the request or the job they are about."""

import json
import logging
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from datetime import UTC, datetime
from enum import StrEnum

_about: ContextVar[dict[str, str]] = ContextVar("about", default={})  # noqa: B039  (never changed, only replaced)


class LogFormat(StrEnum):
    """How log lines are written."""

    TEXT = "text"
    JSON = "json"


def from_here_about(**fields: str) -> None:
    """Lines logged from now on carry these fields, until the task or thread that calls this ends."""
    _about.set({**_about.get(), **fields})


@contextmanager
def about(**fields: str) -> Iterator[None]:
    """Lines logged inside carry these fields, such as ``request="..."`` or ``job="..."``."""
    token = _about.set({**_about.get(), **fields})
    try:
        yield
    finally:
        _about.reset(token)


def write_to_stderr(form: LogFormat, level: int) -> None:
    """Write every line from ``level`` on, of our code and of libraries, to the standard error stream."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(
        JsonLines() if form is LogFormat.JSON else logging.Formatter("%(asctime)s %(message)s", "%H:%M:%S")
    )
    logging.basicConfig(level=level, handlers=[handler])


class JsonLines(logging.Formatter):
    """One JSON object per line: time (UTC), level, logger, message, traceback, and what the line is about."""

    def format(self, record: logging.LogRecord) -> str:
        """See logging.Formatter."""
        line: dict[str, object] = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
            **_about.get(),
            **getattr(record, "fields", {}),
        }
        if record.exc_info:
            line["traceback"] = self.formatException(record.exc_info)
        return json.dumps(line, ensure_ascii=False, default=str)
