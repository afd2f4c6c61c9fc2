"""Pages that update themselves: server-sent events carry the rows of a page that changed, and only those.

A stream holds neither a database session nor a thread while it waits.
"""

import asyncio
import signal
import threading
from collections.abc import AsyncIterator, Iterator, Mapping
from contextlib import contextmanager, suppress
from types import FrameType
from typing import Any

from anyio import to_thread
from fastapi import Request
from fastapi.sse import ServerSentEvent

from app.errors import AppError
from app.web.http.deps import Studio, experimenter_asking
from app.web.http.shared_pages import Draw, Pieces

NOTICE_EVERY_S = 1.0
"""How soon a stream notices that the server is to stop."""
ASK_AGAIN_S = 5.0
"""How often a login is looked at while nothing is sent; before anything is sent it always is."""


async def redrawn_parts(
    request: Request, studio: Studio, draw: Draw, whose: str = ""
) -> AsyncIterator[ServerSentEvent]:
    """An endless stream of what changed. Ends when the login, the right to look or the page does, or the server stops.

    ``whose``: among whom the page is shared, where people see different things at one address.
    """
    sent: Mapping[str, Pieces] = {}
    loop, asked_at_s = asyncio.get_running_loop(), 0.0
    with studio.shared_pages.watching(f"{whose}{request.url.path}?{request.url.query}", draw) as screen:
        while not studio.closing.is_set() and not screen.ended:
            drawn, parts = screen.drawn, screen.parts
            changes = list(_changes(sent, parts))
            if changes or loop.time() - asked_at_s >= ASK_AGAIN_S:
                if not await to_thread.run_sync(_may_look, request, studio, limiter=screen.threads):
                    yield ServerSentEvent(event="gone", raw_data="")
                    return
                asked_at_s = loop.time()
            for change in changes:
                yield ServerSentEvent(event="fragment", data=change)
            sent = parts
            with suppress(TimeoutError):
                await asyncio.wait_for(drawn.wait(), NOTICE_EVERY_S)
        if screen.is_gone:
            yield ServerSentEvent(event="gone", raw_data="")


def _changes(sent: Mapping[str, Pieces], parts: Mapping[str, Pieces]) -> Iterator[Mapping[str, Any]]:
    """Parts as a whole, or those of their pieces that differ, by their places."""
    for name, pieces in parts.items():
        before = sent.get(name, ())
        if len(before) != len(pieces):
            yield {"name": name, "pieces": pieces}
        elif changed := {place: piece for place, piece in enumerate(pieces) if piece != before[place]}:
            yield {"name": name, "changed": changed}


def _may_look(request: Request, studio: Studio) -> bool:
    with studio.database.reading() as session:
        try:
            experimenter_asking(request, session)
        except AppError:
            return False
    return True


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
