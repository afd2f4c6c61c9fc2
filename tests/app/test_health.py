"""Whether the studio says truly that it can do its work."""

import shutil
from pathlib import Path
from types import SimpleNamespace

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import event, text
from sqlalchemy.exc import OperationalError

from app.db import Database, complaints
from app.services.monitoring import health
from app.settings import Settings
from tests import databases
from tests.app.conftest import TakingPart


def database_of(client: TestClient) -> Database:
    database: Database = client.app.state.studio.database  # type: ignore[attr-defined]
    return database


def test_all_is_well_on_a_fresh_database(client: TestClient) -> None:
    answer = client.get("/health")
    assert (answer.status_code, answer.text) == (200, "ok")


def test_a_database_that_cannot_be_written_is_not_well(client: TestClient, settings: Settings) -> None:
    address = f"sqlite:///file:{settings.data_dir}/studio.sqlite3?mode=ro&uri=true"
    if databases.SERVER is not None:
        address = f"{settings.sqlalchemy_url}&options=-cdefault_transaction_read_only%3Don"
    read_only = Database(address)
    assert health.complaint(read_only, settings.data_dir) == health.NOT_WRITABLE
    read_only.dispose()


def test_a_database_that_somebody_keeps_locked_is_not_well(
    client: TestClient, settings: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("app.db.BUSY_TIMEOUT_S", 0.1)
    impatient = Database(settings.sqlalchemy_url)
    with database_of(client).writing() as session:
        session.execute(text("UPDATE alembic_version SET version_num = version_num"))
        assert health.complaint(impatient, settings.data_dir) == health.NOT_WRITABLE
    assert health.complaint(impatient, settings.data_dir) is None
    impatient.dispose()


@pytest.mark.parametrize("change", ["DELETE FROM alembic_version", "DROP TABLE alembic_version"])
def test_another_schema_is_not_well(client: TestClient, change: str) -> None:
    with database_of(client).writing() as session:
        session.execute(text(change))
    answer = client.get("/health")
    assert answer.status_code == 503
    assert "python -m app migrate" in answer.text


def test_a_nearly_full_disk_is_not_well_but_the_server_lives(
    client: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda _path: SimpleNamespace(free=health.LEAST_FREE_BYTES - 1))
    answer = client.get("/health")
    assert (answer.status_code, answer.text) == (503, health.DISK_FULL)
    assert client.get("/health/live").status_code == 200


def test_a_missing_data_directory_is_not_well(client: TestClient, tmp_path: Path) -> None:
    assert health.complaint(database_of(client), tmp_path / "gone") == health.NOT_WRITABLE


def test_strangers_learn_no_path_and_no_version(client: TestClient, settings: Settings) -> None:
    with database_of(client).writing() as session:
        session.execute(text("UPDATE alembic_version SET version_num = '9999'"))
    said = client.get("/health").text
    assert str(settings.data_dir) not in said
    assert "9999" not in said


def test_however_many_ask_the_database_is_written_once(client: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("app.web.http.readiness.KNOWN_FOR_S", 3600.0)
    commits: list[object] = []
    event.listen(database_of(client).writer, "commit", commits.append)
    assert [client.get("/health").status_code for _ in range(50)] == [200] * 50
    assert len(commits) == 1


def test_the_compose_file_watches_this_address() -> None:
    assert "/health'" in Path("docker-compose.yml").read_text()


def test_the_same_complaint_is_written_once_a_minute_with_how_often_it_came(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    moment = [1000.0]
    monkeypatch.setattr("app.errors.time", SimpleNamespace(monotonic=lambda: moment[0]))

    def complain(said: str) -> None:
        complaints.warning("trying once more: %s", said)

    for number in range(100):
        complain(f"disk is full, page {number}")
        complain("database is locked")
    moment[0] += 60
    complain("disk is full, page 100")
    lines = [record.getMessage() for record in caplog.records if record.name == complaints.name]
    assert lines == [
        "trying once more: disk is full, page 0",
        "trying once more: database is locked",
        "trying once more: disk is full, page 100 (99 more like it in the last minutes)",
    ]


def test_a_database_that_is_away_fills_no_log(
    taking_part: TakingPart, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every save fails; the log says so once, whoever tries."""

    def fail(_connection: object) -> None:
        raise OperationalError("COMMIT", None, Exception("database or disk is full"))

    taking_part.turn()
    event.listen(taking_part.database.writer, "commit", fail)
    monkeypatch.setattr(complaints.filters[0], "_passed", {})
    codes = {taking_part.answer(taking_part.queries[0]).status_code for _ in range(12)}
    event.remove(taking_part.database.writer, "commit", fail)
    assert codes == {503}
    assert [record.name for record in caplog.records].count(complaints.name) == 1
