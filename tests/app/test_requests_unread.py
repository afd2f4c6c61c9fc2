"""What is sent: nothing of it is read before its sender may send it, and nothing fails where it is broken."""

import asyncio
from collections.abc import Callable, Coroutine, MutableMapping

import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient

from tests.app.gate import (
    ANYBODY,
    EDITOR,
    FORGOTTEN,
    GUESSED,
    MATRIX,
    OWN_PAIR,
    ROUTES,
    STRANGER,
    THIS_PARTICIPANT,
    TOKEN,
    TOKEN_LOOKS,
    TOKEN_READS_DATA,
    TOKEN_WRITES,
    Gate,
    outcome,
)

BODIES = {
    "JSON that breaks off": ("application/json", b'{"kind": '),
    "JSON that is no text": ("application/json", b"\xff\xfe"),
    "a form of nonsense": ("application/x-www-form-urlencoded", b"%ff=%00&&client_uuid=1&code"),
    "parts that break off": ("multipart/form-data; boundary=x", b"--x\r\nbroken"),
    "nothing": ("", b""),
}
SENDING = [each for each in ROUTES if each.method not in ("GET", "HEAD") and MATRIX[each.name] is not ANYBODY]
IN_ONE_STEP = {"label_query", "undo_label", "note_event"}
"""Whose sender is looked up in the transaction that keeps what they sent: received before, parsed after."""


BEGUN: MutableMapping[str, object] = {"type": "http.request", "body": b"{", "more_body": False}
BROKEN_OFF: MutableMapping[str, object] = {"type": "http.disconnect"}


def test_whoever_is_unknown_is_told_so_whatever_they_send(gate: Gate) -> None:
    found = {
        (route.method, route.name, kind): outcome(
            route,
            gate.visitors[FORGOTTEN].request(
                route.method, gate.address(route), content=body, headers={"content-type": content_type}
            ),
        )
        for route in SENDING
        for kind, (content_type, body) in BODIES.items()
    }
    assert {one: what for one, what in found.items() if what != "asked who they are"} == {}


def test_nothing_is_received_from_whoever_is_refused(gate: Gate, studio_app: FastAPI) -> None:
    received = set()
    for route in SENDING:
        rule = MATRIX[route.name]
        known = set() if rule is OWN_PAIR else sorted({*rule.forbidden, *rule.hidden})[:2]
        for visitor in (STRANGER, GUESSED, FORGOTTEN, *known):
            if asyncio.run(_received(studio_app, gate.visitors[visitor], route.method, gate.address(route))):
                received.add((route.name, visitor))
    assert received == {(name, FORGOTTEN) for name in IN_ONE_STEP}


@pytest.mark.parametrize(
    ("name", "visitor"), [("save_demographics", THIS_PARTICIPANT), ("ask_power", EDITOR), ("add_participants", EDITOR)]
)
def test_whoever_sends_slowly_holds_up_nobody(name: str, visitor: str, gate: Gate, studio_app: FastAPI) -> None:
    async def somebody_else_writes() -> None:
        async with asyncio.timeout(5), studio_app.state.studio.session_queue.writing():
            pass

    route = next(each for each in SENDING if each.name == name)
    asked = _received(studio_app, gate.visitors[visitor], "POST", gate.address(route), meanwhile=somebody_else_writes)
    assert asyncio.run(asked)


def test_a_connection_that_breaks_off_is_no_error(gate: Gate, studio_app: FastAPI) -> None:
    """Whatever the application raised would stand in the server's log as its own fault."""
    for route in SENDING:
        for visitor in sorted(MATRIX[route.name].let_in)[:1]:
            asyncio.run(_received(studio_app, gate.visitors[visitor], route.method, gate.address(route), BROKEN_OFF))


async def _nothing() -> None:
    pass


async def _received(
    application: FastAPI,
    browser: TestClient,
    method: str,
    path: str,
    message: MutableMapping[str, object] = BEGUN,
    meanwhile: Callable[[], Coroutine[None, None, None]] = _nothing,
) -> bool:
    """Whether the application asked for anything of the body before it answered; it comes after ``meanwhile``."""
    received = False

    async def receive() -> MutableMapping[str, object]:
        nonlocal received
        received = True
        await meanwhile()
        return {**message}

    async def send(_message: object) -> None:
        pass

    form = {"content-type": "application/x-www-form-urlencoded"}
    headers = browser.build_request(method, path, headers=form).headers.raw
    scope = {"type": "http", "method": method, "path": path, "raw_path": path.encode(), "query_string": b""}
    scope |= {"headers": [(name.lower(), value) for name, value in headers], "http_version": "1.1", "scheme": "http"}
    await application({**scope, "client": ("testclient", 1)}, receive, send)
    return received


def test_a_wrong_parameter_is_told_to_nobody_without_a_token(gate: Gate) -> None:
    for route in ROUTES:
        if MATRIX[route.name] in (TOKEN, TOKEN_LOOKS, TOKEN_READS_DATA, TOKEN_WRITES):
            answer = gate.visitors[STRANGER].request(route.method, gate.address(route) + "?nonsense=1&limit=none")
            assert answer.status_code == 401, (route.method, route.name)
