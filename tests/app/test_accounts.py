"""Accounts and roles: administrators manage accounts, experimenters run studies, readers look and change nothing."""

import re
from collections.abc import Callable, Iterator
from datetime import timedelta

import pytest
from fastapi import FastAPI
from fastapi.routing import iter_route_contexts
from fastapi.testclient import TestClient
from sqlalchemy import func, select

from app.db import Base, Database
from app.domain.people import AuditEvent, Experimenter, Role
from app.services.accounts import browser_sessions
from tests import factories
from tests.conftest import PASSWORD

VALUES = {
    "slug": "pilot",
    "code": "P01",
    "letter": "A",
    "run_id": "1",
    "ordinal": "1",
    "kind": "data",
    "account_id": "1",
}
OWN_OR_NOBODYS = re.compile(r"^/(p|join)/|^/(login|logout|password|tokens|account|second-factor)\b")
"""Of participants, or what everybody may do with their own account."""
PARAMETER = re.compile(r"{(\w+)(?::\w+)?}")

LogIn = Callable[[Role], TestClient]


@pytest.fixture
def log_in(database: Database, new_browser: Callable[[], TestClient], password_hash: str) -> LogIn:
    """Makes an account of a role and gives the browser of whoever is logged in with it."""

    def in_role(role: Role) -> TestClient:
        browser = new_browser()
        with database.writing() as session:
            account = Experimenter(
                name=f"the {role}", role=role, password_hash=password_hash, must_change_password=False
            )
            session.add(account)
            session.flush()
            browser.cookies["studio_experimenter"] = browser_sessions.open_for_experimenter(
                session, account, timedelta(hours=1)
            )
        return browser

    return in_role


def addresses_that_change(application: FastAPI) -> Iterator[str]:
    """Every address of an experimenter that takes a POST."""
    for route in iter_route_contexts(application.routes):
        path = route.path or ""
        if "POST" in (route.methods or ()) and not OWN_OR_NOBODYS.search(path):
            yield PARAMETER.sub(lambda found: VALUES.get(found[1], "1"), path)


def rows(database: Database) -> dict[str, int]:
    """How many there are, the log of who was refused what excepted."""
    with database.reading() as session:
        return {
            table.name: session.scalar(select(func.count()).select_from(table)) or 0
            for table in Base.metadata.sorted_tables
            if table.name != "audit_event"
        }


def test_a_reader_may_change_nothing(studio_app: FastAPI, database: Database, log_in: LogIn) -> None:
    reader = log_in(Role.READER)
    with database.writing() as session:
        study = factories.make_study(session, "Pilot")
        factories.make_participant(session, study)
        factories.give_role(session, Role.READER)
    before = rows(database)
    found = list(addresses_that_change(studio_app))
    assert {"/studies/new", "/studies/pilot/lock", "/studies/pilot/participants", "/accounts"} <= set(found)
    sent = {"typed": "pilot", "count": "1", "name": "x"}
    file = {"file": ("study.zip", b"PK")}
    answers = {path: reader.post(path, data=sent, files=file).status_code for path in found}
    assert answers == dict.fromkeys(found, 403)
    assert rows(database) == before


def test_a_reader_sees_studies_and_is_offered_no_new_one(database: Database, log_in: LogIn) -> None:
    reader = log_in(Role.READER)
    with database.writing() as session:
        factories.make_study(session, "Pilot")
        factories.give_role(session, Role.READER)
    for path in ("/studies", "/studies/pilot", "/studies/pilot/lock", "/studies/pilot/settings"):
        assert reader.get(path).status_code == 200
    assert 'class="looks-only"' in reader.get("/studies/pilot").text
    settings = reader.get("/studies/pilot/settings").text
    assert 'value="Pilot"' in settings
    assert "disabled" in settings
    assert ">Save<" not in settings


@pytest.mark.parametrize("role", [Role.EXPERIMENTER, Role.READER])
def test_accounts_are_for_administrators_only(log_in: LogIn, role: Role) -> None:
    browser = log_in(role)
    assert browser.get("/accounts").status_code == 403
    assert browser.post("/accounts", data={"name": "A friend", "role": "administrator"}).status_code == 403
    assert "/accounts" not in browser.get("/studies").text


def one_time_password(page: str) -> str:
    (password,) = re.findall(r'id="one-time" value="([^"]+)"', page)
    return str(password)


def test_a_new_account_logs_in_once_with_its_one_time_password_and_must_choose_its_own(
    log_in: LogIn, new_browser: Callable[[], TestClient]
) -> None:
    admin = log_in(Role.ADMINISTRATOR)
    page = admin.post("/accounts", data={"name": "A colleague", "role": "reader"}).text
    browser = new_browser()
    answer = browser.post("/login", data={"name": "A colleague", "password": one_time_password(page)})
    assert answer.status_code == 303
    assert browser.get("/studies").headers["location"] == "/password"
    assert one_time_password(page) not in admin.get("/accounts").text


def test_a_disabled_account_is_shut_out_at_once_and_comes_back_when_enabled(
    database: Database, log_in: LogIn, new_browser: Callable[[], TestClient]
) -> None:
    admin, reader = log_in(Role.ADMINISTRATOR), log_in(Role.READER)
    with database.reading() as session:
        account = session.scalars(select(Experimenter.id).where(Experimenter.role == Role.READER)).one()
    assert reader.get("/studies").status_code == 200
    assert admin.post(f"/accounts/{account}/disable").status_code == 303
    assert reader.get("/studies").status_code == 303
    login = {"name": "the reader", "password": PASSWORD}
    assert new_browser().post("/login", data=login).status_code == 401
    admin.post(f"/accounts/{account}/enable")
    assert new_browser().post("/login", data=login).status_code == 303


def test_a_role_takes_effect_at_once_and_is_in_the_audit_log(database: Database, log_in: LogIn) -> None:
    admin, reader = log_in(Role.ADMINISTRATOR), log_in(Role.READER)
    with database.reading() as session:
        account = session.scalars(select(Experimenter.id).where(Experimenter.role == Role.READER)).one()
    admin.post(f"/accounts/{account}/role", data={"role": "administrator"})
    assert reader.get("/accounts").status_code == 200
    with database.reading() as session:
        assert session.scalars(select(AuditEvent.subject).where(AuditEvent.action == "role changed")).all() == [
            "the reader (administrator)"
        ]


@pytest.mark.parametrize(("act", "data"), [("role", {"role": "reader"}), ("disable", {})])
def test_the_last_administrator_cannot_be_lost(
    database: Database, log_in: LogIn, act: str, data: dict[str, str]
) -> None:
    admin = log_in(Role.ADMINISTRATOR)
    with database.reading() as session:
        account = session.scalars(select(Experimenter.id)).one()
    assert admin.post(f"/accounts/{account}/{act}", data=data).status_code == 409
    assert admin.get("/accounts").status_code == 200


@pytest.mark.parametrize("name", ["", "  ", "the administrator", "x" * 100])
def test_an_account_needs_a_name_of_its_own(database: Database, log_in: LogIn, name: str) -> None:
    admin = log_in(Role.ADMINISTRATOR)
    answer = admin.post("/accounts", data={"name": name, "role": "reader"})
    assert answer.status_code in (400, 422)
    with database.reading() as session:
        assert len(session.scalars(select(Experimenter)).all()) == 1
