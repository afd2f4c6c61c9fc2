"""How tests wait: for states, however slow the machine is; a deadline only ends a test that would wait for ever."""

import random
import signal
import socket
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

PATIENCE_S = 300.0
FIXED_PORTS = range(20_000, 32_000)
"""Below those that systems hand out to outgoing connections, which could take a port before its server does."""


def free_port() -> int:
    """A port at which nobody listens, drawn by the system: tests beside this one may have seeded ``random`` alike."""
    while True:
        port = random.SystemRandom().choice(FIXED_PORTS)
        with socket.socket() as probe, suppress(OSError):
            probe.bind(("127.0.0.1", port))
            return port


def until(condition: Callable[[], bool]) -> bool:
    """Whether it became true in time."""
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        if time.monotonic() > deadline:
            return False
        threading.Event().wait(0.05)
    return True


def gone(pid: int) -> bool:
    """Whether the process has ended; one that nobody has asked for its exit code has."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] == "Z"
    except FileNotFoundError:
        return True


def hear_hangups() -> None:
    """In a process that is about to become a program: even if the suite itself runs under nohup."""
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
