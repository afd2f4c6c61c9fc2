"""How tests wait: for states, however slow the machine is; a deadline only ends a test that would wait for ever."""

import random
import socket
from contextlib import suppress

PATIENCE_S = 300.0
FIXED_PORTS = range(20_000, 32_000)
"""Below those that systems hand out to outgoing connections, which could take a port before its server does."""


def free_port() -> int:
    """A port at which nobody listens."""
    while True:
        port = random.choice(FIXED_PORTS)  # noqa: S311
        with socket.socket() as probe, suppress(OSError):
            probe.bind(("127.0.0.1", port))
            return port
