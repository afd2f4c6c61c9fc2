"""Serves policy.onnx over a websocket, in the protocol of openpi's server.

    python examples/reacher/serve_policy.py [PORT]

All that a policy server of your own has to do is in here: metadata first, then a chunk of actions for each observation.
"""

import logging
import sys
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import onnxruntime
from websockets.sync.server import ServerConnection, serve

POLICY = onnxruntime.InferenceSession(str(Path(__file__).with_name("policy.onnx")))
PARTS = ("joints", "target", "tip")


def to_array(found: dict[Any, Any]) -> Any:
    """Arrays travel as bytes, kind of number and shape."""
    if b"__ndarray__" not in found:
        return found
    kind = np.dtype(found[b"dtype"])
    if kind.kind not in "biuf":
        raise ValueError("only arrays of numbers are read")
    return np.frombuffer(found[b"data"], kind).reshape(found[b"shape"]).copy()  # which may be written to


def to_bytes(array: np.ndarray) -> dict[bytes, Any]:
    """What to_array() reads."""
    return {b"__ndarray__": True, b"data": array.tobytes(), b"dtype": array.dtype.str, b"shape": array.shape}


def answer(connection: ServerConnection) -> None:
    """Talk to one client until it goes."""
    connection.send(msgpack.packb({"robot": "Reacher-v5, moved by joint velocities in rad/s"}))
    for stored in connection:
        message = msgpack.unpackb(stored, object_hook=to_array)
        observation = np.concatenate([message[name] for name in PARTS]).astype(np.float32)
        (action,) = POLICY.run(["action"], {"observation": observation[None]})
        connection.send(msgpack.packb({"actions": action}, default=to_bytes))  # (H, A): a chunk of one action


if __name__ == "__main__":
    logging.basicConfig()
    port = int(sys.argv[1]) if len(sys.argv) > 1 else 8000
    with serve(answer, "localhost", port, compression=None) as server:
        print(f"ws://localhost:{server.socket.getsockname()[1]}", flush=True)  # noqa: T201 -- what a program is asked for
        server.serve_forever()
