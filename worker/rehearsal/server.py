"""A studio of our own, started for a rehearsal or a test and stopped at its end."""

import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Self, TypeVar

import httpx2

from app.errors import AppError
from app.programs import GRACE_S, end_with_parent
from app.settings import Settings

Answered = TypeVar("Answered")

PATIENCE_S = 900.0
POLL_S = 0.25


class StandsStill(AppError):
    """The studio did not get any further."""


class OwnStudio:
    """Web server and worker of a studio of our own in a directory; a context that stops both at its end."""

    def __init__(self, directory: Path, port: int | None = None) -> None:
        directory.mkdir(parents=True, exist_ok=True)
        self.settings = Settings(data_dir=directory, port=port or _free_port(), database_url=None, storage_url=None)
        self.log = directory / "rehearsal.log"
        self._environment = {
            **{name: value for name, value in os.environ.items() if name not in ("DATABASE_URL", "STORAGE_URL")},
            "DATA_DIR": str(directory),
            "HOST": self.settings.host,
            "PORT": str(self.settings.port),
        }
        self._programs: dict[str, subprocess.Popen[bytes]] = {}
        self._starter = ThreadPoolExecutor(1, "starter")
        """one thread that lives as long as we do: programs end with the thread that started them"""

    def __enter__(self) -> Self:
        try:
            subprocess.run([sys.executable, "-m", "app", "migrate"], check=True, env=self._environment)
            self.start_web()
            self.start_worker()
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *exception: object) -> None:
        for program in self._programs.values():
            program.terminate()
        deadline = time.monotonic() + GRACE_S
        for program in self._programs.values():
            try:
                program.wait(max(0.1, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                program.kill()
                program.wait()
        self._starter.shutdown()

    def start_web(self) -> None:
        """Start the web server and wait until it answers."""
        self._start("web", "app", "web")
        wait_until(PATIENCE_S, "no web server", self._answers)

    def start_worker(self, name: str = "worker") -> None:
        """Start a worker; whatever an earlier one of this name has left undone is its to finish."""
        self._start(name, "worker", "run", WORKER_NAME=name)

    def kill(self, name: str) -> None:
        """SIGKILL to "web" or a worker: no chance to clean up."""
        self._programs[name].kill()
        self._programs[name].wait()

    def running(self) -> list[str]:
        """Names of the programs that have not ended."""
        return [name for name, program in self._programs.items() if program.poll() is None]

    def process_id(self, name: str) -> int:
        """Of "web" or a worker."""
        return self._programs[name].pid

    def _answers(self) -> bool | None:
        if self._programs["web"].poll() is not None:
            raise StandsStill(f"The web server stopped by itself; {self.log} says why.")
        try:
            return httpx2.get(f"{self.settings.base_url}/login", timeout=5.0).is_success or None
        except httpx2.TransportError:
            return None

    def _start(self, name: str, module: str, *arguments: str, **settings: str) -> None:
        with self.log.open("ab") as stream:
            self._programs[name] = self._starter.submit(
                subprocess.Popen[bytes],
                [sys.executable, "-m", module, *arguments],
                env={**self._environment, **settings},
                stdout=stream,
                stderr=subprocess.STDOUT,
                preexec_fn=end_with_parent,
            ).result()


def wait_until(
    patience_s: float,
    missing: str,
    look: Callable[[], Answered | None],
    how_far: Callable[[], object] = lambda: None,
) -> Answered:
    """What ``look`` finds in the end. Raises StandsStill when it finds nothing and ``how_far`` says the same for too
    long.
    """
    deadline, known = time.monotonic() + patience_s, how_far()
    while (found := look()) is None:
        if known != (known := how_far()):
            deadline = time.monotonic() + patience_s
        if time.monotonic() > deadline:
            raise StandsStill(f"There was {missing} for {patience_s:.0f} s; rehearsal.log says what went on.")
        time.sleep(POLL_S)
    return found


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port
