"""Asks a policy: a server over a websocket, in the protocol of openpi's (MessagePack with NumPy arrays), or a function.

The server sends its metadata first; then it answers each message, a dictionary of arrays, with a dictionary that has
``actions`` (H, A), a chunk of H actions. An answer that is text is an error. What comes from a server is hostile until
it is checked. This file needs no other of the project: bundles contain it, for ``run_filter.py --serve``.
"""

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from typing import Any

import msgpack
import numpy as np
from websockets.exceptions import InvalidHandshake, InvalidURI, WebSocketException
from websockets.sync.client import ClientConnection, connect

LARGEST_BYTES = 64 << 20
MOST_ACTIONS = 10_000
"""Numbers of one chunk."""
CONNECT_S, ANSWER_S = 5.0, 10.0
_KINDS = "biuf"
"""Of arrays that are read: others, objects above all, could run code or crash the process."""


class PolicyServerFailed(Exception):
    """A policy server or function did not do what it must; the message says what happened and what to do."""


def packed(message: Mapping[str, Any]) -> bytes:
    """A message as MessagePack; arrays as openpi writes them."""
    stored: bytes = msgpack.packb(message, default=_array_to_map)
    return stored


def unpacked(stored: bytes) -> dict[str, Any]:
    """What packed() wrote, or openpi. Arrays are copies. Raises ValueError for anything else."""
    try:
        found = msgpack.unpackb(stored, object_hook=_map_to_array, strict_map_key=False)
    except ValueError:
        raise
    except Exception as error:  # msgpack raises many kinds
        raise ValueError(f"{type(error).__name__}: {error}") from error
    if not isinstance(found, dict) or not all(isinstance(key, str) for key in found):
        raise ValueError("it is no dictionary with names")
    return found


class PolicyServer:
    """A connection to a policy server, made when it is first needed and again after it was lost."""

    def __init__(self, url: str, answer_s: float = ANSWER_S) -> None:
        self.url, self._answer_s = url, answer_s
        self._open = ExitStack()
        self._connection: ClientConnection | None = None
        self.metadata: dict[str, Any] = {}
        """what it said of itself at the beginning"""

    def connect(self) -> None:
        """Connect and read the metadata. Raises PolicyServerFailed."""
        self.close()
        try:
            self._connection = self._open.enter_context(
                connect(
                    self.url,
                    compression=None,
                    proxy=None,
                    max_size=LARGEST_BYTES,
                    open_timeout=CONNECT_S,
                    close_timeout=1.0,
                    ping_interval=None,  # a server that computes cannot answer pings; every answer has its own limit
                )
            )
        except InvalidURI as error:
            raise PolicyServerFailed(f"{self.url!r} is no address of a websocket, such as ws://host:8000.") from error
        except InvalidHandshake as error:
            raise PolicyServerFailed(
                f"what answers at {self.url} is no policy server ({error}). Check host, port and path."
            ) from error
        except (OSError, EOFError, WebSocketException) as error:
            raise PolicyServerFailed(
                f"no policy server answers at {self.url} ({error or type(error).__name__}). Start it, and check host "
                "and port."
            ) from error
        self.metadata = self._received("It must send its metadata, a dictionary, when somebody connects.", CONNECT_S)

    def ask(self, message: Mapping[str, Any]) -> dict[str, Any]:
        """Its answer. Raises PolicyServerFailed; the next question then finds a new connection."""
        return self.ask_packed(packed(message))

    def ask_packed(self, message: bytes) -> dict[str, Any]:
        """The same with a message that is packed already."""
        if self._connection is None:
            self.connect()
        assert self._connection is not None  # noqa: S101 -- connect() has made it
        try:
            self._connection.send(message)
        except (OSError, WebSocketException) as error:
            self.close()
            raise PolicyServerFailed(_lost(self.url, error)) from error
        return self._received("It must answer with a dictionary that has actions.", self._answer_s)

    def close(self) -> None:
        """Say goodbye, where somebody is there."""
        self._connection = None
        self._open.close()

    def _received(self, must: str, seconds: float) -> dict[str, Any]:
        assert self._connection is not None  # noqa: S101 -- callers have it
        try:
            received = self._connection.recv(timeout=seconds)
            if isinstance(received, str):
                raise PolicyServerFailed(f"the policy server at {self.url} reports an error: {_short(received)}")
            return unpacked(received)
        except TimeoutError as error:
            self.close()
            raise PolicyServerFailed(
                f"the policy server at {self.url} said nothing for {seconds:g} s. Look whether it hangs; if it is only "
                "slow, allow it more time."
            ) from error
        except ValueError as error:
            self.close()
            raise PolicyServerFailed(
                f"the policy server at {self.url} sent what is not understood: {error}. {must}"
            ) from error
        except (OSError, WebSocketException) as error:
            self.close()
            raise PolicyServerFailed(_lost(self.url, error)) from error
        except PolicyServerFailed:
            self.close()
            raise


class PolicyFunction:
    """A function in this process in the place of a server: a message in, an action (A,) or a chunk (H, A) out."""

    def __init__(self, name: str, function: Callable[[dict[str, Any]], Any]) -> None:
        self.name, self._function = name, function

    def ask(self, message: Mapping[str, Any]) -> dict[str, Any]:
        """What it returns, as a server would say it. Raises PolicyServerFailed."""
        try:
            return {"actions": np.asarray(self._function(dict(message)))}
        except Exception as error:  # whatever code from elsewhere may do
            raise PolicyServerFailed(
                f"the function {self.name} failed with {type(error).__name__}: {_short(str(error))}. It is given a "
                f"dictionary of vectors ({', '.join(message)}) and must return an action."
            ) from error

    def ask_packed(self, message: bytes) -> dict[str, Any]:
        """The same with a message as a server would get it."""
        return self.ask(unpacked(message))


def chunk_of(answer: Mapping[str, Any], size: int) -> "np.ndarray[Any, np.dtype[np.float64]]":
    """The chunk of actions in an answer, (H, size), finite; a single action (size,) is a chunk of one.

    Raises PolicyServerFailed.
    """
    if "actions" not in answer:
        raise PolicyServerFailed(f"the policy server's answer has no 'actions', only {_short(', '.join(answer))!r}.")
    actions = answer["actions"]
    if not isinstance(actions, np.ndarray | list):
        raise PolicyServerFailed(f"the policy's actions are a {type(actions).__name__}; send an array (H, {size}).")
    try:
        chunk = np.atleast_2d(np.asarray(actions, np.float64))
    except (TypeError, ValueError):
        raise PolicyServerFailed(f"the policy's actions are no numbers; send an array (H, {size}).") from None
    if chunk.ndim != 2 or chunk.shape[1] != size or not 0 < chunk.size <= MOST_ACTIONS:
        raise PolicyServerFailed(
            f"the policy's actions have the shape {np.shape(actions)}, and (H, {size}) is needed: H actions of "
            f"{size} numbers each. Check that the policy's robot is this one."
        )
    if not np.isfinite(chunk).all():
        raise PolicyServerFailed("the policy's actions hold a NaN or an infinity. Look at what it was asked.")
    return chunk


def _array_to_map(value: Any) -> Any:
    if isinstance(value, np.ndarray | np.generic) and value.dtype.kind not in _KINDS:
        raise TypeError(f"arrays of {value.dtype} cannot be sent")
    if isinstance(value, np.ndarray):
        return {b"__ndarray__": True, b"data": value.tobytes(), b"dtype": value.dtype.str, b"shape": value.shape}
    if isinstance(value, np.generic):
        return {b"__npgeneric__": True, b"data": value.item(), b"dtype": value.dtype.str}
    raise TypeError(f"a {type(value).__name__} cannot be sent")


def _map_to_array(found: dict[Any, Any]) -> Any:
    if b"__ndarray__" in found:
        kind = _kind(found)
        shape, data = found.get(b"shape"), found.get(b"data")
        if (
            not isinstance(data, bytes)
            or not isinstance(shape, list)
            or any(not isinstance(each, int) or isinstance(each, bool) or each < 0 for each in shape)
        ):
            raise ValueError("an array without data or shape")
        return np.frombuffer(data, kind).reshape(shape).copy()
    if b"__npgeneric__" in found:
        return _kind(found).type(found.get(b"data"))
    return found


def _kind(found: Mapping[Any, Any]) -> "np.dtype[Any]":
    said = found.get(b"dtype")
    text = said.decode("ascii", "replace") if isinstance(said, bytes) else said
    if not isinstance(text, str) or len(text) > 4 or text.lstrip("<>|=")[:1] not in tuple(_KINDS):
        raise ValueError(f"an array of {_short(str(text))!r} instead of numbers")
    try:
        return np.dtype(text)
    except TypeError as error:
        raise ValueError(f"an array of {text!r} instead of numbers") from error


def _lost(url: str, error: Exception) -> str:
    return f"the policy server at {url} hung up ({_short(str(error))}). Look at what it printed, and start it again."


def _short(text: str) -> str:
    """The end of what somebody else wrote: of a traceback that is what went wrong."""
    line = " ".join(text.split())
    return line if len(line) <= 300 else f"... {line[-300:]}"
