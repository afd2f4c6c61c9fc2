"""Opening the personal link."""

from collections.abc import Callable

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select, update

from app.db import Database, now
from app.domain.people import BrowserSession
from app.domain.studies import Participant
from tests import factories
from tests.app.conftest import TakingPart, agree


@pytest.fixture
def token(database: Database) -> str:
    with database.writing() as session:
        return factories.make_participant(session, factories.make_study(session), ready=False)[1]


def test_the_token_leaves_the_address_and_goes_nowhere_else(client: TestClient, token: str) -> None:
    answer = client.get(f"/p/{token}")
    assert (answer.status_code, answer.headers["location"]) == (303, "/p/next")
    assert answer.headers["referrer-policy"] == "no-referrer"
    assert token not in answer.headers["set-cookie"]


def test_the_cookie_is_out_of_reach_of_scripts_and_other_sites(client: TestClient, token: str) -> None:
    cookie = client.get(f"/p/{token}").headers["set-cookie"].lower()
    assert "httponly" in cookie
    assert "samesite=lax" in cookie


def test_neither_token_nor_cookie_is_stored(client: TestClient, token: str, database: Database) -> None:
    client.get(f"/p/{token}")
    cookie = client.cookies["studio_participant"]
    with database.reading() as session:
        stored = [
            session.scalar(select(Participant.token_sha256)),
            session.scalar(select(BrowserSession.cookie_sha256)),
        ]
    assert token not in stored
    assert cookie not in stored
    assert all(value is not None and len(value) == 64 for value in stored)


def test_it_works_again_on_another_device(taking_part: TakingPart, new_browser: Callable[[], TestClient]) -> None:
    taking_part.turn()
    taking_part.answer(taking_part.queries[0])
    other = new_browser()
    other.get(f"/p/{taking_part.token}")
    assert "1 of 10" in other.get("/p/next").text


@pytest.mark.parametrize("wrong", ["x" * 43, "short", "next", "%00", "ä" * 43, "a" * 5000])
def test_a_wrong_link_shows_nothing_but_a_page(client: TestClient, token: str, wrong: str) -> None:
    answer = client.get(f"/p/{wrong}")
    assert answer.status_code in (401, 404)
    assert "<h1>" in answer.text


def test_without_a_link_there_is_a_page_that_says_so(client: TestClient) -> None:
    answer = client.get("/p/next")
    assert answer.status_code == 401
    assert "personal link" in answer.text


def test_an_expired_cookie_is_worth_nothing(taking_part: TakingPart, database: Database) -> None:
    with database.writing() as session:
        session.execute(update(BrowserSession).values(expires_at=now()))
    assert taking_part.turn().status_code == 401


def test_consent_and_instructions_come_first_and_are_stored(client: TestClient, token: str, database: Database) -> None:
    client.get(f"/p/{token}")
    assert client.get("/p/next").headers["location"] == "/p/consent"
    assert client.get("/p/instructions").headers["location"] == "/p/next"
    assert agree(client).headers["location"] == "/p/next"
    assert client.get("/p/next").headers["location"] == "/p/instructions"
    assert client.post("/p/instructions").headers["location"] == "/p/next"
    assert client.get("/p/next").status_code == 200
    with database.reading() as session:
        participant = session.scalars(select(Participant)).one()
    assert participant.consent_version == "1"
    assert participant.consented_at is not None
    assert participant.instructed_at is not None


def test_agreeing_to_another_text_is_not_agreeing(client: TestClient, token: str, database: Database) -> None:
    client.get(f"/p/{token}")
    answer = client.post("/p/consent", data={"shown": "0" * 64})
    assert "has changed" in answer.text
    assert client.get("/p/next").headers["location"] == "/p/consent"


def test_instructions_cannot_be_finished_before_agreeing(client: TestClient, token: str) -> None:
    client.get(f"/p/{token}")
    client.post("/p/instructions")
    assert client.get("/p/next").headers["location"] == "/p/consent"
