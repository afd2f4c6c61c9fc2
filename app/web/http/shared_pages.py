"""The pages that somebody looks at: however many look at one, it is drawn once for all of them.

So a drawing must not depend on who looks, and cannot: it is made from a session and nothing else. Pages are drawn when
something has changed, one drawing of a page at a time, and a thirtieth of a core at most goes into each.
"""

import asyncio
import re
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import timedelta

from anyio import CapacityLimiter, to_thread
from sqlalchemy.orm import Session

from app.db import Database, now
from app.errors import AppError
from app.services.monitoring import dashboard

LOOK_EVERY_S = 1.0
REST = 29.0
"""Times as long as the last drawing took of a processor, before the next one."""
REDRAW_AFTER = timedelta(seconds=20)
"""Even when no row changed, "3 min ago" and a silent worker do."""

Draw = Callable[[Session], Mapping[str, str]]
"""Draws the parts of a page, by the names in its data-fragment attributes."""
Pieces = Sequence[str]
"""A part, cut where its rows begin."""

_ROW = re.compile(r"(?=<[a-z]+\b[^>]*\bdata-row=)")


class SharedPages:
    """The pages that somebody looks at, each drawn once for all who do."""

    def __init__(self, database: Database) -> None:
        self._database = database
        self._screens: dict[str, Screen] = {}

    @contextmanager
    def watching(self, path: str, draw: Draw) -> Iterator["Screen"]:
        """The screen of the page at this path, kept up to date until the last one looks away."""
        screen = self._screens.get(path)
        if screen is None or screen.ended:
            screen = self._screens[path] = Screen(self._database, draw)
        screen.watchers += 1
        try:
            yield screen
        finally:
            screen.watchers -= 1
            if not screen.watchers:
                screen.close()
                if self._screens.get(path) is screen:
                    del self._screens[path]


class Screen:
    """One page as it is now."""

    def __init__(self, database: Database, draw: Draw) -> None:
        self.watchers = 0
        self.parts: Mapping[str, Pieces] = {}
        self.is_gone = False
        """There is no such page any more."""
        self.drawn = asyncio.Event()
        """set with the next drawing, which has an event of its own"""
        self.threads = CapacityLimiter(1)
        """one drawing, or one look at a watcher's login, at a time"""
        self._database, self._draw = database, draw
        self._fingerprint: str | None = None
        self._drawn_at = now()
        self._task = asyncio.create_task(self._keep_up())
        self._task.add_done_callback(lambda _: self.drawn.set())

    @property
    def ended(self) -> bool:
        """Whether nothing will be drawn any more."""
        return self._task.done()

    def close(self) -> None:
        """Draw no more."""
        self._task.cancel()

    async def _keep_up(self) -> None:
        while True:
            try:
                parts, took_s = await to_thread.run_sync(self._look, limiter=self.threads)
            except AppError:
                self.is_gone = True
                return
            if parts is not None:
                self.parts = {name: _ROW.split(text) for name, text in parts.items()}
                self.drawn.set()
                self.drawn = asyncio.Event()
            await asyncio.sleep(max(LOOK_EVERY_S, REST * took_s))

    def _look(self) -> tuple[Mapping[str, str] | None, float]:
        """The parts, unless nothing has changed, and the seconds of a processor that it took."""
        started_s = time.thread_time()
        with self._database.reading() as session:
            fingerprint = dashboard.fingerprint(session)
            if fingerprint == self._fingerprint and now() - self._drawn_at < REDRAW_AFTER:
                return None, 0.0
            parts = self._draw(session)
        self._fingerprint, self._drawn_at = fingerprint, now()
        return parts, time.thread_time() - started_s
