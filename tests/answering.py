"""A real web server that can be killed, and people who answer whatever happens to it."""

import subprocess
import sys
import threading
import time
from collections import Counter
from uuid import uuid4

import httpx2

from app.settings import Settings
from tests import databases
from tests.waiting import PATIENCE_S, until

_LOOK_AGAIN_S = 0.3


class Server:
    """The web server as a process of its own, which can be killed outright."""

    def __init__(self, settings: Settings) -> None:
        self.address = settings.base_url
        self._environment = databases.environment(settings.data_dir, PORT=str(settings.port))
        self.start()

    def start(self) -> None:
        """Returns when it answers."""
        self.process = subprocess.Popen([sys.executable, "-m", "app", "web"], env=self._environment)
        assert until(lambda: self.process.poll() is not None or self._answers()), "the server never answered"
        assert self.process.poll() is None, "the server has ended; what it said is above"

    def _answers(self) -> bool:
        try:
            return httpx2.get(f"{self.address}/health/live", timeout=PATIENCE_S).is_success
        except httpx2.TransportError:
            return False

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()


class Labeller(threading.Thread):
    """Answers everything; what was not acknowledged is sent again with the same UUID, as the page's script does."""

    def __init__(
        self,
        address: str,
        token: str,
        acknowledged: Counter[str],
        everybody: threading.Semaphore,
        pause_s: float = 0.0,
    ) -> None:
        super().__init__()
        self.address, self.token = address, token
        self.acknowledged, self.everybody = acknowledged, everybody
        self.pause_s = pause_s
        self.enough = threading.Event()

    def run(self) -> None:
        with httpx2.Client(base_url=self.address, headers={"Accept": "application/json"}, timeout=PATIENCE_S) as client:
            self._persist(client, "GET", f"/p/{self.token}", {})
            turn = self._persist(client, "GET", "/p/next", {}).json()
            while turn["state"] != "finished" and not self.enough.wait(self.pause_s):
                if turn["state"] == "waiting":
                    self.enough.wait(_LOOK_AGAIN_S)
                    turn = self._persist(client, "GET", "/p/next", {}).json()
                    continue
                uuid, path = str(uuid4()), turn["pair"]["label_path"]
                turn = self._persist(client, "POST", path, {"response": "left", "client_uuid": uuid}).json()
                self.acknowledged[uuid] += 1
                self.everybody.release()

    def _persist(self, client: httpx2.Client, method: str, path: str, fields: dict[str, str]) -> httpx2.Response:
        deadline, last = time.monotonic() + PATIENCE_S, ""
        while time.monotonic() < deadline:
            try:
                response = client.request(method, path, data=fields or None)
            except httpx2.TransportError as error:
                last = repr(error)
                threading.Event().wait(0.2)
                continue
            if response.status_code < 400:
                return response
            last = f"{response.status_code} {response.text}"
            threading.Event().wait(0.05)
        raise AssertionError(f"{method} {path} was never accepted, at last: {last}")
