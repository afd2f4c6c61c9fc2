"""The disk is full, can only be read, or the database is locked: what was acknowledged is kept, the rest is said."""

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from uuid import UUID, uuid4

import httpx2
import pytest
from sqlalchemy import select, text

from app.db import Database
from app.domain.preferences import LabelEvent
from app.settings import Settings
from app.storage import ArtefactStore
from tests import databases, factories
from tests.answering import Server
from tests.app.conftest import TakingPart
from tests.databases import make_tables
from tests.waiting import PATIENCE_S, free_port

pytestmark = pytest.mark.sqlite("about a disk on which SQLite's file lies")
JSON = {"Accept": "application/json"}
LABELS = 40


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of its own with 16 MB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=16m", "none", folder], capture_output=True)
    if mounted.returncode:
        pytest.skip("this account may not mount a disk")
    yield folder
    subprocess.run(["umount", "--lazy", folder], check=True)


@pytest.fixture
def settings_there(disk: Path) -> Settings:
    return Settings(_env_file=None, data_dir=disk, port=free_port(), database_url=None, storage_url=None)


@pytest.fixture
def token(settings_there: Settings) -> str:
    """The link of somebody in a study on that disk."""
    database, store = Database(settings_there.sqlalchemy_url), ArtefactStore.of(settings_there)
    make_tables(database)
    with database.writing() as session:
        study = factories.make_study(session, labels_per_participant=LABELS, pool_scenarios=20)
        participant, token = factories.make_participant(session, study)
        factories.make_queries(session, store, participant, LABELS)
    database.dispose()
    return token


@contextmanager
def browser_of(settings: Settings) -> Iterator[httpx2.Client]:
    """Somebody at the real web server."""
    server = Server(settings)
    try:
        with httpx2.Client(base_url=server.address, headers=JSON, timeout=PATIENCE_S) as browser:
            yield browser
    finally:
        server.kill()


def fill(disk: Path) -> Path:
    """Take all that is left."""
    ballast = disk / "ballast"
    with ballast.open("wb", buffering=0) as stream:
        for piece in (2**20, 4096, 1):
            try:
                while True:
                    stream.write(b"x" * piece)
            except OSError:
                continue
    return ballast


def test_on_a_full_disk_no_answer_is_acknowledged_that_is_not_kept_and_all_goes_on_when_there_is_space(
    disk: Path, settings_there: Settings, token: str
) -> None:
    acknowledged = list[UUID]()
    with browser_of(settings_there) as browser:
        browser.get(f"/p/{token}", headers={"Accept": "text/html"})
        turn = browser.get("/p/next").json()
        ballast = fill(disk)
        for uuid in (uuid4() for _ in range(LABELS)):
            form = {"response": "left", "client_uuid": str(uuid)}
            answer = browser.post(turn["pair"]["label_path"], data=form)
            if answer.status_code != 200:
                break
            acknowledged.append(uuid)
            turn = answer.json()
        assert answer.status_code == 503
        assert "Nothing was saved" in answer.json()["detail"]
        assert browser.get("/health").status_code == 503
        ballast.unlink()
        assert browser.post(turn["pair"]["label_path"], data=form).status_code == 200
        acknowledged.append(UUID(form["client_uuid"]))
    database = Database(settings_there.sqlalchemy_url)
    with database.reading() as session:
        stored = session.scalars(select(LabelEvent.client_uuid).order_by(LabelEvent.id)).all()
        assert [UUID(each) for each in stored] == acknowledged
        assert session.scalar(text("PRAGMA integrity_check")) == "ok"
    database.dispose()


@pytest.mark.parametrize("program", [["app", "web"], ["app", "up"], ["worker", "run"]], ids=" ".join)
def test_on_a_disk_that_can_only_be_read_every_program_says_so_and_changes_nothing(
    disk: Path, settings_there: Settings, token: str, program: list[str]
) -> None:
    before = {path.name: path.read_bytes() for path in disk.iterdir() if path.is_file()}
    subprocess.run(["mount", "-o", "remount,ro", disk], check=True)
    environment = databases.environment(disk, PORT=str(settings_there.port))
    done = subprocess.run(
        [sys.executable, "-m", *program], env=environment, capture_output=True, text=True, timeout=PATIENCE_S
    )
    assert done.returncode == 1
    said = done.stdout + done.stderr
    assert "can only be read" in said
    assert "Traceback" not in said
    assert {path.name: path.read_bytes() for path in disk.iterdir() if path.is_file()} == before


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever waits for a lock gives up soon."""
    monkeypatch.setattr("app.db.BUSY_TIMEOUT_S", 0.1)


def test_while_somebody_keeps_the_database_locked_nothing_is_acknowledged_and_then_all_is_as_before(
    impatient: None, taking_part: TakingPart
) -> None:
    taking_part.turn()
    query, uuid = taking_part.queries[0], uuid4()
    with taking_part.database.writing() as session:
        session.execute(text("SELECT 1"))  # whoever writes has locked it from the beginning
        answer = taking_part.answer(query, uuid=uuid)
        assert (answer.status_code, answer.headers["retry-after"]) == (503, "2")
        assert "Nothing was saved" in answer.json()["detail"]
    assert taking_part.answer(query, uuid=uuid).status_code == 200
    assert len(taking_part.events(query)) == 1
