"""API tokens: for reading only or for one study only, for a time, and worthless at once when revoked."""

import re
from collections.abc import Callable
from datetime import timedelta

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select

from app.db import Database, now
from app.domain.people import ApiToken
from tests import factories

API = "/api/v1"
Token = Callable[..., dict[str, str]]


@pytest.fixture
def token(experimenter: TestClient, database: Database) -> Token:
    """Makes a token on the page, as a person would; gives the headers that use it."""
    with database.writing() as session:
        for name in ("Pilot", "Other"):
            factories.make_participant(session, factories.make_study(session, name))

    def made(**wanted: str) -> dict[str, str]:
        page = experimenter.post("/tokens", data={"name": "notebook", **wanted}).text
        (text,) = re.findall(r'value="(pbarl_[^"]+)"', page)
        return {"authorization": f"Bearer {text}"}

    return made


def test_a_token_reads_unless_writing_is_asked_for(client: TestClient, token: Token) -> None:
    reads, writes = token(), token(scope="write")
    address = f"{API}/studies/pilot/participants"
    assert client.get(address, headers=reads).status_code == 200
    refused = client.post(address, json={"count": 1}, headers=reads)
    assert (refused.status_code, "only read" in refused.json()["detail"]) == (403, True)
    assert client.post(address, json={"count": 1}, headers=writes).status_code == 201


def test_a_token_for_one_study_opens_no_other(client: TestClient, token: Token) -> None:
    headers = token(study="pilot")
    assert [each["slug"] for each in client.get(f"{API}/studies", headers=headers).json()] == ["pilot"]
    assert client.get(f"{API}/studies/pilot", headers=headers).status_code == 200
    strange, missing = (client.get(f"{API}/studies/{slug}", headers=headers) for slug in ("other", "no-such-study"))
    assert (strange.status_code, strange.json()) == (404, missing.json())


def test_a_token_expires(client: TestClient, token: Token, database: Database, experimenter: TestClient) -> None:
    headers = token(days="7")
    assert client.get(f"{API}/me", headers=headers).status_code == 200
    with database.writing() as session:
        row = session.scalars(select(ApiToken)).one()
        assert row.expires_at is not None
        assert timedelta(days=6) < row.expires_at - now() <= timedelta(days=7)
        row.expires_at = now()
    assert client.get(f"{API}/me", headers=headers).status_code == 401
    assert ">expired<" in experimenter.get("/tokens").text


@pytest.mark.parametrize("wrong", [{"days": "0"}, {"days": "366"}, {"scope": "all"}])
def test_no_token_lasts_for_ever_or_may_what_there_is_not(
    experimenter: TestClient, token: Token, database: Database, wrong: dict[str, str]
) -> None:
    assert experimenter.post("/tokens", data={"name": "x", **wrong}).status_code == 422
    with database.reading() as session:
        assert session.scalars(select(ApiToken)).all() == []


def test_a_token_says_what_it_may(client: TestClient, token: Token) -> None:
    told = client.get(f"{API}/me", headers=token(study="pilot", days="7")).json()
    assert (told["scope"], told["study"]) == ("read", "pilot")
    assert told["expires_at"] is not None


def test_tokens_of_before_they_had_scopes_keep_their_rights(
    client: TestClient, token: Token, database: Database
) -> None:
    headers = token(scope="write")
    with database.writing() as session:
        session.scalars(select(ApiToken)).one().expires_at = None
    assert client.get(f"{API}/me", headers=headers).json()["expires_at"] is None
