"""Requests nobody has thought of: generated from the API's own document, nonsense for every form, bodies without end.

``tests/benchmarks/fuzz_api.py`` sends ten thousand; this sends some.
"""

import asyncio
from collections.abc import Callable

import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient

from app.main import MAX_BODY_BYTES
from tests.app.conftest import TakingPart
from tests.app.test_garbage import PARAMETER, addresses
from tests.benchmarks import fuzz_api

PIECE = b"a" * 65536
A_FEW = 8
"""pieces that may be on their way when the limit is noticed"""
UPLOADS = {"/import"}
"""tests/app/test_uploads.py is about these."""


@pytest.mark.long
@pytest.mark.sqlite("makes studios of its own")
def test_nothing_generated_fails_or_is_answered_otherwise_than_documented() -> None:
    found = fuzz_api.fuzz(120, seed=1)
    assert found.requests.total() >= 100
    assert found.findings == {}


def test_no_form_reads_more_of_a_body_without_end_than_it_accepts(
    studio_app: FastAPI, taking_part: TakingPart, experimenter: TestClient
) -> None:
    jar = {**dict(taking_part.browser.cookies), **dict(experimenter.cookies)}
    cookie = "; ".join(f"{name}={value}" for name, value in jar.items())
    posts = [path for method, path in addresses(studio_app) if method == "POST" and path not in UPLOADS]
    assert len(posts) > 40
    for path in posts:
        status, pieces = asyncio.run(_endless(studio_app, PARAMETER.sub("1", path), cookie))
        assert 300 <= status < 500, path
        assert pieces * len(PIECE) <= MAX_BODY_BYTES + A_FEW * len(PIECE), path


async def _endless(application: Callable[..., object], path: str, cookie: str) -> tuple[int, int]:
    """The status, and how many pieces of the body were read for it; given up after a hundred times what is accepted."""
    statuses, pieces = list[int](), 0

    async def receive() -> dict[str, object]:
        nonlocal pieces
        pieces += 1
        return {"type": "http.request", "body": PIECE, "more_body": pieces * len(PIECE) < 100 * MAX_BODY_BYTES}

    async def send(message: dict[str, object]) -> None:
        if message["type"] == "http.response.start":
            statuses.append(int(str(message["status"])))

    headers = {"host": "testserver", "cookie": cookie, "content-type": "application/x-www-form-urlencoded"}
    scope = {
        "type": "http",
        "method": "POST",
        "path": path,
        "raw_path": path.encode(),
        "query_string": b"",
        "root_path": "",
        "scheme": "http",
        "http_version": "1.1",
        "server": ("testserver", 80),
        "client": ("testclient", 50000),
        "headers": [(name.encode(), value.encode("latin-1")) for name, value in headers.items()],
        "state": {},
    }
    await application(scope, receive, send)  # type: ignore[misc]
    return statuses[0], pieces
