"""Pages that update themselves: server-sent events carry redrawn parts of a page, and only those that changed.

A stream holds neither a database session nor a thread while it waits; each look takes one for some milliseconds.
"""

import signal
import threading
from asyncio import sleep
from collections.abc import AsyncIterator, Callable, Iterator, Mapping
from contextlib import contextmanager
from datetime import timedelta
from types import FrameType
from typing import Any

from anyio import CapacityLimiter, to_thread
from fastapi import Request
from fastapi.sse import ServerSentEvent
from sqlalchemy.orm import Session

from app.db import now
from app.errors import AppError
from app.services import dashboard
from app.web.deps import Studio, experimenter_asking

LOOK_EVERY_S = 1.0
REDRAW_AFTER = timedelta(seconds=20)
"""Even when no row changed, "3 min ago" and a silent worker do."""

Draw = Callable[[Session], Mapping[str, str]]
"""Draws the parts of a page, by the names in its data-fragment attributes."""


async def redrawn_parts(request: Request, studio: Studio, draw: Draw) -> AsyncIterator[ServerSentEvent]:
    """An endless stream of the parts that changed. Ends when the login does, or the server stops."""
    watch, threads = _Watch(request, studio, draw), CapacityLimiter(1)
    while not studio.closing.is_set():
        try:
            changed = await to_thread.run_sync(watch.look, limiter=threads)
        except AppError:
            yield ServerSentEvent(event="gone", raw_data="")
            return
        for name, text in changed.items():
            yield ServerSentEvent(event="fragment", data={"name": name, "html": text})
        await sleep(LOOK_EVERY_S)


class _Watch:
    """What one open page has been sent."""

    def __init__(self, request: Request, studio: Studio, draw: Draw) -> None:
        self._request, self._studio, self._draw = request, studio, draw
        self._fingerprint: str | None = None
        self._drawn_at = now()
        self._sent: dict[str, str] = {}

    def look(self) -> Mapping[str, str]:
        """The parts that differ from what was sent. Raises AppError when the person may not look any more."""
        with self._studio.database.reading() as session:
            experimenter_asking(self._request, session)
            fingerprint = dashboard.fingerprint(session)
            if fingerprint == self._fingerprint and now() - self._drawn_at < REDRAW_AFTER:
                return {}
            parts = self._draw(session)
        changed = {name: text for name, text in parts.items() if self._sent.get(name) != text}
        self._sent |= changed
        self._fingerprint, self._drawn_at = fingerprint, now()
        return changed


@contextmanager
def closing_on_signals(closing: threading.Event) -> Iterator[None]:
    """Set the event as soon as the server is told to stop; it would otherwise wait for streams that never end."""
    if threading.current_thread() is not threading.main_thread():
        yield
        closing.set()
        return
    before: dict[signal.Signals, Any] = {}

    def note(number: int, frame: FrameType | None) -> None:
        closing.set()
        earlier = before[signal.Signals(number)]
        if callable(earlier):
            earlier(number, frame)

    for number in (signal.SIGINT, signal.SIGTERM):
        before[number] = signal.signal(number, note)
    try:
        yield
    finally:
        closing.set()
        for number, earlier in before.items():
            signal.signal(number, earlier)
