"""Members of a study: nobody sees what is not theirs, owners invite by name and shut out at once."""

import re
from collections.abc import Callable
from datetime import timedelta

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select

from app.db import Database
from app.domain.people import AuditEvent, Experimenter, Role, StudyMember, StudyRole
from app.domain.studies import Study
from app.services.accounts import api_tokens, browser_sessions
from app.services.studies import membership
from app.storage import ArtefactStore
from tests import factories
from tests.app.study_pages import typed

Somebody = Callable[..., TestClient]


@pytest.fixture
def somebody(database: Database, new_browser: Callable[[], TestClient], password_hash: str) -> Somebody:
    """Makes an account, a member of the studies named, and gives its browser with a token in its headers."""

    def logged_in(name: str, role: Role = Role.EXPERIMENTER, **studies: StudyRole) -> TestClient:
        browser = new_browser()
        with database.writing() as session:
            account = Experimenter(name=name, role=role, password_hash=password_hash, must_change_password=False)
            session.add(account)
            session.flush()
            for slug, study_role in studies.items():
                study = session.scalars(select(Study).where(Study.slug == slug)).one()
                membership.admit(session, study, name, study_role, "the test")
            cookie = browser_sessions.open_for_experimenter(session, account, timedelta(hours=1))
            browser.headers["authorization"] = f"Bearer {api_tokens.create(session, account, 'test')[1]}"
        browser.cookies["studio_experimenter"] = cookie
        return browser

    return logged_in


@pytest.fixture(autouse=True)
def two_studies(database: Database) -> None:
    with database.writing() as session:
        for name in ("Pilot", "Other"):
            factories.make_participant(session, factories.make_study(session, name))


def member_id(database: Database, name: str) -> int:
    with database.reading() as session:
        return session.scalars(select(Experimenter.id).where(Experimenter.name == name)).one()


def test_a_list_of_studies_has_those_of_the_one_who_asks_and_no_others(somebody: Somebody) -> None:
    ada = somebody("ada", pilot=StudyRole.VIEWER)
    assert set(re.findall(r'href="/studies/(pilot|other)"', ada.get("/studies").text)) == {"pilot"}
    assert [each["slug"] for each in ada.get("/api/v1/studies").json()] == ["pilot"]


def test_a_study_of_others_looks_like_none(somebody: Somebody) -> None:
    ada = somebody("ada", pilot=StudyRole.OWNER)
    for prefix in ("", "/api/v1"):
        strange, missing = ada.get(f"{prefix}/studies/other"), ada.get(f"{prefix}/studies/nothing-at-all")
        assert (strange.status_code, strange.text) == (404, missing.text)


def test_whoever_makes_a_study_owns_it_and_nobody_else_sees_it(somebody: Somebody) -> None:
    ada, kim = somebody("ada"), somebody("kim")
    answer = ada.post("/studies/new", data=typed(ada, "/studies/new") | {"name": ["Hers"]})
    assert answer.headers["location"] == "/studies/hers"
    assert ada.get("/api/v1/studies/hers/members").json()[0]["role"] == "owner"
    assert kim.get("/studies/hers").status_code == 404


def test_a_study_of_others_cannot_be_copied_even_by_name(somebody: Somebody) -> None:
    ada = somebody("ada", pilot=StudyRole.VIEWER)
    assert ada.get("/studies/new?like=other").status_code == 404
    assert ada.get("/studies/new?like=pilot").status_code == 403


def test_clips_are_shown_to_members_only(somebody: Somebody, database: Database, store: ArtefactStore) -> None:
    with database.writing() as session:
        study = session.scalars(select(Study).where(Study.slug == "pilot")).one()
        clip = factories.make_clip(session, store, study).video_sha256
    assert somebody("ada", pilot=StudyRole.VIEWER).get(f"/media/{clip}.mp4").status_code == 200
    assert somebody("kim", other=StudyRole.OWNER).get(f"/media/{clip}.mp4").status_code == 404


def test_an_owner_invites_an_account_by_name_and_shuts_it_out_at_once(somebody: Somebody, database: Database) -> None:
    ada, kim = somebody("ada", pilot=StudyRole.OWNER), somebody("kim")
    assert kim.get("/studies/pilot").status_code == 404
    assert ada.post("/studies/pilot/members", data={"name": "kim", "role": "editor"}).status_code == 303
    assert "kim" in ada.get("/studies/pilot/members").text
    assert kim.post("/studies/pilot/joining/open").status_code == 303
    ada.post(f"/studies/pilot/members/{member_id(database, 'kim')}/remove")
    assert kim.get("/studies/pilot").status_code == 404
    assert kim.post("/studies/pilot/joining/open").status_code == 404
    assert kim.get("/api/v1/studies/pilot").status_code == 404
    with database.reading() as session:
        acts = select(AuditEvent.action, AuditEvent.subject).where(AuditEvent.actor == "ada")
        assert [tuple(row) for row in session.execute(acts)] == [
            ("API token made", "test"),
            ("member added", "pilot: kim (editor)"),
            ("member removed", "pilot: kim"),
        ]


def test_the_api_admits_and_removes_members(somebody: Somebody, database: Database) -> None:
    ada, kim = somebody("ada", pilot=StudyRole.OWNER), somebody("kim")
    members = ada.post("/api/v1/studies/pilot/members", json={"name": "kim", "role": "viewer"}).json()
    assert {each["name"]: each["role"] for each in members} == {"ada": "owner", "kim": "viewer"}
    assert kim.get("/api/v1/studies/pilot/members").json() == members
    assert kim.delete(f"/api/v1/studies/pilot/members/{member_id(database, 'ada')}").status_code == 403
    assert ada.delete(f"/api/v1/studies/pilot/members/{member_id(database, 'kim')}").status_code == 204
    assert kim.get("/api/v1/studies/pilot/members").status_code == 404


@pytest.mark.parametrize("role", [StudyRole.VIEWER, StudyRole.EDITOR])
def test_only_owners_decide_who_is_a_member_and_delete(somebody: Somebody, role: StudyRole) -> None:
    ada = somebody("ada", pilot=role)
    somebody("kim")
    assert ada.post("/studies/pilot/members", data={"name": "kim", "role": "viewer"}).status_code == 403
    assert ada.post("/studies/pilot/delete", data={"typed": "pilot"}).status_code == 403
    assert ">Make a member<" not in ada.get("/studies/pilot/members").text


def test_a_viewer_looks_and_is_offered_and_allowed_nothing_else(somebody: Somebody) -> None:
    ada = somebody("ada", pilot=StudyRole.VIEWER, other=StudyRole.EDITOR)
    assert 'class="looks-only"' in ada.get("/studies/pilot").text
    assert 'class="may-change"' in ada.get("/studies/other").text
    assert ada.get("/studies/pilot/export/labels.csv").status_code == 403
    assert ada.post("/studies/pilot/participants", data={"count": 1}).status_code == 403
    assert ada.post("/studies/other/participants", data={"count": 1}).status_code == 303


def test_the_last_owner_stays_one(somebody: Somebody, database: Database) -> None:
    ada = somebody("ada", pilot=StudyRole.OWNER)
    assert ada.post("/studies/pilot/members", data={"name": "ada", "role": "viewer"}).status_code == 409
    assert ada.post(f"/studies/pilot/members/{member_id(database, 'ada')}/remove").status_code == 409


def test_an_owner_may_leave_when_there_is_another(somebody: Somebody, database: Database) -> None:
    ada = somebody("ada", pilot=StudyRole.OWNER)
    somebody("kim", pilot=StudyRole.OWNER)
    answer = ada.post(f"/studies/pilot/members/{member_id(database, 'ada')}/remove")
    assert (answer.status_code, answer.headers["location"]) == (303, "/studies")


@pytest.mark.parametrize(
    ("name", "role", "said"),
    [("nobody", "viewer", "no account of this name"), ("reader", "editor", "can only be a viewer")],
)
def test_who_cannot_be_invited_is_said_beside_the_name(
    somebody: Somebody, database: Database, name: str, role: str, said: str
) -> None:
    ada = somebody("ada", pilot=StudyRole.OWNER)
    somebody("reader", Role.READER)
    answer = ada.post("/studies/pilot/members", data={"name": name, "role": role})
    assert (answer.status_code, said in answer.text, f'value="{name}"' in answer.text) == (422, True, True)
    with database.reading() as session:
        assert len(session.scalars(select(StudyMember)).all()) == 1


def test_an_editor_whose_account_becomes_a_readers_only_looks(somebody: Somebody, database: Database) -> None:
    ada = somebody("ada", pilot=StudyRole.OWNER)
    with database.writing() as session:
        session.scalars(select(Experimenter)).one().role = Role.READER
    assert ada.get("/studies/pilot").status_code == 200
    assert ada.post("/studies/pilot/joining/open").status_code == 403


def test_administrators_see_every_study(somebody: Somebody) -> None:
    admin = somebody("root", Role.ADMINISTRATOR)
    assert {each["slug"] for each in admin.get("/api/v1/studies").json()} == {"pilot", "other"}
    assert admin.post("/studies/pilot/members", data={"name": "root", "role": "owner"}).status_code == 303
