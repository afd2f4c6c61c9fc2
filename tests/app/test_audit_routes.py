"""Every act and every look at something personal is in the audit log: read from the router, so a new route is asked."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from datetime import timedelta
from pathlib import Path
from typing import Any

import pyotp
import pytest
from fastapi import FastAPI
from fastapi.routing import iter_route_contexts
from fastapi.testclient import TestClient
from sqlalchemy import select

from app.db import Database, now
from app.domain.models import Export, ModelKind, Report, RunKind, RunStatus
from app.domain.people import AuditEvent, Experimenter
from app.domain.power_plan import PowerInputs
from app.domain.preferences import Query
from app.domain.protocol import EvaluationMode, EvaluationSettings
from app.domain.studies import Participant, Study
from app.services.accounts import api_tokens, browser_sessions, second_factor
from app.services.archives import archive
from app.services.participants import withdrawal
from app.services.runs import reports
from app.storage import ArtefactStore
from tests import factories
from tests.app.study_pages import typed
from tests.conftest import PASSWORD

SLUG = "feeding-at-home"
POWER = {name: str(value) for name, value in PowerInputs().model_dump(mode="json").items()}
S, P = f"/studies/{SLUG}", f"/studies/{SLUG}/participants/P01"
API = "/api/v1"


@dataclass
class Act:
    """A request, and what the audit log calls it."""

    name: str
    action: str
    address: str
    form: Mapping[str, Any] | None = None
    """None: a GET"""


NOT_PERSONAL = {
    "show_login": "an empty form",
    "show_metrics": "numbers of the whole studio, for the operator's token",
    "show_password": "an empty form",
    "show_accounts": "who has an account; every change of it is recorded",
    "show_new_study": "a form",
    "show_texts": "our own texts",
    "show_settings": "the study's settings",
    "show_lock": "the study's settings",
    "show_power": "what is supposed about people who have not come",
    "download_lock": "the study's settings",
    "download_preregistration": "the study's settings",
    "download_analysis": "our own script",
    "show_translations": "the study's own texts",
    "show_members": "who has an account; every change of it is recorded",
    "api list_members": "who has an account; every change of it is recorded",
    "show_joining": "an address without anybody's name",
    "show_erasing": "a form",
    "show_put_away": "a form",
    "show_help": "words",
    "show_studies": "numbers of studies; must work while nothing can be written",
    "stream_studies": "as show_studies",
    "show_study": "codes and progress, no answers; must work while nothing can be written",
    "stream_study": "as show_study",
    "show_exports": "which files there are; each download is recorded",
    "forget_seal_key": "leads to show_exports",
    "show_import": "a form",
    "show_api": "the documentation",
    "show_own_account": "one's own logins",
    "show_second_factor": "a form",
    "show_code": "a form",
    "begin_provider_login": "nobody yet",
    "begin_second_factor": "nothing is in force yet; turning it on is recorded",
    "show_tokens": "names of one's own tokens",
    "show_video": "a robot",
    "show_poster": "a robot",
    "show_proof": "hashes and numbers, of nobody",
    "show_start": "leads to show_studies",
    "show_health": "whether answers can be kept",
    "show_life": "whether the server answers",
    "static": "our own files",
    "api openapi": "the documentation",
    "api show_account": "one's own name",
    "api list_studies": "names of studies",
    "api show_study": "the study's settings",
    "api list_tables": "the data dictionary",
    "api list_exports": "which files there are; each download is recorded",
}
RECORDED_AS_ANOTHER = {
    "stream_participant": "show_participant",
    "save_translations": "change_settings",
    "join_study_now": "add_participants",
    "enter_code": "log_in",
    "end_provider_login": "log_in",
}
"""They call the same function, which records it."""
OF_PARTICIPANTS = ("/p/", "/join/")
"""What participants do themselves is kept in rows of its own, with its time; but for what ends with those rows."""


def names(application: FastAPI) -> Iterator[str]:
    for each in iter_route_contexts(application.routes):
        if each.path != API and not (each.path or "").startswith(OF_PARTICIPANTS):
            yield str(getattr(each, "name", ""))
    for each in iter_route_contexts(application.state.api.routes):
        yield f"api {getattr(each, 'name', '')}"


@dataclass
class Place:
    """A studio with something for every act, and the acts in an order in which each of them is possible."""

    acts: list[Act]
    browser: TestClient
    database: Database
    headers: Mapping[str, str]
    files: dict[str, Path] = field(default_factory=dict)

    def newest(self, action: str) -> int:
        """How often this is in the log."""
        with self.database.reading() as session:
            return len(session.scalars(select(AuditEvent.id).where(AuditEvent.action == action)).all())

    def do(self, act: Act) -> int:
        """The status."""
        headers = self.headers if act.address.startswith(API) else {}
        if act.form is None:
            return self.browser.get(act.address, headers=headers).status_code
        if act.name in ("api remove_member", "api revoke_link"):
            return self.browser.delete(act.address, headers=headers).status_code
        if act.address.startswith(API):
            return self.browser.post(act.address, json=act.form, headers=headers).status_code
        if act.name == "import_study":
            with self.files["archive"].open("rb") as file:
                return self.browser.post(act.address, files={"file": file}).status_code
        return self.browser.post(act.address, data=act.form).status_code


@pytest.fixture
def place(database: Database, store: ArtefactStore, experimenter: TestClient, tmp_path: Path) -> Place:
    settings = EvaluationSettings(mode=EvaluationMode.PHYSICAL)
    with database.writing() as session:
        study = factories.make_study(session, evaluation=settings)
        people = [factories.make_participant(session, study)[0] for _ in range(3)]
        rater = people[0]
        factories.answer_everything(session, store, study, rater)
        factories.make_robots(session, store, study, rater)
        model = factories.make_model(session, study, rater, ModelKind.FILTER, factories.filter_metrics())
        factories.make_bundle(session, store, model)
        failed = factories.make_run(session, study, rater, status=RunStatus.FAILED)
        export = Export(study_id=study.id, kind="data", requested_by="pat", finished_at=now())
        session.add(export)
        account = session.scalars(select(Experimenter)).one()
        token, text = api_tokens.create(session, account, "a notebook")
        other = Experimenter(name="kim", password_hash=account.password_hash, must_change_password=False)
        pilot = factories.make_study(session, "Pilot")
        session.add(other)
        session.flush()
        query = session.scalars(select(Query.id).where(Query.participant_id == rater.id)).first()
        withdrawal.withdraw(session, store, people[2], "pat")
        elsewhere = browser_sessions.open_for_experimenter(session, account, timedelta(hours=1))
        session.flush()
        login_id = browser_sessions.of_experimenter(session, account, elsewhere)[0][0].id
        export_id, run_id, token_id, other_id = export.id, failed.id, token.id, other.id
        # The withdrawal took them back.
        export.artefact_sha256, export.byte_count = store.put(b"PK an export"), 12
        report_run = factories.make_run(session, study, kind=RunKind.REPORT)
        session.add(Report(study_id=study.id, run_id=report_run.id, basis="b", contents={}, figures={}))
        archive.write(session, store, pilot, tmp_path / "pilot.zip")
    new_study = typed(experimenter, f"/studies/new?like={SLUG}")
    settings_form = typed(experimenter, f"{S}/settings") | {"name": ["Feeding elsewhere"]}
    acts = [
        Act("log_in", "logged in", "/login", {"name": "kim", "password": PASSWORD}),
        Act("log_in", "logged in", "/login", {"name": "experimenter", "password": PASSWORD}),
        Act("add_account", "account created", "/accounts", {"name": "ada", "role": "reader"}),
        Act("reset_account", "password reset", f"/accounts/{other_id}/password", {}),
        Act("change_account_role", "role changed", f"/accounts/{other_id}/role", {"role": "reader"}),
        Act("remove_second_factor", "second factor turned off", f"/accounts/{other_id}/second-factor/off", {}),
        Act("disable_account", "account disabled", f"/accounts/{other_id}/disable", {}),
        Act("enable_account", "account enabled", f"/accounts/{other_id}/enable", {}),
        Act("admit_member", "member added", f"{S}/members", {"name": "kim", "role": "viewer"}),
        Act("remove_member", "member removed", f"{S}/members/{other_id}/remove", {}),
        Act("show_answers", "answers viewed", f"{S}/answers"),
        Act("show_answer", "answers viewed", f"{S}/answers/{query}"),
        Act("exclude_answer", "answer excluded", f"{S}/answers/{query}/exclude", {"reason": "the phone rang"}),
        Act("include_answer", "answer taken in again", f"{S}/answers/{query}/include", {}),
        Act("show_audit", "audit log viewed", "/audit"),
        Act("download_audit", "audit log exported", "/audit/log.csv"),
        Act("download_head", "head of the audit log downloaded", "/audit/head.json"),
        Act("download_receipt", "receipt downloaded", "/audit/receipts/1.json"),
        Act("create_study", "study created", "/studies/new", new_study),
        Act("change_settings", "settings changed", f"{S}/settings", settings_form),
        Act("open_preview", "preview opened", f"{S}/preview", {}),
        Act("ask_power", "power plan asked for", f"{S}/power", POWER),
        Act("lock_study", "study locked", f"{S}/lock", {"typed": SLUG}),
        Act("add_participants", "participant added", f"{S}/participants", {"count": 1}),
        Act("show_links", "personal links viewed", f"{S}/links/KEY"),
        Act("show_sheet", "personal links viewed", f"{S}/links/KEY/sheet"),
        Act("download_links", "personal links viewed", f"{S}/links/KEY/links.csv"),
        Act("renew_link", "link renewed", f"{P}/link", {}),
        Act("revoke_link", "link revoked", f"{P}/link/revoke", {}),
        Act("api revoke_link", "link revoked", f"{API}{P}/link", {}),
        Act("renew_links", "link renewed", f"{S}/selection/links", {"code": ["P01"]}),
        Act("open_joining", "joining opened", f"{S}/joining/open", {}),
        Act("close_joining", "joining closed", f"{S}/joining/close", {}),
        Act("download_bundles", "bundle downloaded", f"{S}/selection/bundles.zip", {"code": ["P01"]}),
        Act("download_bundle", "bundle downloaded", f"{P}/bundles/1.zip"),
        Act("retry_run", "run retried", f"{S}/runs/{run_id}/retry", {}),
        Act("show_participant", "participant's page viewed", P),
        Act("operate", "trials viewed", f"{P}/operate"),
        Act("start_trial", "trial started", f"{P}/trials/1/start", {}),
        Act("finish_trial", "trial done", f"{P}/trials/1/done", {}),
        Act("repeat_trial", "trial repeated", f"{P}/trials/1/repeat", {"reason": "it fell"}),
        Act("download_controller", "controller downloaded", f"{P}/controllers/A.zip"),
        Act("show_seal_key", "seal key shown", f"{S}/export/seal-key", {}),
        Act("unblind_study", "study unblinded", f"{S}/unblind", {"typed": SLUG}),
        Act("show_unblinding", "key of letters viewed", f"{S}/unblind"),
        Act("show_results", "results viewed", f"{S}/results"),
        Act("show_figure", "results viewed", f"{S}/results/figures/ratings.svg"),
        Act("download_methods_text", "results viewed", f"{S}/results/methods_and_results.md"),
        Act("request_export", "archive export requested", f"{S}/export/files/archive", {}),
        Act("download_export", "data export downloaded", f"{S}/export/files/{export_id}.zip"),
        Act("download_table", "table exported", f"{S}/export/labels.csv"),
        Act("import_study", "study imported", "/import", {}),
        Act("create_token", "API token made", "/tokens", {"name": "another"}),
        Act("api admit_member", "member added", f"{API}{S}/members", {"name": "kim", "role": "viewer"}),
        Act("api remove_member", "member removed", f"{API}{S}/members/{other_id}", {}),
        Act("api list_participants", "participants read by the API", f"{API}{S}/participants"),
        Act("api add_participants", "participant added", f"{API}{S}/participants", {"count": 1}),
        Act("api list_bundles", "bundles read by the API", f"{API}{P}/bundles"),
        Act("api download_bundle", "bundle downloaded", f"{API}{P}/bundles/1.zip"),
        Act("api show_report", "report read by the API", f"{API}{S}/report"),
        Act("api show_figure", "report read by the API", f"{API}{S}/report/figures/ratings.svg"),
        Act("api read_table", "table read by the API", f"{API}{S}/tables/labels"),
        Act("api download_table", "table read by the API", f"{API}{S}/tables/labels.csv"),
        Act("api request_export", "data export requested", f"{API}{S}/exports", {"kind": "data"}),
        Act("api download_export", "data export downloaded", f"{API}{S}/exports/{export_id}.zip"),
        Act("revoke_token", "API token revoked", f"/tokens/{token_id}/revoke", {}),
        Act("erase_participant", "participant withdrew", f"{P}/erase", {"typed": "P01"}),
        Act("put_study_away", "study put away", f"{S}/away", {}),
        Act("take_study_out", "study taken out again", f"{S}/back", {}),
        Act("delete_study", "study deleted", f"{S}/delete", {"typed": SLUG}),
        Act("end_login", "logged out elsewhere", f"/account/logins/{login_id}/end", {}),
        Act("end_other_logins", "logged out everywhere else", "/account/logins/end-others", {}),
        Act("confirm_second_factor", "second factor turned on", "/second-factor/confirm", {"code": "CODE"}),
        Act("renew_recovery_codes", "recovery codes renewed", "/second-factor/codes", {"code": "CODE"}),
        Act("turn_off_second_factor", "second factor turned off", "/second-factor/off", {"code": "CODE"}),
        Act(
            "change_password",
            "password changed",
            "/password",
            {"current": PASSWORD, "new": "another password", "again": "another password"},
        ),
        Act("log_out", "logged out", "/logout", {}),
    ]
    headers = {"Authorization": f"Bearer {text}"}
    return Place(acts, experimenter, database, headers, {"archive": tmp_path / "pilot.zip"})


def test_every_route_is_recorded_or_says_why_not(place: Place, studio_app: FastAPI) -> None:
    recorded = {act.name for act in place.acts}
    assert not recorded & (NOT_PERSONAL.keys() | RECORDED_AS_ANOTHER.keys())
    assert set(names(studio_app)) == recorded | NOT_PERSONAL.keys() | (RECORDED_AS_ANOTHER.keys() - {"join_study_now"})
    assert set(RECORDED_AS_ANOTHER.values()) <= recorded


def test_whatever_is_done_or_looked_at_is_in_the_log(place: Place) -> None:
    key = ""
    for act in place.acts:
        _pass_an_hour(place.database)
        act.address = act.address.replace("KEY", key)
        if act.name == "api show_report":
            with place.database.writing() as session:
                session.scalars(select(Report)).one().contents = {"version": reports.VERSION}
        if "second factor" in act.action or "recovery" in act.action:
            act.form = _with_code(place.database, on=act.name != "confirm_second_factor")
        before = place.newest(act.action)
        status = place.do(act)
        assert place.newest(act.action) > before, (act.name, status)
        assert status < 400 or "figure" in act.name, act.name  # no figure was drawn; who asked is known all the same
        if act.name == "add_participants":
            key = place.browser.post(act.address, data=act.form).headers["location"].rpartition("/")[2]


def _with_code(database: Database, *, on: bool) -> Mapping[str, str]:
    """Give every account a second factor whose next code is known."""
    with database.writing() as session:
        for account in session.scalars(select(Experimenter)):
            account.totp_secret, account.totp_used_step = "A" * 32, None
            account.second_factor_since = now() if on else None
    return {"code": pyotp.TOTP("A" * 32).at(second_factor.present_step() * second_factor.STEP_S)}


def _pass_an_hour(database: Database) -> None:
    with database.writing() as session:
        for row in session.scalars(select(AuditEvent)):
            row.at -= timedelta(hours=1)


def test_who_looks_again_within_the_hour_leaves_no_further_row(place: Place) -> None:
    for _ in range(3):
        place.browser.get(P)
    assert place.newest("participant's page viewed") == 1


def test_a_page_is_not_given_away_when_the_look_cannot_be_recorded(
    place: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("app.services.audit.record", fail)
    with pytest.raises(OSError, match="No space"):
        place.browser.get(P)
    assert place.browser.get(S).status_code == 200


def test_a_participant_who_withdraws_and_one_who_joins_are_in_the_log(
    place: Place, new_browser: Callable[[], TestClient]
) -> None:
    with place.database.writing() as session:
        study = session.scalars(select(Study).where(Study.slug == SLUG)).one()
        study.stored_settings = {**study.stored_settings, "panel_parameter": ""}
        person, token = factories.make_participant(session, study)
    browser = new_browser()
    browser.get(f"/p/{token}")
    before = place.newest("participant withdrew")
    assert browser.post("/p/withdraw").status_code == 303
    assert place.newest("participant withdrew") == before + 1
    with place.database.reading() as session:
        assert session.get_one(Participant, person.id).withdrawn_at is not None
