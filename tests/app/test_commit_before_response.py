"""Nothing says "saved" before the database has it."""

from collections.abc import Iterator

import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient
from sqlalchemy import event
from sqlalchemy.exc import OperationalError

from tests.app.conftest import TakingPart


@pytest.fixture
def shown_pair(taking_part: TakingPart) -> TakingPart:
    taking_part.turn()
    return taking_part


@pytest.fixture
def failing_commits(shown_pair: TakingPart) -> Iterator[TakingPart]:
    """From here on no transaction can be committed."""

    def fail(_connection: object) -> None:
        raise OperationalError("COMMIT", None, Exception("disk I/O error"))

    event.listen(shown_pair.database.writer, "commit", fail)
    yield shown_pair
    event.remove(shown_pair.database.writer, "commit", fail)


@pytest.mark.parametrize("accept", ["application/json", "text/html"])
def test_a_failing_commit_is_never_answered_as_saved(failing_commits: TakingPart, accept: str) -> None:
    person = failing_commits
    form = {"response": "left", "client_uuid": "8d1b2f5e-6a55-4b0e-9a55-0a4d8f6b1c11"}
    path = f"/p/queries/{person.queries[0].id}/label"
    answer = person.browser.post(path, data=form, headers={"Accept": accept})
    assert answer.status_code == 503
    assert "Nothing was saved" in answer.text
    assert person.events(person.queries[0]) == []


def test_an_unforeseen_failure_is_a_page_and_changes_nothing(
    taking_part: TakingPart, studio_app: FastAPI, monkeypatch: pytest.MonkeyPatch
) -> None:
    taking_part.turn()

    def break_down(*_arguments: object) -> None:
        raise RuntimeError("unforeseen")

    monkeypatch.setattr("app.services.answers.next_query.next_turn", break_down)
    browser = TestClient(studio_app, raise_server_exceptions=False, cookies=dict(taking_part.browser.cookies))
    form = {"response": "left", "client_uuid": "8d1b2f5e-6a55-4b0e-9a55-0a4d8f6b1c11"}
    path = f"/p/queries/{taking_part.queries[0].id}/label"
    answer = browser.post(path, data=form, headers={"Accept": "application/json"})
    assert answer.status_code == 500
    assert answer.headers["content-security-policy"].startswith("default-src 'none'")
    assert taking_part.events(taking_part.queries[0]) == []
