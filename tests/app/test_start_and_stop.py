"""``make run``: one supervisor for web server and worker, from the greeting to Ctrl-C."""

import fcntl
import os
import re
import signal
import socket
import sqlite3
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from urllib.request import urlopen
from uuid import uuid4

import pytest

from app.falls import noted
from app.settings import Settings
from tests import databases
from tests.app.conftest import TakingPart
from tests.waiting import PATIENCE_S, free_port, gone, until

pytestmark = pytest.mark.slow

Start = Callable[[], "Studio"]

SOON_S = 10.0
"""As promised; whoever has not ended by then is killed after nine seconds, or ends a thread's patience."""


class Studio:
    """``python -m app up`` with what it has said so far."""

    def __init__(self, directory: Path, port: int) -> None:
        self.address = f"http://127.0.0.1:{port}"
        self.process = subprocess.Popen(
            [sys.executable, "-m", "app", "up"],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env=databases.environment(directory, PORT=str(port), HOST="127.0.0.1", COMPUTE_PROCESSES="1"),
        )
        self.lines: list[str] = []
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        self.lines.extend(iter(self.process.stdout.readline, ""))

    @property
    def said(self) -> str:
        return "".join(self.lines)

    def child(self, program: str) -> int:
        """The process id of the web server or the worker."""
        children = Path(f"/proc/{self.process.pid}/task/{self.process.pid}/children").read_text().split()
        return next(int(pid) for pid in children if program in Path(f"/proc/{pid}/cmdline").read_text())

    def stop(self, number: int = signal.SIGINT) -> int:
        self.process.send_signal(number)
        return self.ended()

    def ended(self) -> int:
        """Wait for the end; returns the exit code."""
        self.process.wait(timeout=PATIENCE_S)
        self._reader.join(timeout=PATIENCE_S)
        assert self.process.stdout is not None
        self.process.stdout.close()
        return self.process.returncode


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    studios: list[Studio] = []
    port = free_port()

    def begin() -> Studio:
        studios.append(Studio(tmp_path, port))
        return studios[-1]

    yield begin
    for studio in studios:
        if studio.process.poll() is None:
            studio.stop(signal.SIGTERM)


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Studio]:
    """Started for the first time, and at work; tests that leave it so share it."""
    studio = Studio(tmp_path_factory.mktemp("running"), free_port())
    assert until(lambda: "worker-1 is ready" in studio.said and answers(studio.address))
    yield studio
    if studio.process.poll() is None:
        studio.stop(signal.SIGTERM)


def answers(address: str) -> bool:
    try:
        with urlopen(f"{address}/login", timeout=5) as response:  # noqa: S310  (our own server)
            return bool(response.status == 200)
    except OSError:
        return False


def test_the_first_start_prints_all_that_is_needed(running: Studio) -> None:
    link = re.search(r"Participant link\s+(\S+)", running.said)
    assert link is not None
    assert link[1].startswith(f"{running.address}/p/")
    assert re.search(r"One-time password \S{12,}", running.said)
    assert f"{running.address}/studies" in running.said


def test_whoever_waits_for_a_page_goes_before_the_worker(running: Studio) -> None:
    web, worker = (running.child(name) for name in ("app\0web", "worker\0run"))
    assert os.getpriority(os.PRIO_PROCESS, web) < os.getpriority(os.PRIO_PROCESS, worker)
    assert os.getsid(web) == os.getsid(worker), "Linux compares priorities within a session only (autogroups)"
    assert len({os.getpgid(each) for each in (web, worker, running.process.pid)}) == 3, "Ctrl-C reaches one of them"


@pytest.mark.long
def test_a_second_start_makes_no_second_demo_study_and_no_new_password(start: Start) -> None:
    first = start()
    assert until(lambda: "Participant link" in first.said)
    first.stop()
    second = start()
    assert until(lambda: "nothing is lost" in second.said)
    assert "One-time password" not in second.said
    assert "/p/" not in second.said


def test_a_worker_that_is_killed_is_started_again(running: Studio) -> None:
    starts = running.said.count("worker-1 is ready")
    os.kill(running.child("worker"), signal.SIGKILL)
    assert until(lambda: running.said.count("worker-1 is ready") == starts + 1)
    assert "The worker stopped by itself (exit code -9); starting it again." in running.said


@pytest.mark.long
def test_a_worker_that_keeps_falling_leaves_the_web_server_alone_and_is_tried_until_it_can_run(
    start: Start, tmp_path: Path
) -> None:
    with (tmp_path / "worker-1.lock").open("w") as held_by_another:
        fcntl.flock(held_by_another, fcntl.LOCK_EX)
        studio = start()
        assert until(lambda: "exit code 1, 2 times by now" in studio.said)
        assert answers(studio.address)
        assert until(lambda: [falls.count >= 2 for falls in noted(tmp_path)] == [True])
        (falls,) = noted(tmp_path)
        assert falls.program == "worker"
        assert "A worker of this name is already running" in falls.last_words
    assert until(lambda: "worker-1 is ready" in studio.said)
    assert studio.stop() == 0


def test_a_web_server_that_falls_is_started_again_and_the_worker_keeps_its_work(running: Studio) -> None:
    worker, web = running.child("worker"), running.child("app\0web")
    os.kill(web, signal.SIGKILL)
    assert until(lambda: "The web stopped by itself" in running.said)
    assert until(lambda: answers(running.address))
    assert running.child("worker") == worker


@pytest.mark.long
@pytest.mark.sqlite("about the engine's own file")
def test_a_damaged_file_of_the_engine_is_set_aside_and_the_studio_starts(start: Start, tmp_path: Path) -> None:
    (tmp_path / "engine.sqlite3").write_bytes(os.urandom(30_000))
    studio = start()
    assert until(lambda: "worker-1 is ready" in studio.said and answers(studio.address))
    assert "the engine's file cannot be read (file is not a database); it is kept as" in studio.said


@pytest.mark.long
def test_killing_the_supervisor_leaves_nothing_running(start: Start) -> None:
    studio = start()
    assert until(lambda: "worker-1 is ready" in studio.said and answers(studio.address))
    programs = [studio.child("app\0web"), studio.child("worker")]
    studio.stop(signal.SIGKILL)
    assert until(lambda: all(gone(pid) for pid in programs))


def test_a_port_in_use_is_explained(running: Studio, tmp_path: Path) -> None:
    second = Studio(tmp_path, int(running.address.rpartition(":")[2]))
    assert second.ended() == 1
    assert "choose another: PORT=8001 make run" in second.said
    assert "Traceback" not in second.said


def test_ctrl_c_stops_both_programs(running: Studio) -> None:
    """The last of those that share it."""
    programs = [running.child("app\0web"), running.child("worker")]
    began = time.monotonic()
    assert running.stop() == 0
    assert time.monotonic() - began < SOON_S
    assert "Stopped." in running.said
    assert "Traceback" not in running.said
    assert all(gone(pid) for pid in programs)


@pytest.mark.long
@pytest.mark.sqlite("locks its file")
def test_the_web_server_ends_soon_whatever_it_is_asked_meanwhile(
    taking_part: TakingPart, experimenter_cookie: str, settings: Settings
) -> None:
    """An open dashboard, an answer that waits for the database, and an upload that does not go on."""
    taking_part.turn()
    address = ("127.0.0.1", free_port())
    environment = databases.environment(settings.data_dir, PORT=str(address[1]))
    server = subprocess.Popen([sys.executable, "-m", "app", "web"], env=environment)
    assert until(lambda: answers(f"http://127.0.0.1:{address[1]}"))

    def ask(line: str, cookie: str, body: bytes = b"", length: int = 0) -> socket.socket:
        head = f"{line} HTTP/1.1\r\nHost: studio\r\nCookie: {cookie}\r\nContent-Length: {length or len(body)}\r\n"
        kind = "Content-Type: application/x-www-form-urlencoded\r\n\r\n"
        connection = socket.create_connection(address, PATIENCE_S)
        connection.sendall(f"{head}{kind}".encode() + body)
        return connection

    person = f"studio_participant={taking_part.browser.cookies['studio_participant']}"
    ours = f"studio_experimenter={experimenter_cookie}"
    answer = f"response=left&client_uuid={uuid4()}".encode()
    with (
        ExitStack() as last,
        closing(sqlite3.connect(settings.data_dir / "studio.sqlite3", isolation_level=None)) as locking,
        ask("GET /studies/live", ours) as dashboard,
        ask("POST /import", ours, b"begun", 1000),
    ):
        last.callback(server.kill)
        assert dashboard.recv(12) == b"HTTP/1.1 200"
        locking.execute("BEGIN IMMEDIATE")
        with ask(f"POST /p/queries/{taking_part.queries[0].id}/label", person, answer):
            server.terminate()
            server.wait(SOON_S)
