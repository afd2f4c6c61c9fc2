"""A login ends that nobody uses; pages that update themselves use none."""

from datetime import timedelta

import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient
from sqlalchemy import select, text

from app.db import Database, now
from app.domain.people import BrowserSession, Experimenter
from app.services.accounts import browser_sessions
from app.settings import Settings
from app.storage import ArtefactStore
from tests import factories

HALF_AN_HOUR, HOUR = timedelta(minutes=30), timedelta(hours=1)
NOTED = timedelta(minutes=2)
POLL = {"x-unattended": "1"}


@pytest.fixture
def browser(client: TestClient, password: str) -> TestClient:
    assert client.post("/login", data={"name": "experimenter", "password": password}).status_code == 303
    return client


def pass_by(database: Database, time: timedelta) -> None:
    with database.writing() as session:
        for login in session.scalars(select(BrowserSession)):
            login.created_at, login.expires_at = login.created_at - time, login.expires_at - time


def left(database: Database) -> timedelta:
    with database.reading() as session:
        return session.scalars(select(BrowserSession)).one().expires_at - now()


def is_in(browser: TestClient) -> bool:
    return browser.get("/account", headers=POLL).status_code == 200


def test_whoever_does_nothing_for_an_hour_is_logged_out(browser: TestClient, database: Database) -> None:
    pass_by(database, HOUR - NOTED)
    assert is_in(browser)
    pass_by(database, NOTED)
    assert not is_in(browser)


@pytest.mark.parametrize("act", ["GET", "POST"])
def test_whoever_does_something_stays(act: str, browser: TestClient, database: Database) -> None:
    for _ in range(3):
        pass_by(database, HALF_AN_HOUR)
        assert browser.request(act, "/studies" if act == "GET" else "/account/logins/end-others").status_code < 400
        assert left(database) > HOUR - NOTED


def test_nobody_stays_for_longer_than_a_login_may_last(
    browser: TestClient, database: Database, settings: Settings
) -> None:
    for _ in range(2 * settings.login_hours - 1):
        pass_by(database, HALF_AN_HOUR)
        assert browser.get("/studies").status_code == 200
    assert left(database) < HALF_AN_HOUR
    pass_by(database, HALF_AN_HOUR)
    assert not is_in(browser)


def test_what_a_page_asks_for_by_itself_keeps_nobody_logged_in(
    browser: TestClient, studio_app: FastAPI, database: Database, store: ArtefactStore
) -> None:
    with database.writing() as session:
        study = factories.make_study(session, "Here")
        clip = factories.make_clip(session, store, study).video_sha256
    studio_app.state.studio.closing.set()  # streams begin, and end at once
    pass_by(database, HALF_AN_HOUR)
    before = left(database)
    for path in ("/studies/live", f"/studies/{study.slug}/live", f"/media/{clip}.mp4"):
        assert browser.get(path).status_code == 200
    assert browser.get(f"/studies/{study.slug}", headers=POLL).status_code == 200
    assert left(database) <= before


def test_a_login_of_an_earlier_version_ends_an_hour_after_its_next_use(
    client: TestClient, database: Database, password: str
) -> None:
    with database.writing() as session:
        account = session.scalars(select(Experimenter)).one()
        cookie = browser_sessions.open_for_experimenter(session, account, timedelta(hours=12))
    client.cookies["studio_experimenter"] = cookie
    client.get("/studies")
    assert left(database) < HOUR + NOTED


@pytest.mark.sqlite("the trigger is SQLite's")
def test_a_page_is_shown_when_its_use_cannot_be_noted(browser: TestClient, database: Database) -> None:
    pass_by(database, HALF_AN_HOUR)
    with database.writing() as session:
        failing = "CREATE TRIGGER full BEFORE UPDATE ON browser_session BEGIN SELECT RAISE(ABORT, 'disk full'); END"
        session.execute(text(failing))
    assert browser.get("/studies").status_code == 200
    assert left(database) < HOUR - NOTED


def test_a_form_that_comes_too_late_is_answered_with_what_to_do(browser: TestClient, database: Database) -> None:
    pass_by(database, HOUR)
    answer = browser.post("/studies/new", data={"name": "A study"})
    assert answer.status_code == 401
    assert "not saved. Go back, log in in another tab" in answer.text
