"""A small policy server, real and in a thread: answers over a websocket as openpi's does."""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from websockets.exceptions import ConnectionClosed
from websockets.sync.server import ServerConnection, serve

from worker.ml.policies.policy_client import packed, unpacked

Answer = Callable[[dict[str, Any]], Any]


def to_goal(message: dict[str, Any]) -> dict[str, Any]:
    """A chunk of four actions towards the goal, for the plane of conftest: its observation is place and goal."""
    seen = np.asarray(message["observation"], np.float64)
    action = 0.1 * np.tanh(4.0 * (seen[2:4] - seen[0:2]))
    return {"actions": np.repeat(action[None], 4, axis=0), "server_timing": {"infer_ms": 0.1}}


@contextmanager
def serving(
    answer: Answer = to_goal, metadata: Any = None, asked: list[dict[str, Any]] | None = None, port: int = 0
) -> Iterator[str]:
    """The address of a server. What ``answer`` returns is packed; text and bytes are sent as they are; None: nothing is
    said any more; an exception hangs up. ``asked``: is given every message."""
    done = threading.Event()

    def handle(connection: ServerConnection) -> None:
        connection.send(packed({"robot": "point"}) if metadata is None else metadata)
        try:
            for stored in connection:
                assert isinstance(stored, bytes)
                message = unpacked(stored)
                if asked is not None:
                    asked.append(message)
                said = answer(message)
                if said is None:
                    done.wait()
                    return
                connection.send(said if isinstance(said, str | bytes) else packed(said))
        except (ConnectionClosed, ConnectionError):
            pass

    with serve(handle, "127.0.0.1", port, compression=None) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield f"ws://127.0.0.1:{server.socket.getsockname()[1]}"
        finally:
            done.set()
            server.shutdown()
            thread.join()
