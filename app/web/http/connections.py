"""Connections to the web server: no more than it has files for, and none for long that asks for nothing.

Without bounds, somebody who opens a thousand connections and sends nothing takes every file that the process may open,
and with them everybody's answers. A proxy in front bounds them as well; not every studio has one.
"""

import asyncio
import resource

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

MOST = 8192
"""Connections at a time, where the process may have as many files."""
OTHER_FILES = 256
"""Kept for the database, stored files and whatever else is opened."""
HEAD_S = 20.0
"""From a connection, or the first byte of a later request, until the whole head of the request is here."""
BODY_S = 60.0
"""Without a byte of what a request has announced."""
KEPT_OPEN_S = 75
"""Between two requests. Longer than nginx keeps an idle connection (60 s): whoever sends is who closes, or a request
could meet a connection that the server is just closing."""


def allow_many_files() -> None:
    """Let this process open as many files as it may, up to those of MOST connections; usually it begins with 1024."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = MOST + OTHER_FILES if hard == resource.RLIM_INFINITY else min(hard, MOST + OTHER_FILES)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))


def most_connections() -> int:
    """How many there may be in this process."""
    soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    return MOST if soft == resource.RLIM_INFINITY else max(1, min(MOST, soft - OTHER_FILES))


class Connection(H11Protocol):
    """One connection, which ends when there are too many or when what was begun does not go on."""

    _patience: asyncio.TimerHandle | None = None

    # uvicorn narrows the argument's type as well: a server's connections are always transports that can be written.
    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begin to wait for a request, unless there are too many who do."""
        super().connection_made(transport)
        if len(self.connections) > most_connections():
            transport.abort()
        else:
            self._wait(HEAD_S)

    def connection_lost(self, exc: Exception | None) -> None:
        """Wait no longer."""
        self._wait(None)
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Wait for what is still to come: a head that has begun once, a body again after each part of it."""
        super().data_received(data)
        if self.conn.their_state is h11.SEND_BODY:
            self._wait(BODY_S)
        elif self.conn.their_state is not h11.IDLE:
            self._wait(None)
        elif self._patience is None:
            self._wait(HEAD_S)

    def _wait(self, patience_s: float | None) -> None:
        if self._patience is not None:
            self._patience.cancel()
        self._patience = None if patience_s is None else self.loop.call_later(patience_s, self._lose_patience)

    def _lose_patience(self) -> None:
        if self.conn.their_state is h11.SEND_BODY and self.flow.read_paused:  # it is us who do not read
            self._wait(BODY_S)
        else:
            self.transport.abort()
