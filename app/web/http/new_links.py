"""Hands new personal links to the experimenter who asked for them. In memory only: the database keeps hashes."""

import secrets
import time
from collections.abc import Sequence
from dataclasses import dataclass
from threading import Lock

KEPT_S = 600.0


@dataclass(frozen=True)
class NewLink:
    """A participant's code and personal link."""

    code: str
    url: str


class NewLinks:
    """Links wait here between the form that made them and the page that shows them, and are forgotten soon after."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._waiting: dict[str, tuple[int, float, Sequence[NewLink]]] = {}

    def leave(self, experimenter_id: int, links: Sequence[NewLink]) -> str:
        """Keep the links for their experimenter; returns the key that picks them up."""
        key, moment = secrets.token_urlsafe(16), time.monotonic()
        with self._lock:
            self._waiting = {each: entry for each, entry in self._waiting.items() if entry[1] > moment}
            self._waiting[key] = (experimenter_id, moment + KEPT_S, links)
        return key

    def pick_up(self, experimenter_id: int, key: str) -> Sequence[NewLink]:
        """The links left under this key; nothing for others, and nothing after ten minutes."""
        with self._lock:
            owner, expires, links = self._waiting.get(key, (0, 0.0, ()))
        return links if owner == experimenter_id and expires > time.monotonic() else ()
