"""The operator is told of every trouble that lasts: once, again each day, and when it is over."""

import asyncio
import json
import shutil
import threading
from collections.abc import Iterator
from datetime import datetime, timedelta
from email.message import Message as Mail
from http.server import BaseHTTPRequestHandler, HTTPServer
from typing import Any

import pytest
from aiosmtpd.handlers import Message as MailHandler
from aiosmtpd.smtp import SMTP

from app import falls
from app.__main__ import main
from app.db import Database, now
from app.domain.models import Run, RunKind, RunStatus, WorkerPresence
from app.domain.study_settings import StudySettings
from app.services.alerting import alerts, messages, troubles
from app.services.alerting.alerts import RETRY, Alerts
from app.services.studies import studies
from app.settings import Settings
from app.storage import ArtefactStore
from tests.waiting import until

MINUTE, DAY = timedelta(minutes=1), timedelta(days=1)


class Webhook(HTTPServer):
    """Somebody's chat server: keeps what it is sent, and can be made to refuse it."""

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.received: list[dict[str, Any]] = []
        self.status = 200

    @property
    def lines(self) -> list[list[tuple[str, bool]]]:
        """By message: which troubles, and whether they are over."""
        return [[(each["trouble"], each["over"]) for each in message["troubles"]] for message in self.received]


class _Handler(BaseHTTPRequestHandler):
    server: Webhook

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers["content-length"]))
        if self.server.status == 200:
            self.server.received.append(json.loads(body))
        self.send_response(self.server.status)
        self.end_headers()

    def log_message(self, format: str, *args: Any) -> None:
        """Quietly."""


class MailBox(MailHandler):
    def __init__(self) -> None:
        super().__init__()
        self.mails: list[Mail] = []

    def handle_message(self, message: Mail) -> None:
        self.mails.append(message)


@pytest.fixture
def webhook() -> Iterator[Webhook]:
    with Webhook() as server:
        threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True).start()
        yield server
        server.shutdown()


@pytest.fixture
def mail_box() -> Iterator[tuple[MailBox, str]]:
    """A mail server, and its address."""
    box, loop = MailBox(), asyncio.new_event_loop()
    server = loop.run_until_complete(loop.create_server(lambda: SMTP(box, loop=loop), "127.0.0.1", 0))
    thread = threading.Thread(target=loop.run_forever)
    thread.start()
    yield box, f"smtp://127.0.0.1:{server.sockets[0].getsockname()[1]}"
    loop.call_soon_threadsafe(loop.stop)
    thread.join()
    server.close()
    loop.close()


@pytest.fixture
def told(settings: Settings, webhook: Webhook) -> Settings:
    return settings.model_copy(update={"alert_webhook": f"http://127.0.0.1:{webhook.server_port}/a-secret-path"})


@pytest.fixture
def watchman(told: Settings, database: Database, store: ArtefactStore) -> Alerts:
    return Alerts(told, database, store)


@pytest.fixture
def study_id(database: Database) -> int:
    """A study at work without a worker."""
    with database.writing() as session:
        return studies.create_study(session, "Secret project", StudySettings()).id


@pytest.fixture
def start(database: Database, study_id: int) -> datetime:
    return now()


def a_worker_comes(database: Database) -> None:
    with database.writing() as session:
        session.merge(WorkerPresence(name="worker-1", last_seen_at=now()))


def a_worker_goes(database: Database) -> None:
    with database.writing() as session:
        session.merge(WorkerPresence(name="worker-1", last_seen_at=now() - timedelta(hours=1)))


def test_a_trouble_that_lasts_is_told_once_and_again_each_day(
    watchman: Alerts, webhook: Webhook, start: datetime
) -> None:
    for minutes in (0, 0.5):
        watchman.look(start + minutes * MINUTE)
    assert webhook.lines == [], "it may be over in a moment"
    for minutes in (1.5, 2, 60, 600):
        watchman.look(start + minutes * MINUTE)
    assert webhook.lines == [[("worker", False)]]
    for days in (1.01, 1.02, 1.9):
        watchman.look(start + days * DAY)
    assert webhook.lines == [[("worker", False)]] * 2


def test_what_is_over_is_told_to_whoever_was_told_that_it_began(
    watchman: Alerts, webhook: Webhook, start: datetime, database: Database
) -> None:
    watchman.look(start)
    watchman.look(start + 2 * MINUTE)
    a_worker_comes(database)
    watchman.look(start + 3 * MINUTE)
    assert len(webhook.lines) == 1, "it may come back in a moment"
    for minutes in (5, 6, 2000):
        watchman.look(start + minutes * MINUTE)
    assert webhook.lines == [[("worker", False)], [("worker", True)]]


def test_what_comes_and_goes_between_two_messages_is_not_told(
    watchman: Alerts, webhook: Webhook, start: datetime, database: Database
) -> None:
    watchman.look(start)
    a_worker_comes(database)
    watchman.look(start + 0.9 * MINUTE)
    watchman.look(start + 5 * MINUTE)
    assert webhook.lines == []
    a_worker_goes(database)
    watchman.look(start + 6 * MINUTE)
    watchman.look(start + 8 * MINUTE)
    a_worker_comes(database)
    watchman.look(start + 9 * MINUTE)
    a_worker_goes(database)
    for minutes in (9.5, 12, 60):
        watchman.look(start + minutes * MINUTE)
    assert webhook.lines == [[("worker", False)]], "gone for half a minute only"


def test_two_web_servers_tell_it_once(
    watchman: Alerts, webhook: Webhook, start: datetime, told: Settings, database: Database, store: ArtefactStore
) -> None:
    other = Alerts(told, database, store)
    for minutes in (0, 2, 3):
        for each in (watchman, other):
            each.look(start + minutes * MINUTE)
    assert webhook.lines == [[("worker", False)]]


def test_what_could_not_be_delivered_is_tried_again(watchman: Alerts, webhook: Webhook, start: datetime) -> None:
    webhook.status = 500
    watchman.look(start)
    with pytest.raises(messages.NotTold, match="ALERT_WEBHOOK: answered with 500") as refusal:
        watchman.look(start + 2 * MINUTE)
    assert "a-secret-path" not in str(refusal.value), "the address of a webhook is a password"
    webhook.status = 200
    watchman.look(start + 3 * MINUTE)
    assert webhook.lines == []
    watchman.look(start + 2 * MINUTE + RETRY)
    assert webhook.lines == [[("worker", False)]]


def test_a_mail_comes_even_when_the_webhook_does_not(
    told: Settings,
    webhook: Webhook,
    mail_box: tuple[MailBox, str],
    database: Database,
    store: ArtefactStore,
    start: datetime,
) -> None:
    box, address = mail_box
    both = told.model_copy(update={"alert_mail_to": "lab@example.org, it@example.org", "smtp_url": address})
    webhook.status = 404
    watchman = Alerts(both, database, store)
    for minutes in (0, 2, 20):
        watchman.look(start + minutes * MINUTE)
    (mail,) = box.mails
    assert mail["To"] == "lab@example.org, it@example.org"
    assert mail["Subject"].startswith("PbARL Studio: 1 to see to (http")
    assert "No worker gives a sign of life" in mail.get_payload()


def test_a_password_is_never_sent_in_the_clear(settings: Settings, mail_box: tuple[MailBox, str]) -> None:
    box, address = mail_box
    wanted = {"alert_mail_to": "lab@example.org", "smtp_url": address.replace("//", "//user:secret@")}
    with pytest.raises(messages.NotTold, match="no password"):
        messages.send(settings.model_copy(update=wanted), messages.Message("here", []))
    assert box.mails == []


def test_a_database_that_is_away_is_told_from_memory(
    watchman: Alerts, webhook: Webhook, start: datetime, settings: Settings, database: Database
) -> None:
    a_worker_comes(database)
    database.dispose()
    file = settings.data_dir / "studio.sqlite3"
    away = file.rename(file.with_name("away"))
    file.mkdir()
    for minutes in (0, 2, 3, 60):
        watchman.look(start + minutes * MINUTE)
    assert webhook.lines == [[("database", False)]]
    file.rmdir()
    away.rename(file)
    watchman.look(start + 61 * MINUTE)
    watchman.look(start + 70 * MINUTE)
    assert webhook.lines == [[("database", False)], [("database", True)]]


def test_nothing_is_said_about_people_or_what_a_study_calls_itself(
    watchman: Alerts, webhook: Webhook, start: datetime, database: Database, study_id: int
) -> None:
    with database.writing() as session:
        session.add(
            Run(kind=RunKind.CLIPS, study_id=study_id, workflow_id="clips/study-1", status=RunStatus.FAILED, seed=1)
        )
    watchman.look(start)
    watchman.look(start + 2 * MINUTE)
    assert {key for key, _ in webhook.lines[0]} == {"worker", f"failed work of study {study_id}"}
    assert "ecret" not in json.dumps(webhook.received)


def test_every_trouble_of_the_machine_is_seen(settings: Settings, monkeypatch: pytest.MonkeyPatch) -> None:
    settings.data_dir.mkdir(parents=True, exist_ok=True)
    assert list(troubles.of_machine(settings)) == []
    falls.note(settings.data_dir, [falls.Falls("worker", 3, now(), "MemoryError")])
    (fallen,) = troubles.of_machine(settings)
    assert fallen.key == "falls of worker"
    assert "MemoryError" not in fallen.words, "last words may name anything"
    monkeypatch.setattr(troubles, "DISK_LOW_BYTES", shutil.disk_usage(settings.data_dir).total + 1)
    assert [each.key for each in troubles.of_machine(settings)] == ["disk", "falls of worker"]


def test_a_studio_that_is_open_keeps_looking(
    told: Settings,
    webhook: Webhook,
    database: Database,
    store: ArtefactStore,
    start: datetime,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(alerts, "LOOK_S", 0.05)
    monkeypatch.setattr(alerts, "SETTLES", timedelta(0))
    with alerts.watching(told, database, store):
        assert until(lambda: webhook.lines == [[("worker", False)]])


def test_a_test_message_shows_whether_it_comes(
    told: Settings, webhook: Webhook, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("DATA_DIR", str(told.data_dir))
    assert main(["test-alert"]) == 1
    assert "Set ALERT_WEBHOOK or ALERT_MAIL_TO" in capsys.readouterr().out
    monkeypatch.setenv("ALERT_WEBHOOK", str(told.alert_webhook))
    assert main(["test-alert"]) == 0
    assert webhook.lines == [[("test", False)]]


@pytest.mark.parametrize("name", ["ALERT_WEBHOOK", "SMTP_URL"])
def test_an_address_that_is_none_is_refused_at_the_start(
    name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv(name, "mail.example.org")
    assert main(["migrate"]) == 1
    assert "Write " in capsys.readouterr().out
