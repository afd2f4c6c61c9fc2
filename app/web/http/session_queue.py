"""Who may hold a database connection: the others wait in the event loop, where waiting costs nothing.

A request passes through several threads of one small pool (authorising, route, commit). If requests waited for the
write lock inside threads, forty of them would fill the pool, and the one that holds the lock would find no thread to
finish in: with 60 labellers at once every answer then failed with "database is locked". One at a time, they all pass.
"""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from weakref import WeakKeyDictionary

from fastapi.concurrency import contextmanager_in_threadpool
from sqlalchemy.orm import Session

from app.db import Database

READERS = 6
WRITERS = 8
"""Both together stay below the connections that there may be."""


class SessionQueue:
    """Sessions on the database for requests, a limited number at a time and first come, first served."""

    def __init__(self, database: Database) -> None:
        self._database = database
        self._writers = 1 if database.is_sqlite else WRITERS
        # A semaphore belongs to one event loop. A server has one; the test client makes one per request.
        self._queues: WeakKeyDictionary[asyncio.AbstractEventLoop, tuple[asyncio.Semaphore, asyncio.Semaphore]]
        self._queues = WeakKeyDictionary()

    @asynccontextmanager
    async def reading(self) -> AsyncIterator[Session]:
        """A session to read with."""
        async with self._of_this_loop()[0], contextmanager_in_threadpool(self._database.reading()) as session:
            yield session

    @asynccontextmanager
    async def writing(self, *, own_rows: bool = False) -> AsyncIterator[Session]:
        """A session to write with, committed when the block ends. ``own_rows``: see app.db.Database.writing()."""
        transaction = self._database.writing(own_rows=own_rows)
        async with self._of_this_loop()[1], contextmanager_in_threadpool(transaction) as session:
            yield session

    def _of_this_loop(self) -> tuple[asyncio.Semaphore, asyncio.Semaphore]:
        loop = asyncio.get_running_loop()
        if loop not in self._queues:
            self._queues[loop] = (asyncio.Semaphore(READERS), asyncio.Semaphore(self._writers))
        return self._queues[loop]
