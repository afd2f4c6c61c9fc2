"""Who may hold a database connection: the others wait in the event loop, where waiting costs nothing.

A request passes through several threads of one small pool (authorising, route, commit). If requests waited for the
write lock inside threads, forty of them would fill the pool, and the one that holds the lock would find no thread to
finish in: with 60 labellers at once every answer then failed with "database is locked". One at a time, they all pass.
"""

import asyncio
from collections import deque
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager
from contextvars import copy_context
from typing import Any, TypeAlias, TypeVar
from weakref import WeakKeyDictionary

from fastapi.concurrency import contextmanager_in_threadpool, run_in_threadpool
from sqlalchemy.exc import OperationalError
from sqlalchemy.orm import Session

from app.db import Database

READERS = 6
WRITERS = 8
"""Both together stay below the connections that there may be."""
TOGETHER = 8
"""Steps that share a commit at most: the first of them waits for the last."""

T = TypeVar("T")
Step: TypeAlias = Callable[[Session], T]
"""What one request does on the database, from its first look to its last row."""


class SessionQueue:
    """Sessions on the database for requests, a limited number at a time and first come, first served."""

    def __init__(self, database: Database) -> None:
        self._database = database
        # A semaphore belongs to one event loop. A server has one; the test client makes one per request.
        self._queues: WeakKeyDictionary[asyncio.AbstractEventLoop, _Queues] = WeakKeyDictionary()

    @asynccontextmanager
    async def reading(self) -> AsyncIterator[Session]:
        """A session to read with."""
        async with self._of_this_loop().readers, contextmanager_in_threadpool(self._database.reading()) as session:
            yield session

    @asynccontextmanager
    async def writing(self) -> AsyncIterator[Session]:
        """A session to write with, committed when the block ends."""
        async with self._of_this_loop().writers, contextmanager_in_threadpool(self._database.writing()) as session:
            yield session

    async def look(self, step: Step[T]) -> T:
        """What the step returns, from a session to read with: in one thread, where reading() takes a turn in three."""
        async with self._of_this_loop().readers:
            return await run_in_threadpool(self._look, step)

    async def write_own_rows(self, step: Step[T]) -> T:
        """What the step returns, after what it wrote was committed. See ``own_rows`` in app.db.Database.writing().

        On SQLite, steps that wait at the same moment share a commit, whose wait for the disk would otherwise hold up
        all who come after; one that raises is undone alone. PostgreSQL does such a thing by itself.
        """
        queues = self._of_this_loop()
        if not self._database.is_sqlite:
            async with queues.writers:
                return await run_in_threadpool(self._write, step)
        mine: asyncio.Future[T] = asyncio.get_running_loop().create_future()
        context = copy_context()  # so that its lines in the log are about its own request
        queues.steps.append((lambda session: context.run(step, session), mine))
        async with queues.writers:
            while not mine.done():
                await self._write_together([queues.steps.popleft() for _ in range(min(TOGETHER, len(queues.steps)))])
        return mine.result()

    async def _write_together(self, batch: Sequence[tuple[Step[Any], "asyncio.Future[Any]"]]) -> None:
        try:
            outcomes = await run_in_threadpool(self._write_all, [step for step, _ in batch])
        except asyncio.CancelledError:  # the server stops: whether it was committed is not known, so nobody is told
            for _, done in batch:
                done.cancel()
            raise
        for (_, done), outcome in zip(batch, outcomes, strict=True):
            if done.cancelled():
                continue
            if isinstance(outcome, _Raised):
                done.set_exception(outcome.error)
            else:
                done.set_result(outcome)

    def _write_all(self, steps: Sequence[Step[Any]]) -> Sequence[Any]:
        """What each step returned or raised."""
        try:
            with self._database.writing(own_rows=True) as session:
                return [self._undone_alone(session, step) for step in steps] if len(steps) > 1 else [steps[0](session)]
        except Exception as error:  # of the only step, or of the database: then nothing of anybody was saved
            return [_Raised(error) for _ in steps]

    def _undone_alone(self, session: Session, step: Step[Any]) -> Any:
        try:
            with session.begin_nested():
                return step(session)
        except OperationalError:
            raise
        except Exception as error:  # whatever a request raises is told to that request alone
            return _Raised(error)

    def _write(self, step: Step[T]) -> T:
        with self._database.writing(own_rows=True) as session:
            return step(session)

    def _look(self, step: Step[T]) -> T:
        with self._database.reading() as session:
            return step(session)

    def _of_this_loop(self) -> "_Queues":
        loop = asyncio.get_running_loop()
        if loop not in self._queues:
            self._queues[loop] = _Queues(1 if self._database.is_sqlite else WRITERS)
        return self._queues[loop]


class _Queues:
    """Of one event loop."""

    def __init__(self, writers: int) -> None:
        self.readers, self.writers = asyncio.Semaphore(READERS), asyncio.Semaphore(writers)
        self.steps: deque[tuple[Step[Any], asyncio.Future[Any]]] = deque()
        """which nobody has begun"""


class _Raised:
    """What a step raised instead of returning."""

    def __init__(self, error: Exception) -> None:
        self.error = error
