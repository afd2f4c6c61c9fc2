"""Somebody who connects and does not say what they want holds up nobody, however many connections they open."""

import resource
import socket
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from urllib.parse import urlsplit

import httpx2
import pytest

from app.web.http import connections
from tests.waiting import PATIENCE_S, until

HEAD = b"POST /login HTTP/1.1\r\nHost: studio\r\nContent-Type: application/x-www-form-urlencoded\r\n"
SOON_S = 0.1
NEVER_S = 100 * PATIENCE_S


@contextmanager
def connected(address: str, *said: bytes) -> Iterator[socket.socket]:
    """A connection on which this was said, piece by piece."""
    server = urlsplit(address)
    with socket.create_connection((server.hostname or "", server.port or 0), PATIENCE_S) as connection:
        for piece in said:
            connection.sendall(piece)
        yield connection


def is_closed(connection: socket.socket) -> bool:
    """Waits until the server says something or closes the connection."""
    try:
        return connection.recv(1) == b""
    except ConnectionResetError:
        return True


@pytest.mark.parametrize("said", [b"", HEAD, b"GET / HT"])
def test_a_request_that_does_not_go_on_is_given_up(address: str, monkeypatch: pytest.MonkeyPatch, said: bytes) -> None:
    monkeypatch.setattr(connections, "HEAD_S", SOON_S)
    monkeypatch.setattr(connections, "BODY_S", NEVER_S)
    with connected(address, said) as connection:
        assert is_closed(connection)


def test_neither_is_a_later_one_waited_for_once_it_has_begun(address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with connected(address, b"GET /health/live HTTP/1.1\r\nHost: studio\r\n\r\n") as connection:
        assert connection.recv(65536).startswith(b"HTTP/1.1 200")
        monkeypatch.setattr(connections, "HEAD_S", SOON_S)
        connection.sendall(HEAD)
        until(lambda: is_closed(connection))


def test_what_a_request_has_announced_is_not_waited_for_without_end(
    address: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connections, "BODY_S", SOON_S)
    with connected(address, HEAD + b"Content-Length: 20\r\n\r\nname=ada") as connection:
        assert is_closed(connection)


def test_a_request_that_comes_slowly_is_answered(address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    body = b"name=ada&password=wrong"
    said = HEAD + b"Content-Length: %d\r\n\r\n" % len(body) + body
    with connected(address, *(said[at : at + 1] for at in range(len(said)))) as connection:
        assert connection.recv(12).startswith(b"HTTP/1.1 ")


def test_more_connections_than_there_are_files_for_are_closed_at_once(
    address: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with ExitStack() as stack:
        browser = stack.enter_context(httpx2.Client(base_url=address, timeout=PATIENCE_S))
        browser.get("/health/live").raise_for_status()
        monkeypatch.setattr(connections, "MOST", 4)
        held = [stack.enter_context(connected(address)) for _ in range(8)]
        assert all(is_closed(each) for each in held[3:])
        browser.get("/health/live").raise_for_status()


def test_files_are_left_for_everything_else() -> None:
    soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    assert connections.most_connections() <= max(1, soft - connections.OTHER_FILES)
