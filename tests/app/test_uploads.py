"""An upload is read only for somebody who may send it, and never too many at once."""

import socket
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from sqlalchemy import select

from app.db import Database
from app.domain.people import Experimenter, Role
from app.domain.studies import Study
from app.services.archives import archive
from app.storage import ArtefactStore
from app.web.experimenter.study import imports
from tests import factories
from tests.waiting import PATIENCE_S

GIGABYTES = 3 * 10**9
HEAD = b'--x\r\nContent-Disposition: form-data; name="file"; filename="study.zip"\r\n\r\n'
TAIL = b"\r\n--x--\r\n"


@pytest.fixture
def packed(database: Database, store: ArtefactStore, tmp_path: Path) -> bytes:
    """A small archive."""
    path = tmp_path / "study.zip"
    with database.writing() as session:
        archive.write(session, store, factories.make_study(session, "Pilot"), path)
    return path.read_bytes()


@contextmanager
def announced(address: str, cookie: str = "", byte_count: int = GIGABYTES, **headers: str) -> Iterator[socket.socket]:
    """An upload that was announced; the client waits for "100 Continue", which says that the server reads."""
    server = urlsplit(address)
    lines = {
        "Host": server.netloc,
        "Content-Type": "multipart/form-data; boundary=x",
        "Content-Length": str(byte_count),
        "Expect": "100-continue",
        "Cookie": f"studio_experimenter={cookie}",
        **{name.replace("_", "-"): text for name, text in headers.items()},
    }
    request = "".join(f"{name}: {text}\r\n" for name, text in lines.items())
    with socket.create_connection((server.hostname or "", server.port or 0), timeout=PATIENCE_S) as connection:
        connection.sendall(f"POST /import HTTP/1.1\r\n{request}\r\n".encode())
        yield connection


def status_of(connection: socket.socket) -> int:
    """The first status that the server sends."""
    return int(connection.recv(64).split(b" ")[1])


def rest_of(connection: socket.socket) -> str:
    """What follows, until the whole page is there."""
    received = b""
    while b"</html>" not in received:
        received += connection.recv(65536)
    return received.decode()


def test_nothing_is_read_before_the_login(address: str) -> None:
    with announced(address) as connection:
        assert status_of(connection) == 401


def test_nothing_is_read_from_a_reader(address: str, experimenter_cookie: str, database: Database) -> None:
    with database.writing() as session:
        session.scalars(select(Experimenter)).one().role = Role.READER
    with announced(address, experimenter_cookie) as connection:
        assert status_of(connection) == 403


def test_nothing_is_read_from_another_site(address: str, experimenter_cookie: str) -> None:
    with announced(address, experimenter_cookie, 100_000, Sec_Fetch_Site="cross-site") as connection:
        assert status_of(connection) == 403


def test_nothing_is_read_that_has_no_room(
    address: str, experimenter_cookie: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(imports, "MOST_OF_THE_DISK", 0.0)
    with announced(address, experimenter_cookie) as connection:
        assert status_of(connection) == 413
        assert "Free some space" in rest_of(connection)


def test_a_third_upload_at_a_time_is_told_to_wait(address: str, experimenter_cookie: str) -> None:
    with ExitStack() as stack:
        reading = [stack.enter_context(announced(address, experimenter_cookie)) for _ in range(2)]
        assert [status_of(each) for each in reading] == [100, 100]
        with announced(address, experimenter_cookie) as third:
            assert status_of(third) == 503
            assert "Please wait until one of them is done" in rest_of(third)


def test_an_upload_that_was_broken_off_leaves_its_place_to_the_next(
    address: str, experimenter_cookie: str, packed: bytes, database: Database
) -> None:
    for _ in range(2):
        with announced(address, experimenter_cookie) as connection:
            assert status_of(connection) == 100
            connection.sendall(HEAD + packed[:100])
    assert until(lambda: upload(address, experimenter_cookie, packed), lambda status: status != 503) == 303
    assert number_of_studies(database) == 2, "the study itself and its copy"


def test_an_upload_that_stalls_is_given_up(
    address: str, experimenter_cookie: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(imports, "PATIENCE_S", 0.05)
    with announced(address, experimenter_cookie) as connection:
        assert status_of(connection) == 100
        assert "stopped in the middle" in rest_of(connection)


def upload(address: str, cookie: str, content: bytes) -> int:
    """Upload an archive as a browser does; the status of the answer."""
    body = HEAD + content + TAIL
    with announced(address, cookie, len(body)) as connection:
        first = status_of(connection)
        if first != 100:
            return first
        connection.sendall(body)
        while (first := status_of(connection)) == 100:
            pass
        return first


def until(ask: Callable[[], int], fits: Callable[[int], bool]) -> int:
    """Ask again until the answer fits."""
    answer = ask()
    while not fits(answer):
        time.sleep(0.01)
        answer = ask()
    return answer


def number_of_studies(database: Database) -> int:
    """How many studies there are."""
    with database.reading() as session:
        return len(session.scalars(select(Study)).all())
