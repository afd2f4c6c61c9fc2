"""Browsers that have logged in to an account before: guessing by others never shuts them out.

Such a browser keeps a mark that only this server can make, for this account and its present password; nothing is
stored here. A mark opens nothing: it only lets its browser try the password.
"""

import hmac
import re
import secrets
from datetime import timedelta

from app.domain.people import Experimenter

LIFETIME = timedelta(days=365)
_MARK = re.compile(r"[0-9a-f]{32}\.[0-9a-f]{64}")


def new_mark(experimenter: Experimenter) -> str:
    """For a browser that has just logged in."""
    name = secrets.token_hex(16)
    return f"{name}.{_seal(experimenter, name)}"


def name_in(mark: str, experimenter: Experimenter | None) -> str | None:
    """The name of the browser that has this mark; None when the account does not know it (any more)."""
    if experimenter is None or not _MARK.fullmatch(mark):
        return None
    name, _, seal = mark.partition(".")
    return name if hmac.compare_digest(seal, _seal(experimenter, name)) else None


def _seal(experimenter: Experimenter, name: str) -> str:
    words = f"known browser/{experimenter.id}/{name}"
    return hmac.new(experimenter.password_hash.encode(), words.encode(), "sha256").hexdigest()
