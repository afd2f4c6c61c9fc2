"""Errors a person may meet. The docstring is the message; it says what happened and what to do next."""

import errno
import logging
import re
import sqlite3
import time
from http import HTTPStatus
from typing import ClassVar

from pydantic import ValidationError
from sqlalchemy.exc import DBAPIError

COMPLAIN_EVERY_S = 60.0
_MOST_KINDS = 200

_OF_FILES = {
    errno.EACCES: "This account may not write there",
    errno.EPERM: "This account may not write there",
    errno.EROFS: "It lies on a disk that can only be read",
    errno.ENOSPC: "The disk is full",
    errno.EDQUOT: "The quota of this account is used up",
    errno.EEXIST: "A file of this name is where a directory should be",
    errno.ENOTDIR: "A file of this name is where a directory should be",
}
_OF_DATABASES = {
    "readonly database": "it can only be read. Give this account the right to write to it and to its directory.",
    "unable to open": "it cannot be opened. Check that its directory exists and that this account may write there.",
    "is full": "the disk is full. Free some space; nothing that was saved is lost.",
    "disk i/o error": "the disk does not answer as it should, or is full. Free some space and check the disk.",
    "is locked": "another program keeps it locked. Stop whatever else uses it, then try again.",
    "not a database": "the file is not a database, or is damaged. Restore it from a backup.",
    "malformed": "the file is damaged. Restore it from a backup.",
    "lock timeout": "somebody else has been writing to it for too long. Try again, and see who does.",
    "connection refused": "its server does not answer. Check that it runs, and DATABASE_URL.",
    "connection failed": "its server does not let us in. Check DATABASE_URL, and what the server allows.",
    "permission denied": "this account may not do that there. Let it own the database.",
}


class AppError(Exception):
    """Something went wrong. Please try again."""

    status: ClassVar[HTTPStatus] = HTTPStatus.BAD_REQUEST

    def __init__(self, message: str | None = None) -> None:
        self.message = message or " ".join((type(self).__doc__ or "").split())
        super().__init__(self.message)


class Refused(AppError):
    """Your account may not do this."""  # whoever it is, it is known, and kept in the audit log (app.web.http.refusals)

    status: ClassVar[HTTPStatus] = HTTPStatus.FORBIDDEN


EXPLAINED = (AppError, OSError, DBAPIError, sqlite3.Error, ValidationError)
"""What in_words may know."""


def in_words(error: Exception) -> str | None:
    """For somebody at a terminal: what is wrong and what to do. None for a mistake of ours: it needs its traceback."""
    if isinstance(error, AppError):
        return error.message
    if isinstance(error, ValidationError):
        named = [(".".join(map(str, each["loc"])), each["msg"]) for each in error.errors()]
        wrong = "; ".join(f"{name}: {said}" for name, said in named)
        ours = "; ".join(f"{name.upper()}: {said}" for name, said in named)
        return {
            "Settings": f"A setting is not valid. {ours}. Settings come from the environment and from the file .env.",
            "StudySettings": f"A study cannot have these settings. {wrong}.",
            "EvaluationSettings": f"An evaluation cannot have these settings. {wrong}.",
        }.get(error.title)
    if isinstance(error, OSError):
        reason = _OF_FILES.get(error.errno or 0)
        advice = "Mend that, or choose another place: DATA_DIR=/some/directory"
        return f"{error.filename or 'A file'} cannot be written. {reason}. {advice}" if reason else None
    said = str(error.orig if isinstance(error, DBAPIError) else error)
    known = (words for part, words in _OF_DATABASES.items() if part in said.lower())
    return next((f"The database cannot be used: {words}" for words in known), None)


class OncePerMinute(logging.Filter):
    """Lets a complaint pass once a minute and counts the rest: a full disk must not be filled with lines about it.

    Of one kind are lines from one place in the code that differ in nothing but numbers.
    """

    def __init__(self) -> None:
        super().__init__()
        self._passed: dict[tuple[str, int, str], tuple[float, int]] = {}

    def filter(self, record: logging.LogRecord) -> bool:
        """Whether the line is to be written."""
        text = record.getMessage()
        kind = (record.pathname, record.lineno, re.sub(r"[0-9a-f-]*[0-9][0-9a-f-]*", "#", text)[:200])
        moment = time.monotonic()
        passed_at, held_back = self._passed.get(kind, (-COMPLAIN_EVERY_S, 0))
        if moment - passed_at < COMPLAIN_EVERY_S:
            self._passed[kind] = (passed_at, held_back + 1)
            return False
        if len(self._passed) >= _MOST_KINDS:
            self._passed.clear()
        self._passed[kind] = (moment, 0)
        if held_back:
            record.msg, record.args = f"{text} ({held_back} more like it in the last minutes)", ()
        return True
