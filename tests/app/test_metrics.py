"""What Prometheus reads: only with the operator's token, and nothing of anybody's."""

from datetime import timedelta

import pytest
from fastapi.testclient import TestClient
from prometheus_client.parser import text_string_to_metric_families
from sqlalchemy import text

from app.db import Database, now
from app.domain.models import RunKind, RunStatus, WorkerPresence
from app.settings import Settings
from tests import factories
from tests.app.conftest import TakingPart

TOKEN = "a token of the operator's own"


@pytest.fixture
def settings(settings: Settings) -> Settings:
    return settings.model_copy(update={"metrics_token": TOKEN})


def metrics(client: TestClient) -> dict[tuple[str, tuple[tuple[str, str], ...]], float]:
    """Every sample by its name and labels."""
    answer = client.get("/metrics", headers={"Authorization": f"Bearer {TOKEN}"})
    assert answer.status_code == 200
    assert answer.headers["content-type"].startswith("text/plain; version=")
    families = text_string_to_metric_families(answer.text)
    return {
        (sample.name, tuple(sorted(sample.labels.items()))): sample.value
        for family in families
        for sample in family.samples
    }


@pytest.mark.parametrize("sent", [None, "Bearer wrong", f"bearer {TOKEN}", TOKEN, "Bearer \udcff"])
def test_without_the_token_there_is_no_such_page(client: TestClient, sent: str | None) -> None:
    headers = {} if sent is None else {b"Authorization": sent.encode("utf-8", "surrogateescape")}
    assert client.get("/metrics", headers=headers).status_code == 404


def test_a_studio_without_a_token_shows_none(client: TestClient) -> None:
    studio = client.app.state.studio  # type: ignore[attr-defined]
    studio.settings.metrics_token = None
    assert client.get("/metrics", headers={"Authorization": "Bearer None"}).status_code == 404


def test_people_answers_runs_and_the_silence_of_workers_are_those_of_the_database(
    client: TestClient, taking_part: TakingPart, database: Database
) -> None:
    with database.writing() as session:
        factories.make_label(session, taking_part.queries[0])
        factories.make_run(session, taking_part.study, kind=RunKind.REWARD, status=RunStatus.FAILED)
        session.add(WorkerPresence(name="worker-7", last_seen_at=now() - timedelta(minutes=5)))
    found = metrics(client)
    assert found["studio_participants", ()] == 1
    assert found["studio_answers", ()] == 1
    assert found["studio_runs", (("kind", "reward"), ("status", "failed"))] == 1
    assert 300 <= found["studio_worker_silence_seconds", (("worker", "worker-7"),)] < 600
    assert found["studio_database_answers", ()] == 1
    assert found["studio_disk_free_bytes", ()] > 0
    assert found["studio_falls", (("program", "worker"),)] == 0


def test_a_request_is_counted_under_its_route_and_no_personal_link_is_told(
    client: TestClient, taking_part: TakingPart
) -> None:
    route = (("method", "GET"), ("route", "/p/{token}"), ("status", "303"))
    before = metrics(client).get(("studio_request_seconds_count", route), 0)
    client.get(f"/p/{taking_part.token}")
    client.request("BREW", "/p/next")
    after = metrics(client)
    assert after["studio_request_seconds_count", route] == before + 1
    assert taking_part.token not in str(after)
    assert "BREW" not in str(after), "methods that somebody makes up would be series without end"


def test_a_database_that_does_not_answer_is_told_and_the_rest_is_still_there(
    client: TestClient, database: Database
) -> None:
    with database.writing() as session:
        session.execute(text("ALTER TABLE label_event RENAME TO not_there"))
    found = metrics(client)
    assert found["studio_database_answers", ()] == 0
    assert found["studio_disk_free_bytes", ()] > 0
