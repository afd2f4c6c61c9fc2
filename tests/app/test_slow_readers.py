"""Somebody who downloads and stops reading holds up nobody."""

import socket
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from urllib.parse import urlsplit

import httpx2
import pytest

from app.db import Database
from app.domain.clips import Clip
from app.domain.studies import Deviation, Study
from app.storage import ArtefactStore
from app.web.http.session_queue import READERS
from tests import factories
from tests.waiting import PATIENCE_S

LONG_REASON = "Because. " * 20_000
PEOPLE = 60
"""With the reason in every row that makes ten megabytes, far more than what connections hold."""


@pytest.fixture
def study(database: Database) -> Study:
    with database.writing() as session:
        study = factories.make_study(session, "Pilot")
        for _ in range(PEOPLE):
            factories.make_participant(session, study)
        session.add(Deviation(study_id=study.id, actor="experimenter", reason=LONG_REASON, before={}, after={}))
        return study


@pytest.fixture
def clip(database: Database, store: ArtefactStore, study: Study) -> Clip:
    with database.writing() as session:
        return factories.make_clip(session, store, study)


@contextmanager
def stalled(address: str, path: str, cookie: str) -> Iterator[socket.socket]:
    """A download whose beginning has arrived, and of which nothing more is read."""
    server = urlsplit(address)
    with socket.socket() as connection:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        connection.settimeout(PATIENCE_S)
        connection.connect((server.hostname or "", server.port or 0))
        head = f"GET {path} HTTP/1.1\r\nHost: {server.netloc}\r\nCookie: studio_experimenter={cookie}\r\n\r\n"
        connection.sendall(head.encode())
        assert connection.recv(12) == b"HTTP/1.1 200"
        yield connection


def test_stalled_downloads_leave_the_database_to_everybody_else(
    address: str, experimenter_cookie: str, database: Database, clip: Clip
) -> None:
    video = f"/media/{clip.video_sha256}.mp4"
    with ExitStack() as stack:
        for _ in range(READERS):
            for path in ("/studies/pilot/export/participants.csv", "/studies/pilot/export/participants.jsonl", video):
                stack.enter_context(stalled(address, path, experimenter_cookie))
        cookies = {"studio_experimenter": experimenter_cookie}
        with httpx2.Client(base_url=address, cookies=cookies, timeout=PATIENCE_S) as browser:
            assert browser.get(video).status_code == 200
            assert browser.get("/studies").status_code == 200
        while not database.forget_erased():  # possible only while nobody holds a snapshot of the database
            pass


def test_a_slow_reader_gets_everything(address: str, experimenter_cookie: str, study: Study) -> None:
    cookies = {"studio_experimenter": experimenter_cookie}
    with httpx2.Client(base_url=address, cookies=cookies, timeout=PATIENCE_S) as browser:
        with browser.stream("GET", "/studies/pilot/export/participants.csv") as slow:
            pieces = slow.iter_bytes(1000)
            first = next(pieces)
            assert browser.get("/studies").status_code == 200
            lines = (first + b"".join(pieces)).decode().splitlines()
        assert len(lines) == 1 + PEOPLE
        assert lines[-1].startswith(f"P{PEOPLE}")
