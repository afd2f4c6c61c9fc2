"""Logging in at an identity provider that really runs: who is let in with which account, and what is not believed."""

import re
import time
from collections.abc import Callable, Iterator
from typing import Any

import httpx2
import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient
from joserfc.jwk import RSAKey
from sqlalchemy import select

from app.db import Database, now
from app.domain.people import AuditEvent, Experimenter, Role
from app.main import make_studio, serve
from app.services.accounts import accounts
from app.settings import Settings
from tests import identity_provider
from tests.conftest import PASSWORD
from tests.identity_provider import CLIENT, SECRET, IdentityProvider

BACK = "http://studio.example/login/provider/back"


@pytest.fixture
def provider() -> Iterator[IdentityProvider]:
    with identity_provider.running(BACK) as provider:
        yield provider


@pytest.fixture
def settings(settings: Settings, provider: IdentityProvider) -> Settings:
    return Settings(
        _env_file=None,
        data_dir=settings.data_dir,
        public_url="http://studio.example",
        oidc_issuer=provider.issuer,
        oidc_client_id=CLIENT,
        oidc_client_secret=SECRET,
    )


@pytest.fixture
def browser(client: TestClient) -> TestClient:
    return client


@pytest.fixture
def change(studio_app: FastAPI, database: Database, settings: Settings) -> Iterator[Callable[..., None]]:
    """From now on, the server is one with other settings."""
    studios = []

    def serve_another(**changed: Any) -> None:
        studios.append(make_studio(settings.model_copy(update=changed)))
        serve(studio_app, studios[-1])

    yield serve_another
    for studio in studios:
        studio.database.dispose()


def make_account(database: Database, name: str, password_hash: str | None = None, **columns: Any) -> None:
    with database.writing() as session:
        columns = {"role": Role.EXPERIMENTER, "must_change_password": False, **columns}
        session.add(Experimenter(name=name, password_hash=password_hash or "-", **columns))


def there_and_back(browser: TestClient, begin: str = "/login/provider") -> httpx2.Response:
    """As a browser goes: to the provider, which knows the person, and back with its code."""
    there = browser.get(begin).headers["location"]
    back = httpx2.get(there).headers["location"]
    assert back.startswith(f"{BACK}?")
    return browser.get(back.removeprefix("http://studio.example"))


def test_the_account_of_the_verified_address_is_let_in(
    browser: TestClient, database: Database, provider: IdentityProvider
) -> None:
    make_account(database, "ada@example.org")
    answer = there_and_back(browser, "/login/provider?next=/studies/new")
    assert (answer.status_code, answer.headers["location"]) == (303, "/studies/new")
    assert browser.get("/studies").status_code == 200
    with database.reading() as session:
        account = session.scalars(select(Experimenter)).one()
        assert account.oidc_subject == f"{provider.issuer} 4711"
        assert session.scalars(select(AuditEvent.action).where(AuditEvent.actor == "ada@example.org")).all() == [
            "account connected to the identity provider",
            "logged in by the identity provider",
        ]


def test_what_is_sent_to_the_provider_has_state_nonce_and_challenge_and_no_secret(browser: TestClient) -> None:
    asked = httpx2.URL(browser.get("/login/provider").headers["location"]).params
    assert asked["response_type"] == "code"
    assert asked["code_challenge_method"] == "S256"
    assert len({asked[name] for name in ("state", "nonce", "code_challenge")}) == 3
    assert SECRET not in str(asked)
    cookie = browser.get("/login/provider").headers["set-cookie"]
    assert "HttpOnly" in cookie
    assert "SameSite=lax" in cookie


def test_the_same_person_finds_the_same_account_after_a_change_of_address(
    browser: TestClient, database: Database, provider: IdentityProvider
) -> None:
    make_account(database, "ada@example.org")
    there_and_back(browser)
    provider.user["email"] = "ada.lovelace@example.org"
    assert there_and_back(browser).status_code == 303


def test_somebody_else_with_the_old_address_does_not(
    browser: TestClient, database: Database, provider: IdentityProvider
) -> None:
    make_account(database, "ada@example.org")
    there_and_back(browser)
    provider.user["sub"] = "4712"
    answer = there_and_back(browser)
    assert (answer.status_code, "no account in this studio" in answer.text) == (403, True)


@pytest.mark.parametrize("verified", [False, None, "true"])
def test_an_address_that_is_not_verified_leads_to_no_account(
    browser: TestClient, database: Database, provider: IdentityProvider, verified: object
) -> None:
    make_account(database, "ada@example.org")
    provider.user["email_verified"] = verified
    assert there_and_back(browser).status_code == 403
    assert browser.get("/studies").status_code == 303


def test_nobody_unknown_is_let_in_unless_the_installation_says_so(
    browser: TestClient, database: Database, change: Callable[..., None]
) -> None:
    assert there_and_back(browser).status_code == 403
    change(oidc_new_accounts="reader")
    assert there_and_back(browser).status_code == 303
    with database.reading() as session:
        account = session.scalars(select(Experimenter)).one()
        assert (account.name, account.role) == ("ada@example.org", "reader")
    assert browser.get("/accounts").status_code == 403


def test_a_disabled_account_stays_shut_out(browser: TestClient, database: Database) -> None:
    make_account(database, "ada@example.org")
    there_and_back(browser)
    with database.writing() as session:
        session.scalars(select(Experimenter)).one().disabled_at = now()
    assert there_and_back(browser).status_code == 403


def test_a_connected_account_has_no_password_until_an_administrator_resets_it(
    browser: TestClient, database: Database, password_hash: str
) -> None:
    make_account(database, "ada@example.org", password_hash)
    there_and_back(browser)
    login = {"name": "ada@example.org", "password": PASSWORD}
    assert browser.post("/login", data=login).status_code == 401
    with database.writing() as session:
        text = accounts.reset_password(session, "ada@example.org")
    assert browser.post("/login", data=login | {"password": text}).status_code == 303


def test_a_code_of_ones_own_is_still_asked_for(browser: TestClient, database: Database) -> None:
    make_account(database, "ada@example.org", totp_secret="A" * 32, second_factor_since=now())
    assert there_and_back(browser).headers["location"] == "/login/code"
    assert browser.get("/studies").status_code == 303


def test_where_a_second_factor_is_required_the_providers_is_enough(
    browser: TestClient, database: Database, change: Callable[..., None]
) -> None:
    change(require_second_factor=True)
    make_account(database, "ada@example.org")
    there_and_back(browser)
    assert browser.get("/studies").status_code == 200


BENT: dict[str, dict[str, Any]] = {
    "another issuer": {"iss": "https://elsewhere.example"},
    "another audience": {"aud": ["another studio"]},
    "several audiences, made for another one": {"aud": [CLIENT, "another studio"], "azp": "another studio"},
    "several audiences and not for whom": {"aud": [CLIENT, "another studio"]},
    "expired": {"exp": int(time.time()) - 3600},
    "without an end": {"exp": None},
    "made in the future": {"iat": int(time.time()) + 7200},
    "another nonce": {"nonce": "of another login"},
    "no nonce": {"nonce": None},
    "nobody": {"sub": ""},
    "a number": {"sub": 4711},
}


@pytest.mark.parametrize("bent", BENT.values(), ids=BENT.keys())
def test_a_token_is_not_believed(
    browser: TestClient, database: Database, provider: IdentityProvider, bent: dict[str, Any]
) -> None:
    make_account(database, "ada@example.org")
    provider.bent = bent
    assert there_and_back(browser).status_code == 401
    assert browser.get("/studies").status_code == 303


def test_a_token_signed_by_somebody_else_is_not_believed(
    browser: TestClient, database: Database, provider: IdentityProvider
) -> None:
    make_account(database, "ada@example.org")
    provider.key = RSAKey.generate_key(2048, {"kid": "first"})
    assert there_and_back(browser).status_code == 401


def test_a_new_key_of_the_provider_is_fetched(
    browser: TestClient, database: Database, provider: IdentityProvider
) -> None:
    make_account(database, "ada@example.org")
    assert there_and_back(browser).status_code == 303
    provider.key = provider.published = RSAKey.generate_key(2048, {"kid": "second"})
    assert there_and_back(browser).status_code == 303


def test_a_login_ends_in_the_browser_in_which_it_began_and_once(
    browser: TestClient, database: Database, new_browser: Callable[[], TestClient]
) -> None:
    make_account(database, "ada@example.org")
    back = httpx2.get(browser.get("/login/provider").headers["location"]).headers["location"]
    address = back.removeprefix("http://studio.example")
    victim = new_browser()
    assert victim.get(address).status_code == 401
    victim.get("/login/provider")
    assert victim.get(address).status_code == 401, "with a login of its own that has begun"
    assert browser.get(address).status_code == 303
    assert browser.get(address).status_code == 401, "the code is used up"


def test_a_code_without_the_verifier_is_refused_by_the_provider(browser: TestClient, database: Database) -> None:
    make_account(database, "ada@example.org")
    back = httpx2.get(browser.get("/login/provider").headers["location"]).headers["location"]
    state, nonce, _, target = browser.cookies["studio_login_attempt"].strip('"').split("|")
    browser.cookies.delete("studio_login_attempt")
    browser.cookies["studio_login_attempt"] = f'"{state}|{nonce}|{"v" * 43}|{target}"'
    assert browser.get(back.removeprefix("http://studio.example")).status_code == 401


def test_a_refusal_of_the_provider_leads_back_to_the_form(browser: TestClient) -> None:
    browser.get("/login/provider")
    answer = browser.get("/login/provider/back?error=access_denied&state=x")
    assert (answer.status_code, "did not let you in" in answer.text) == (401, True)
    assert 'name="password"' in answer.text


def test_a_provider_that_does_not_answer_is_told_and_passwords_still_work(
    browser: TestClient, password: str, change: Callable[..., None]
) -> None:
    change(oidc_issuer="http://127.0.0.1:9")
    answer = browser.get("/login/provider")
    assert (answer.status_code, "does not answer as it should" in answer.text) == (502, True)
    login = {"name": "experimenter", "password": password}
    assert browser.post("/login", data=login).status_code == 303


def test_a_provider_that_calls_itself_otherwise_is_not_used(
    browser: TestClient, provider: IdentityProvider, change: Callable[..., None]
) -> None:
    change(oidc_issuer=f"{provider.issuer}/")
    assert browser.get("/login/provider").status_code == 502


def test_the_form_offers_it_where_there_is_one(browser: TestClient) -> None:
    assert re.search(r'href="/login/provider"', browser.get("/login").text)


def test_without_a_provider_nothing_of_it_is_there(browser: TestClient, change: Callable[..., None]) -> None:
    change(oidc_issuer=None)
    assert "/login/provider" not in browser.get("/login").text
    assert browser.get("/login/provider").status_code == 404
    assert browser.get("/login/provider/back").status_code == 404


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"oidc_issuer": "http://id.example.org", "oidc_client_id": "x"}, "https"),
        ({"oidc_issuer": "https://id.example.org"}, "OIDC_CLIENT_ID"),
    ],
)
def test_settings_that_would_be_unsafe_or_do_nothing_are_refused(wrong: dict[str, str], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        Settings(_env_file=None, **wrong)  # type: ignore[arg-type]
