"""Passwords are hashed one at a time, on a thread that steps back for everything else.

A hash takes most of a second of two cores on purpose. Made wherever a request happens to be, two dozen wrong logins at
once held every turn at the database and every core: videos waited for six to nine seconds.
"""

import asyncio
import os
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
Made = TypeVar("Made")

NICENESS = 10


class Hashing:
    """A queue of one; whoever waits in it holds no thread and no turn."""

    def __init__(self) -> None:
        self._executor = ThreadPoolExecutor(1, "hashing", initializer=_step_back)

    async def run(self, work: Callable[P, Made], *arguments: P.args, **named: P.kwargs) -> Made:
        """What ``work`` returns or raises."""
        return await asyncio.wrap_future(self._executor.submit(work, *arguments, **named))

    def close(self) -> None:
        """Take nothing more."""
        self._executor.shutdown(wait=False, cancel_futures=True)


def _step_back() -> None:
    """On Linux a priority belongs to a thread, and the threads that argon2 starts inherit it."""
    os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), NICENESS)
