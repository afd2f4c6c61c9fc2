"""Nonsense sent to every address is answered with words and never with a failure of ours."""

import re
from collections.abc import Iterator
from itertools import cycle, islice

from fastapi import FastAPI
from fastapi.routing import iter_route_contexts
from fastapi.testclient import TestClient

from tests.app.conftest import TakingPart

JUNK = [
    "0",
    "-1",
    "999999999999999999999999",
    "%00",
    "..%2f..%2fetc%2fpasswd",
    "P01",
    "';DROP TABLE study;--",
    "%ff%fe",
]
BODIES = [
    (b"", "application/x-www-form-urlencoded"),
    (b"\xff\xfe\x00=%%%&&&=", "application/x-www-form-urlencoded"),
    (b"response=left&response=right&count=1&count=x&client_uuid=" + b"x" * 5000, "application/x-www-form-urlencoded"),
    (
        b"name=%00&password=%ff&current=%00&new=%00&again=%00&version=%00&question=%00",
        "application/x-www-form-urlencoded",
    ),
    (b"--x\r\nbroken", "multipart/form-data; boundary=x"),
    (b"--x\r\nbroken", "multipart/form-data"),
    (b'{"response": ["left"]}', "application/json"),
    (b"name=" + b"a" * 400_000, "application/x-www-form-urlencoded"),
    (b"&".join(b"f%d=1" % number for number in range(3000)), "application/x-www-form-urlencoded"),
]
NOT_TRIED = {"/studies/live", "/health"}
"""An endless stream for whoever may see it; and what says 503 of a database that no migration has made."""
PARAMETER = re.compile(r"{\w+(:\w+)?}")


def addresses(application: FastAPI) -> Iterator[tuple[str, str]]:
    """Every method and path of the server, with its parameters still in braces."""
    for route in iter_route_contexts(application.routes):
        for method in route.methods or ():
            if route.path and route.path not in NOT_TRIED:
                yield method, route.path


def requests(application: FastAPI) -> Iterator[tuple[str, str, bytes, str]]:
    """Method, path, body and content type of every piece of nonsense."""
    for method, path in addresses(application):
        for junk in JUNK if PARAMETER.search(path) else [""]:
            target = PARAMETER.sub(junk, path) + ("?next=%ff%00" if method == "GET" else "")
            yield method, target, b"", "application/x-www-form-urlencoded"
        if method == "POST":
            for body, content_type in BODIES:
                yield method, PARAMETER.sub("1", path), body, content_type
    for method in ("PUT", "DELETE", "PATCH", "OPTIONS", "TRACE", "HEAD", "BREW"):
        yield method, "/p/next", b"", "text/plain"


def failures(application: FastAPI, cookies: dict[str, str], third: int) -> list[str]:
    """What failed, or was refused without a word; browsers and programs ask by turns.

    ``third``: of all nonsense, 0 to 2; between them the visitors try everything.
    """
    browser = TestClient(application, raise_server_exceptions=False, follow_redirects=False, cookies=cookies)
    found = []
    askers = cycle(["text/html", "text/html", "application/json"])
    for (method, path, body, content_type), accept in zip(
        islice(requests(application), third, None, 3), askers, strict=False
    ):
        headers = {"content-type": content_type, "accept": accept}
        answer = browser.request(method, path, content=body, headers=headers)
        if answer.status_code >= 500 or (answer.status_code >= 400 and method != "HEAD" and not answer.text):
            found.append(f"{method} {path} {body[:60]!r} {content_type}: {answer.status_code}")
    return found


def test_every_route_is_tried(studio_app: FastAPI) -> None:
    found = set(addresses(studio_app))
    assert {("POST", "/p/queries/{query_id}/label"), ("GET", "/media/{sha256}.mp4"), ("POST", "/login")} <= found
    assert len(found) > 30


def test_nonsense_of_a_stranger_is_answered_with_words(studio_app: FastAPI, taking_part: TakingPart) -> None:
    assert failures(studio_app, {"studio_participant": "%00", "studio_experimenter": "x" * 3000}, 0) == []


def test_nonsense_of_a_participant_is_answered_with_words(studio_app: FastAPI, taking_part: TakingPart) -> None:
    taking_part.turn()
    assert failures(studio_app, dict(taking_part.browser.cookies), 1) == []
    assert taking_part.events(taking_part.queries[0]) == []


def test_nonsense_of_an_experimenter_is_answered_with_words(
    studio_app: FastAPI, taking_part: TakingPart, experimenter: TestClient
) -> None:
    assert failures(studio_app, dict(experimenter.cookies), 2) == []


def test_a_garbled_cookie_is_nobody(taking_part: TakingPart, client: TestClient) -> None:
    for cookie in ("", "x", "ä".encode().decode("latin-1"), "x" * 4000):
        headers = {b"Cookie": f"studio_participant={cookie}".encode("latin-1")}
        assert client.get("/p/next", headers=headers).status_code == 401
