"""Logging in, out, and choosing a password."""

from collections.abc import Callable

import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient
from sqlalchemy import select, update

from app.db import Database, now
from app.domain.people import AuditEvent, BrowserSession, Experimenter
from app.main import create_app
from app.services.accounts import accounts
from app.settings import Settings
from tests.app.conftest import TakingPart
from tests.conftest import PASSWORD, REAL_HASHER
from tests.databases import make_tables

NAME = accounts.FIRST_EXPERIMENTER


def log_in(browser: TestClient, password: str, **fields: str) -> tuple[int, str]:
    answer = browser.post("/login", data={"name": NAME, "password": password, **fields})
    return answer.status_code, answer.headers.get("location", answer.text)


@pytest.mark.parametrize("path", ["/studies", "/studies/new", "/studies/demo", "/studies/demo/participants/P01"])
def test_without_login_every_page_leads_to_the_form_and_back(client: TestClient, database: Database, path: str) -> None:
    answer = client.get(path)
    assert (answer.status_code, answer.headers["location"]) == (303, f"/login?next={path}")


def test_the_right_password_opens_the_page_one_wanted(client: TestClient, password: str) -> None:
    assert log_in(client, password, next="/studies/new") == (303, "/studies/new")
    assert client.get("/studies").status_code == 200


@pytest.mark.parametrize(
    "target", ["https://evil.example", "//evil.example", "/\\evil.example", "/studies\r\nX: y", "/p/x"]
)
def test_a_login_never_leads_elsewhere(client: TestClient, password: str, target: str) -> None:
    assert log_in(client, password, next=target) == (303, "/studies")


def test_a_wrong_password_says_so_and_keeps_the_name(client: TestClient, password: str) -> None:
    status, page = log_in(client, "wrong")
    assert status == 401
    assert "is not right" in page
    assert f'value="{NAME}"' in page
    assert "studio_experimenter" not in client.cookies


def test_an_unknown_name_is_answered_like_a_wrong_password(client: TestClient, password: str) -> None:
    known = client.post("/login", data={"name": NAME, "password": "wrong"}).text
    unknown = client.post("/login", data={"name": "nobody", "password": "wrong"}).text
    assert known.replace(NAME, "nobody") == unknown


def test_passwords_are_stored_as_argon2(database: Database, monkeypatch: pytest.MonkeyPatch) -> None:
    """With the second of the recommended choices of RFC 9106, section 4."""
    monkeypatch.setattr(accounts, "_hasher", lambda: REAL_HASHER)
    with database.writing() as session:
        password = accounts.create_first_experimenter(session)
        stored = session.scalars(select(Experimenter.password_hash)).one()
    assert stored.startswith("$argon2id$v=19$m=65536,t=3,p=4$")
    assert password is not None
    assert password not in stored


def test_too_many_attempts_have_to_wait_even_with_the_right_password(settings: Settings) -> None:
    application = create_app(settings.model_copy(update={"login_attempts_per_minute": 3}))
    studio = application.state.studio
    make_tables(studio.database)
    with studio.database.writing() as session:
        password = accounts.create_first_experimenter(session)
    assert password is not None
    browser = TestClient(application, follow_redirects=False)
    assert [log_in(browser, "wrong")[0] for _ in range(3)] == [401, 401, 401]
    status, page = log_in(browser, password)
    assert status == 429
    assert "wait a minute" in page
    studio.database.dispose()


def test_logging_out_makes_the_cookie_worthless(
    experimenter: TestClient, new_browser: Callable[[], TestClient]
) -> None:
    stolen = new_browser()
    stolen.cookies.update(dict(experimenter.cookies))
    assert stolen.get("/studies").status_code == 200
    assert experimenter.post("/logout").headers["location"] == "/login"
    assert stolen.get("/studies").status_code == 303


def test_a_participant_opens_no_experimenter_page(taking_part: TakingPart) -> None:
    assert taking_part.browser.get("/studies").headers["location"].startswith("/login")
    taking_part.browser.cookies["studio_experimenter"] = taking_part.browser.cookies["studio_participant"]
    assert taking_part.browser.get("/studies").headers["location"].startswith("/login")


def test_an_experimenter_opens_no_participant_page(experimenter: TestClient) -> None:
    assert experimenter.get("/p/next").status_code == 401
    experimenter.cookies["studio_participant"] = experimenter.cookies["studio_experimenter"]
    assert experimenter.get("/p/next").status_code == 401


class TestFirstLogin:
    """With the one-time password."""

    @pytest.fixture
    def one_time(self, database: Database, client: TestClient) -> str:
        with database.writing() as session:
            password = accounts.create_first_experimenter(session)
        assert password is not None
        log_in(client, password)
        return password

    def change(self, browser: TestClient, current: str, new: str, again: str | None = None) -> tuple[int, str]:
        form = {"current": current, "new": new, "again": new if again is None else again}
        answer = browser.post("/password", data=form)
        return answer.status_code, answer.headers.get("location", answer.text)

    @pytest.mark.parametrize("path", ["/studies", "/studies/new"])
    def test_every_page_leads_to_choosing_a_password(self, client: TestClient, one_time: str, path: str) -> None:
        assert client.get(path).headers["location"] == "/password"

    def test_nothing_can_be_made_before_it_is_chosen(self, client: TestClient, one_time: str) -> None:
        assert client.post("/studies/new", data={"name": "x"}).headers["location"] == "/password"

    def test_choosing_one_opens_the_studies_and_ends_other_logins(
        self, client: TestClient, one_time: str, new_browser: Callable[[], TestClient]
    ) -> None:
        other = new_browser()
        log_in(other, one_time)
        assert self.change(client, one_time, PASSWORD) == (303, "/studies")
        assert client.get("/studies").status_code == 200
        assert other.get("/studies").headers["location"].startswith("/login")
        assert log_in(other, one_time)[0] == 401

    @pytest.mark.parametrize(
        ("new", "again", "words"),
        [
            ("short", "short", "10 to 200"),
            (PASSWORD, "another password", "differ"),
            ("qwertyuiop", None, "first that are guessed"),
            ("Password123!", None, "first that are guessed"),
            ("experimenter2026", None, "first that are guessed"),
            ("y" * 200 + "z", None, "not valid"),
        ],
    )
    def test_an_unacceptable_one_is_explained(
        self, client: TestClient, one_time: str, new: str, again: str | None, words: str
    ) -> None:
        status, page = self.change(client, one_time, new, again)
        assert status == 422
        assert words in page

    def test_the_same_one_is_not_accepted(self, client: TestClient, one_time: str) -> None:
        assert self.change(client, one_time, one_time)[0] == 422

    def test_the_present_one_must_be_known(self, client: TestClient, one_time: str) -> None:
        status, page = self.change(client, "wrong", PASSWORD)
        assert status == 422
        assert "present password" in page

    def test_a_reset_ends_all_logins_and_asks_again(
        self, client: TestClient, one_time: str, database: Database
    ) -> None:
        self.change(client, one_time, PASSWORD)
        with database.writing() as session:
            new = accounts.reset_password(session, NAME)
        assert client.get("/studies").headers["location"].startswith("/login")
        assert log_in(client, PASSWORD)[0] == 401
        assert log_in(client, new)[0] == 303
        assert client.get("/studies").headers["location"] == "/password"


def test_there_is_only_one_first_experimenter(password: str, database: Database) -> None:
    with database.writing() as session:
        assert accounts.create_first_experimenter(session) is None


def test_resetting_an_unknown_account_says_so(database: Database) -> None:
    with database.writing() as session, pytest.raises(accounts.ExperimenterNotFound, match="no such account"):
        accounts.reset_password(session, "nobody")


def test_a_login_is_remembered_and_forgets_expired_ones(
    client: TestClient, password: str, experimenter_cookie: str, database: Database
) -> None:
    with database.writing() as session:
        session.execute(update(BrowserSession).values(expires_at=now()))
    log_in(client, password)
    with database.reading() as session:
        assert session.scalars(select(AuditEvent.action)).all() == ["logged in"]
        assert len(session.scalars(select(BrowserSession)).all()) == 1


def test_over_https_cookies_are_secure_and_browsers_told_to_stay(settings: Settings, studio_app: FastAPI) -> None:
    application = create_app(settings.model_copy(update={"secure_cookies": True}))
    with application.state.studio.database.writing() as session:
        password = accounts.create_first_experimenter(session)
    browser = TestClient(application, base_url="https://testserver", follow_redirects=False)
    answer = browser.post("/login", data={"name": NAME, "password": password})
    assert "secure" in answer.headers["set-cookie"].lower()
    assert "max-age" in answer.headers["strict-transport-security"]
    application.state.studio.database.dispose()
    studio_app.state.studio.database.dispose()
