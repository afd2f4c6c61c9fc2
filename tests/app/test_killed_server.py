"""A server killed under load has forgotten no answer that it said was saved, and doubles none on the way back."""

import subprocess
import sys
import threading
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from uuid import uuid4

import httpx2
import pytest
from sqlalchemy import select

from app.__main__ import migrate
from app.db import Database
from app.domain.preferences import LabelEvent
from app.settings import Settings
from app.storage import ArtefactStore
from tests import databases, factories
from tests.waiting import PATIENCE_S, free_port

PEOPLE = 4
LABELS = 40
KILL_AFTER = 50


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    return Settings(_env_file=None, data_dir=tmp_path, port=free_port())


@pytest.fixture
def database(settings: Settings) -> Iterator[Database]:
    migrate(settings)
    database = Database(settings.sqlalchemy_url)
    yield database
    database.dispose()


@pytest.fixture
def tokens(settings: Settings, database: Database) -> list[str]:
    store = ArtefactStore(settings.data_dir / "artefacts")
    tokens = []
    with database.writing() as session:
        study = factories.make_study(session, labels_per_participant=LABELS, pool_scenarios=20)
        for _ in range(PEOPLE):
            participant, token = factories.make_participant(session, study)
            factories.make_queries(session, store, participant, LABELS)
            tokens.append(token)
    return tokens


class Server:
    """Uvicorn as a process of its own, which can be killed outright."""

    def __init__(self, settings: Settings) -> None:
        self.address = settings.base_url
        self._environment = databases.environment(settings.data_dir)
        self._command = ["-m", "uvicorn", "app.main:create_app", "--factory", "--no-access-log", "--log-level", "error"]
        self._command += ["--port", str(settings.port)]
        self.start()

    def start(self) -> None:
        self.process = subprocess.Popen([sys.executable, *self._command], env=self._environment)

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()


class Labeller(threading.Thread):
    """Answers everything; what was not acknowledged is sent again with the same UUID, as the page's script does."""

    def __init__(self, address: str, token: str, acknowledged: Counter[str], everybody: threading.Semaphore) -> None:
        super().__init__()
        self.address, self.token = address, token
        self.acknowledged, self.everybody = acknowledged, everybody

    def run(self) -> None:
        with httpx2.Client(base_url=self.address, headers={"Accept": "application/json"}, timeout=PATIENCE_S) as client:
            self._persist(client, "GET", f"/p/{self.token}", {})
            path = self._persist(client, "GET", "/p/next", {}).json()["pair"]["label_path"]
            while path:
                uuid = str(uuid4())
                reply = self._persist(client, "POST", path, {"response": "left", "client_uuid": uuid}).json()
                self.acknowledged[uuid] += 1
                self.everybody.release()
                path = reply["pair"]["label_path"] if reply["state"] == "pair" else None

    def _persist(self, client: httpx2.Client, method: str, path: str, fields: dict[str, str]) -> httpx2.Response:
        for _ in range(600):
            try:
                response = client.request(method, path, data=fields or None)
            except httpx2.TransportError:
                threading.Event().wait(0.05)
                continue
            if response.status_code < 400:
                return response
            threading.Event().wait(0.05)
        raise AssertionError(f"{method} {path} was never accepted")


def test_no_acknowledged_answer_is_lost_and_none_is_doubled_when_the_server_is_killed(
    settings: Settings, database: Database, tokens: list[str]
) -> None:
    server = Server(settings)
    acknowledged: Counter[str] = Counter()
    answers = threading.Semaphore(0)
    labellers = [Labeller(server.address, token, acknowledged, answers) for token in tokens]
    for labeller in labellers:
        labeller.start()
    for _ in range(KILL_AFTER):
        assert answers.acquire(timeout=PATIENCE_S)
    server.kill()
    with database.reading() as session:
        stored = set(session.scalars(select(LabelEvent.client_uuid)))
    assert set(acknowledged) <= stored, "an answer that was said to be saved is gone"
    server.start()
    for labeller in labellers:
        labeller.join(timeout=PATIENCE_S)
    server.kill()
    with database.reading() as session:
        per_query = Counter(session.scalars(select(LabelEvent.query_id)))
    assert len(per_query) == PEOPLE * LABELS
    assert set(per_query.values()) == {1}
