"""A stop that comes in every state: what is asked for by a signal is done in good order, or else at once.

Python runs a signal's handler between two steps of the main thread, which may be inside a call that takes long (a
locked database, an import, a machine out of memory). So a thread listens that does nothing else.
"""

import logging
import os
import signal
import socket
import threading
import time
from collections.abc import Callable
from types import FrameType

from app.programs import asking

log = logging.getLogger("worker")

GOOD_ORDER_S = 7.0
"""Longer than this nobody waits; the supervisor (``python -m app up``) kills soon afterwards."""


def any_signal_is_ctrl_c() -> None:
    """For commands that work and then end: whoever asks them to stop gets what Ctrl-C gets, tidying up included.

    Asked again, they go on tidying up.
    """

    def interrupt(_number: int, _frame: FrameType | None) -> None:
        for number in asking():
            signal.signal(number, signal.SIG_IGN)
        raise KeyboardInterrupt

    for number in asking():
        signal.signal(number, interrupt)


class Stop:
    """Set by SIGINT, SIGTERM and SIGHUP; the process ends soon after, whatever it is doing. Made in the main thread."""

    def __init__(self) -> None:
        self.asked = threading.Event()
        self.at_once: Callable[[], None] = lambda: None
        """what must not be left behind when there is no time for good order"""
        ear, mouth = socket.socketpair()
        mouth.setblocking(False)
        self._mouth = mouth  # or it would be closed
        signal.set_wakeup_fd(mouth.fileno(), warn_on_full_buffer=False)
        for number in asking():
            signal.signal(number, lambda _number, _frame: None)
        threading.Thread(target=self._listen, args=(ear,), name="stop", daemon=True).start()

    def _listen(self, ear: socket.socket) -> None:
        ear.recv(1)
        self.asked.set()
        time.sleep(GOOD_ORDER_S)
        log.warning("not everything could be stopped in good order; what was unfinished will be taken up again")
        self.at_once()
        os._exit(1)
