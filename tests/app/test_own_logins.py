"""Where one is logged in: listed in words, ended at once, also by a new password."""

import re
from collections.abc import Callable

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select

from app.db import Database
from app.domain.people import BrowserSession
from tests import factories
from tests.conftest import PASSWORD

FIREFOX = "Mozilla/5.0 (X11; Linux x86_64; rv:145.0) Gecko/20100101 Firefox/145.0"
SAFARI = "Mozilla/5.0 (iPhone; CPU iPhone OS 18_1 like Mac OS X) AppleWebKit/605.1.15 Version/18.1 Mobile Safari/604.1"

LogIn = Callable[[str], TestClient]


@pytest.fixture
def log_in(password: str, new_browser: Callable[[], TestClient]) -> LogIn:
    """Gives a browser of this kind that is logged in to the only account."""

    def with_browser(user_agent: str) -> TestClient:
        browser = new_browser()
        browser.headers["user-agent"] = user_agent
        browser.post("/login", data={"name": "experimenter", "password": password})
        return browser

    return with_browser


def test_logins_are_listed_with_browser_and_time_and_this_one_is_said(log_in: LogIn) -> None:
    log_in(SAFARI)
    page = log_in(FIREFOX).get("/account").text
    rows = re.findall(r'<th scope="row">([^<]+)(.*?)</th>', page)
    assert [(name.strip(), "this one" in rest) for name, rest in rows] == [
        ("Firefox on Linux", True),
        ("Safari on iPhone", False),
    ]
    assert re.search(r"\d{4}-\d\d-\d\d \d\d:\d\d UTC", page)


def test_another_browser_is_logged_out_at_once(log_in: LogIn) -> None:
    phone, laptop = log_in(SAFARI), log_in(FIREFOX)
    (address,) = re.findall(r'action="(/account/logins/\d+/end)"', laptop.get("/account").text)
    assert phone.get("/studies").status_code == 200
    assert laptop.post(address).status_code == 303
    assert phone.get("/studies").headers["location"].startswith("/login")
    assert laptop.get("/studies").status_code == 200


def test_everything_else_is_logged_out_at_once(log_in: LogIn) -> None:
    others, laptop = [log_in(SAFARI), log_in(FIREFOX)], log_in(FIREFOX)
    laptop.post("/account/logins/end-others")
    assert [each.get("/studies").status_code for each in (*others, laptop)] == [303, 303, 200]


def test_a_new_password_logs_out_everywhere_else(log_in: LogIn) -> None:
    phone, laptop = log_in(SAFARI), log_in(FIREFOX)
    form = {"current": PASSWORD, "new": "another one of mine", "again": "another one of mine"}
    assert laptop.post("/password", data=form).status_code == 303
    assert [phone.get("/studies").status_code, laptop.get("/studies").status_code] == [303, 200]


def test_nobody_ends_the_login_of_somebody_else(log_in: LogIn, database: Database, client: TestClient) -> None:
    with database.writing() as session:
        _, token = factories.make_participant(session, factories.make_study(session), ready=False)
    client.get(f"/p/{token}")
    with database.reading() as session:
        number = session.scalars(select(BrowserSession.id)).one()
    assert log_in(FIREFOX).post(f"/account/logins/{number}/end").status_code == 404
    assert client.get("/p/next").headers["location"] == "/p/consent"
