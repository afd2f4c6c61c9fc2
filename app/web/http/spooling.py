"""Long answers for slow readers: the database is read at its own pace into a file, and the file at the reader's.

A reader who stops reading then holds a file, never a turn at the database or a snapshot of it.
"""

import asyncio
import os
import tempfile
import threading
from collections.abc import AsyncIterator, Callable, Iterator
from typing import IO

from fastapi.concurrency import run_in_threadpool
from sqlalchemy.orm import Session

from app.web.http.session_queue import SessionQueue

CHUNK_BYTES = 64 * 1024


async def spooled(session_queue: SessionQueue, texts: Callable[[Session], Iterator[str]]) -> AsyncIterator[bytes]:
    """What ``texts`` yields, sent while it is still being written. Writing stops when nobody reads any more."""
    file = tempfile.TemporaryFile()  # noqa: SIM115  (closed when its writer has ended, which may be later)
    written, gone = asyncio.Event(), threading.Event()
    writer = asyncio.create_task(_write(session_queue, texts, file, written, gone))
    writer.add_done_callback(lambda _: written.set())
    try:
        offset, finished = 0, False
        while not finished:
            await written.wait()
            written.clear()
            finished = writer.done()  # asked before reading, so that its last words are not missed
            while chunk := await run_in_threadpool(os.pread, file.fileno(), CHUNK_BYTES, offset):
                offset += len(chunk)
                yield chunk
        writer.result()
    finally:
        gone.set()
        writer.add_done_callback(lambda _: file.close())


async def _write(
    session_queue: SessionQueue,
    texts: Callable[[Session], Iterator[str]],
    file: IO[bytes],
    written: asyncio.Event,
    gone: threading.Event,
) -> None:
    loop = asyncio.get_running_loop()

    def write(session: Session) -> None:
        for text in texts(session):
            if gone.is_set():
                return
            file.write(text.encode())
            file.flush()
            loop.call_soon_threadsafe(written.set)

    async with session_queue.reading() as session:
        await run_in_threadpool(write, session)
