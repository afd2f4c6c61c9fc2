"""The second factor: set up by scanning, asked for at every login, each code good once, guessing slowed down."""

import base64
import re
from collections.abc import Callable, Iterator
from datetime import timedelta

import pyotp
import pytest
from alembic import command
from fastapi import FastAPI
from fastapi.testclient import TestClient
from sqlalchemy import select

from app import upgrading
from app.__main__ import main, migrate
from app.db import Database, now
from app.domain.people import AuditEvent, Experimenter, RecoveryCode
from app.main import create_app
from app.services.accounts import accounts, api_tokens, second_factor
from app.settings import Settings
from tests.conftest import PASSWORD
from tests.databases import make_tables

STEP = 60_000_000
LOGIN = {"name": "experimenter", "password": PASSWORD}


def begin(browser: TestClient) -> str:
    """The secret that the page shows."""
    page = browser.post("/second-factor/begin", data={"password": PASSWORD}).text
    assert "<svg" in page
    (secret,) = re.findall(r'totp-secret">([A-Z2-7]+)<', page)
    return str(secret)


@pytest.fixture(autouse=True)
def clock(monkeypatch: pytest.MonkeyPatch) -> None:
    """Stands still: otherwise a slow test would run out of its 30 s."""
    monkeypatch.setattr(second_factor, "present_step", lambda: STEP)


def code(secret: str, steps: int = 0) -> str:
    return pyotp.TOTP(secret).at((STEP + steps) * second_factor.STEP_S)


@pytest.fixture
def secret(experimenter: TestClient) -> str:
    """Of an account whose second factor is on, with a code of the step before."""
    secret = begin(experimenter)
    assert experimenter.post("/second-factor/confirm", data={"code": code(secret, -1)}).status_code == 200
    return secret


@pytest.fixture
def asked(secret: str, new_browser: Callable[[], TestClient]) -> TestClient:
    """A browser in which the password was right, and which is asked for the code."""
    browser = new_browser()
    answer = browser.post("/login", data=LOGIN | {"next": "/studies/new"})
    assert answer.headers["location"] == "/login/code?next=%2Fstudies%2Fnew"
    return browser


def test_the_password_alone_opens_nothing_any_more(asked: TestClient) -> None:
    for path in ("/studies", "/account", "/second-factor", "/password", "/audit", "/tokens"):
        assert asked.get(path).headers["location"].startswith("/login?"), path
    assert asked.get("/login/code").status_code == 200


def test_a_code_completes_the_login_and_leads_to_the_page_that_was_wanted(asked: TestClient, secret: str) -> None:
    answer = asked.post("/login/code", data={"code": code(secret), "next": "/studies/new"})
    assert (answer.status_code, answer.headers["location"]) == (303, "/studies/new")
    assert asked.get("/studies").status_code == 200


def test_the_session_that_waited_for_the_code_is_worth_nothing_afterwards(
    asked: TestClient, secret: str, new_browser: Callable[[], TestClient]
) -> None:
    waiting = asked.cookies["studio_experimenter"]
    asked.post("/login/code", data={"code": code(secret)})
    other = new_browser()
    other.cookies["studio_experimenter"] = waiting
    assert other.get("/login/code").status_code == 303
    assert other.get("/studies").status_code == 303


def test_a_code_is_good_once_and_an_older_one_is_not_good_after_it(
    asked: TestClient, secret: str, new_browser: Callable[[], TestClient]
) -> None:
    used = code(secret, 1)
    assert asked.post("/login/code", data={"code": used}).status_code == 303
    again = new_browser()
    again.post("/login", data=LOGIN)
    assert again.post("/login/code", data={"code": used}).status_code == 422
    assert again.post("/login/code", data={"code": code(secret)}).status_code == 422


def test_the_first_code_of_all_is_used_too(asked: TestClient, secret: str) -> None:
    assert asked.post("/login/code", data={"code": code(secret, -1)}).status_code == 422


def test_a_wrong_code_is_told_and_is_in_the_audit_log(asked: TestClient, database: Database) -> None:
    answer = asked.post("/login/code", data={"code": "000000"})
    assert (answer.status_code, "not right" in answer.text) == (422, True)
    with database.reading() as session:
        failed = session.scalars(select(AuditEvent.subject).where(AuditEvent.action == "login failed")).all()
    assert failed == ["experimenter"]


def test_who_guesses_codes_is_slowed_down_and_a_recovery_code_still_opens(
    experimenter: TestClient, database: Database, new_browser: Callable[[], TestClient]
) -> None:
    secret = begin(experimenter)
    page = experimenter.post("/second-factor/confirm", data={"code": code(secret, -1)}).text
    recovery = re.findall(r"<li><code>([0-9a-f-]+)</code></li>", page)
    assert len(recovery) == 10
    browser = new_browser()
    browser.post("/login", data=LOGIN)
    answers = [browser.post("/login/code", data={"code": f"{number:06}"}).status_code for number in range(6)]
    assert answers == [422] * 5 + [429]
    assert browser.post("/login/code", data={"code": code(secret)}).status_code == 429, "even the right one waits"
    assert browser.post("/login/code", data={"code": f" {recovery[0].upper()} "}).status_code == 303
    other = new_browser()
    other.post("/login", data=LOGIN)
    assert other.post("/login/code", data={"code": recovery[0]}).status_code == 422, "once"


def test_the_pause_ends(asked: TestClient, secret: str, database: Database) -> None:
    for number in range(6):
        asked.post("/login/code", data={"code": f"{number:06}"})
    with database.writing() as session:
        session.scalars(select(Experimenter)).one().code_wrong_at = now() - timedelta(minutes=1)
    assert asked.post("/login/code", data={"code": code(secret)}).status_code == 303


def test_recovery_codes_are_stored_hashed_only(experimenter: TestClient, database: Database) -> None:
    page = experimenter.post("/second-factor/confirm", data={"code": code(begin(experimenter))}).text
    shown = re.findall(r"<li><code>([0-9a-f-]+)</code></li>", page)
    with database.reading() as session:
        stored = session.scalars(select(RecoveryCode.code_sha256)).all()
    assert len(stored) == len(set(stored)) == 10
    assert not set(shown) & set(stored)
    assert shown[0] not in experimenter.get("/second-factor").text


def test_setting_it_up_takes_the_password(experimenter: TestClient, database: Database) -> None:
    assert experimenter.post("/second-factor/begin", data={"password": "a guess"}).status_code == 422
    with database.reading() as session:
        assert session.scalars(select(Experimenter.totp_secret)).one() is None


def test_it_is_not_on_before_a_code_was_right(experimenter: TestClient, new_browser: Callable[[], TestClient]) -> None:
    begin(experimenter)
    assert experimenter.post("/second-factor/confirm", data={"code": "000000"}).status_code == 422
    assert new_browser().post("/login", data=LOGIN).headers["location"] == "/studies"


def test_a_session_that_is_left_open_cannot_replace_it_or_turn_it_off(experimenter: TestClient, secret: str) -> None:
    assert experimenter.post("/second-factor/begin", data={"password": PASSWORD}).status_code == 409
    assert experimenter.post("/second-factor/off", data={"code": "000000"}).status_code == 422
    assert experimenter.post("/second-factor/codes", data={"code": "000000"}).status_code == 422
    assert "It is on since" in experimenter.get("/second-factor").text


def test_with_a_code_it_is_turned_off(
    experimenter: TestClient, secret: str, new_browser: Callable[[], TestClient]
) -> None:
    assert experimenter.post("/second-factor/off", data={"code": code(secret)}).status_code == 303
    assert new_browser().post("/login", data=LOGIN).headers["location"] == "/studies"


def test_a_reset_on_the_server_ends_it_too(
    secret: str, database: Database, new_browser: Callable[[], TestClient]
) -> None:
    with database.writing() as session:
        password = accounts.reset_password(session, "experimenter")
    answer = new_browser().post("/login", data={"name": "experimenter", "password": password})
    assert answer.headers["location"] == "/studies"


@pytest.fixture
def strict(settings: Settings, database: Database, password: str) -> Iterator[FastAPI]:
    """The same studio, with a second factor required of everybody."""
    application = create_app(settings.model_copy(update={"require_second_factor": True}))
    make_tables(application.state.studio.database)
    yield application
    application.state.studio.database.dispose()


def test_an_installation_can_require_it_of_everybody(strict: FastAPI, database: Database) -> None:
    with database.writing() as session:
        _, token = api_tokens.create(session, session.scalars(select(Experimenter)).one(), "notebook")
    headers = {"authorization": f"Bearer {token}"}
    browser = TestClient(strict, follow_redirects=False)
    browser.post("/login", data=LOGIN)
    for path in ("/studies", "/account", "/tokens", "/studies/new"):
        assert browser.get(path).headers["location"] == "/second-factor", path
    assert browser.get("/api/v1/studies", headers=headers).status_code == 403
    page = browser.post("/second-factor/confirm", data={"code": code(begin(browser))})
    assert page.status_code == 200
    assert browser.get("/studies").status_code == 200
    assert browser.get("/api/v1/studies", headers=headers).status_code == 200


def of_the_account(database: Database) -> Experimenter:
    with database.reading() as session:
        return session.scalars(select(Experimenter)).one()


def test_the_database_alone_knows_no_secret(secret: str, database: Database, settings: Settings) -> None:
    account = of_the_account(database)
    stored = (account.totp_secret or "").encode()
    raw = base64.b32decode(secret)
    assert secret.encode() not in stored
    assert raw not in base64.urlsafe_b64decode(stored)
    assert second_factor.secret_of(account, second_factor.key_of(settings)) == secret


def test_a_secret_of_another_account_opens_nothing(secret: str, database: Database, settings: Settings) -> None:
    account = of_the_account(database)
    account.id += 1
    with pytest.raises(second_factor.SecretSealed):
        second_factor.secret_of(account, second_factor.key_of(settings))


def test_secrets_of_earlier_versions_open_and_are_sealed_when_the_studio_starts(
    secret: str, asked: TestClient, database: Database, settings: Settings
) -> None:
    with database.writing() as session:
        session.scalars(select(Experimenter)).one().totp_secret = secret
    assert asked.post("/login/code", data={"code": code(secret)}).status_code == 303
    command.stamp(upgrading._config(settings), "head")
    assert migrate(settings) == 0
    account = of_the_account(database)
    assert account.totp_secret != secret
    assert second_factor.secret_of(account, second_factor.key_of(settings)) == secret
    if database.is_sqlite:
        files = settings.data_dir.glob("studio.sqlite3*")
        assert not any(secret.encode() in each.read_bytes() for each in files)


def test_without_the_key_codes_are_refused_in_words_and_a_command_helps(
    secret: str, asked: TestClient, database: Database, settings: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings.signing_key_path.unlink()  # as after restoring the database alone: a new key is made
    refused = asked.post("/login/code", data={"code": code(secret)})
    assert refused.status_code == 503
    assert "put the key&#39;s file (signing.key) back, or to run: python -m app reset-second-factor" in refused.text
    command.stamp(upgrading._config(settings), "head")
    monkeypatch.setenv("DATA_DIR", str(settings.data_dir))
    assert main(["reset-second-factor", "nobody"]) == 1
    assert main(["reset-second-factor", "experimenter"]) == 0
    assert not second_factor.is_on(of_the_account(database))
    assert asked.post("/login", data=LOGIN).headers["location"] == "/studies"


def test_a_recovery_code_needs_no_key(
    experimenter: TestClient, new_browser: Callable[[], TestClient], settings: Settings
) -> None:
    secret = begin(experimenter)
    shown = experimenter.post("/second-factor/confirm", data={"code": code(secret, -1)}).text
    settings.signing_key_path.unlink()
    browser = new_browser()
    browser.post("/login", data=LOGIN)
    recovery = re.findall(r"\b(?:[0-9a-f]{5}-){5}[0-9a-f]{5}\b", shown)[0]
    assert browser.post("/login/code", data={"code": recovery}).headers["location"] == "/studies"
