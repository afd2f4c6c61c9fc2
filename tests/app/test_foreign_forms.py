"""Requests that other websites make in a visitor's name are refused; our own go through, with HTTPS or without."""

import socket
from urllib.parse import urlsplit
from uuid import uuid4

import pytest

from tests.app.conftest import TakingPart
from tests.waiting import PATIENCE_S

OURS = "http://testserver"


def post(person: TakingPart, headers: dict[str, str]) -> int:
    person.turn()
    form = {"response": "left", "client_uuid": str(uuid4())}
    return person.browser.post(f"/p/queries/{person.queries[0].id}/label", data=form, headers=headers).status_code


@pytest.mark.parametrize(
    "headers",
    [
        {"Sec-Fetch-Site": "same-origin", "Origin": OURS},
        {"Sec-Fetch-Site": "none"},
        {"Origin": OURS},
        {},
    ],
)
def test_our_own_forms_are_accepted(taking_part: TakingPart, headers: dict[str, str]) -> None:
    assert post(taking_part, headers) == 303
    assert len(taking_part.events(taking_part.queries[0])) == 1


@pytest.mark.parametrize(
    "headers",
    [
        {"Sec-Fetch-Site": "cross-site", "Origin": "https://evil.example"},
        {"Sec-Fetch-Site": "same-site", "Origin": "http://other.testserver"},
        {"Sec-Fetch-Site": "cross-site", "Origin": OURS},
        {"Origin": "https://evil.example"},
        {"Origin": "http://testserver:81"},
        {"Origin": "null"},
        {"Origin": "http://["},
    ],
)
def test_forms_of_other_sites_are_refused(taking_part: TakingPart, headers: dict[str, str]) -> None:
    assert post(taking_part, headers) == 403
    assert taking_part.events(taking_part.queries[0]) == []


def test_the_refusal_is_a_page_with_our_headers(taking_part: TakingPart) -> None:
    answer = taking_part.browser.post("/p/consent", headers={"Sec-Fetch-Site": "cross-site"})
    assert "another website" in answer.text
    assert "frame-ancestors 'none'" in answer.headers["content-security-policy"]


def test_links_from_other_sites_may_be_followed(taking_part: TakingPart) -> None:
    answer = taking_part.browser.get(f"/p/{taking_part.token}", headers={"Sec-Fetch-Site": "cross-site"})
    assert answer.status_code == 303


def test_our_pages_let_browsers_send_their_origin_over_plain_http(taking_part: TakingPart) -> None:
    """With no-referrer, browsers would send "Origin: null" with our own forms, and we would refuse them."""
    assert taking_part.browser.get("/p/next").headers["referrer-policy"] == "same-origin"


@pytest.mark.parametrize("path", ["/p/next", "/login", "/static/base/base.css", "/nowhere"])
def test_every_answer_carries_the_headers(taking_part: TakingPart, path: str) -> None:
    headers = taking_part.browser.get(path).headers
    assert "script-src 'self'" in headers["content-security-policy"]
    assert "unsafe" not in headers["content-security-policy"]
    assert headers["x-content-type-options"] == "nosniff"


def test_what_follows_a_request_of_two_lengths_is_not_taken_for_another(address: str) -> None:
    """A proxy that went by the length would have taken all of it for one."""
    hidden = b"GET /health/live HTTP/1.1\r\nHost: studio\r\n\r\n"
    body = b"0\r\n\r\n" + hidden
    head = f"POST /login HTTP/1.1\r\nHost: studio\r\nContent-Length: {len(body)}\r\nTransfer-Encoding: chunked\r\n\r\n"
    server = urlsplit(address)
    with socket.create_connection((server.hostname or "", server.port or 0), PATIENCE_S) as connection:
        connection.sendall(head.encode() + body)
        answers = b"".join(iter(lambda: connection.recv(65536), b""))
    assert answers.startswith(b"HTTP/1.1 400")
    assert answers.count(b"HTTP/1.1") == 1
