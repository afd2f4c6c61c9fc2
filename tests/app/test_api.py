"""The same data for programs: by token, with the rights of its account, in pages, and with problems in words."""

import io
import json
from collections.abc import Callable
from typing import Any

import pandas as pd
import pytest
from fastapi import FastAPI
from fastapi.routing import iter_route_contexts
from fastapi.testclient import TestClient
from jsonschema import Draft202012Validator
from sqlalchemy import func, select

from app.db import Database, now
from app.domain.models import ModelKind, Report
from app.domain.people import ApiToken, AuditEvent, Experimenter, Role
from app.domain.preferences import Query, Response
from app.domain.studies import Participant, Study
from app.services.accounts import api_tokens
from app.services.exports import export_tables
from app.services.runs import reports
from app.storage import ArtefactStore
from tests import factories
from tests.finished_study import make_finished_study

Call = Callable[..., Any]


@pytest.fixture
def study(database: Database, store: ArtefactStore) -> Study:
    with database.writing() as session:
        return make_finished_study(session, store, people=2, labels=4)


@pytest.fixture
def token(database: Database, password: str) -> str:
    """A token of the only account, which is an administrator."""
    with database.writing() as session:
        return api_tokens.create(session, session.scalars(select(Experimenter)).one(), "a notebook")[1]


@pytest.fixture
def call(client: TestClient, token: str) -> Call:
    """Asks the API with the token."""

    def ask(path: str, method: str = "GET", **options: Any) -> Any:
        headers = {"Authorization": f"Bearer {token}", **options.pop("headers", {})}
        return client.request(method, f"/api/v1{path}", headers=headers, **options)

    return ask


@pytest.fixture
def as_reader(database: Database, token: str, study: Study) -> None:
    with database.writing() as session:
        factories.give_role(session, Role.READER)


def test_without_a_token_nothing_is_told_and_the_answer_says_what_is_missing(client: TestClient, study: Study) -> None:
    answer = client.get("/api/v1/studies")
    assert answer.status_code == 401
    assert answer.headers["content-type"] == "application/problem+json"
    assert answer.headers["www-authenticate"] == "Bearer"
    assert "Authorization: Bearer" in answer.json()["detail"]


def test_a_login_in_a_browser_is_no_token(experimenter: TestClient, study: Study) -> None:
    assert experimenter.get("/api/v1/studies").status_code == 401


def test_a_revoked_token_is_worth_nothing(call: Call, database: Database) -> None:
    assert call("/me").json()["name"] == "experimenter"
    with database.writing() as session:
        token = session.scalars(select(ApiToken)).one()
        api_tokens.revoke(session, session.scalars(select(Experimenter)).one(), token.id)
    assert call("/me").status_code == 401


def test_a_token_of_an_account_that_may_not_log_in_is_worth_nothing(call: Call, database: Database) -> None:
    with database.writing() as session:
        session.scalars(select(Experimenter)).one().disabled_at = now()
    assert call("/me").status_code == 401


def test_only_the_hash_of_a_token_is_stored_and_its_use_is_noted(call: Call, database: Database, token: str) -> None:
    call("/me")
    with database.reading() as session:
        stored = session.scalars(select(ApiToken)).one()
    assert token not in repr(vars(stored))
    assert stored.last_used_at is not None


def test_guessing_is_slowed_down_as_for_passwords(client: TestClient, study: Study) -> None:
    codes = [client.get("/api/v1/me", headers={"Authorization": "Bearer pbarl_wrong"}).status_code for _ in range(12)]
    assert codes == [401] * 10 + [429] * 2


def test_studies_and_participants(call: Call, study: Study) -> None:
    (line,) = call("/studies").json()
    assert (line["slug"], line["locked"], line["blinded"]) == (study.slug, False, False)
    whole = call(f"/studies/{study.slug}").json()
    assert whole["settings"] == study.settings.model_dump(mode="json")
    assert whole["lock_hash"] is None
    assert [each["participant"] for each in call(f"/studies/{study.slug}/participants").json()] == ["P01", "P02"]


def test_a_participant_is_added_with_a_link_that_works(call: Call, study: Study, new_browser: Call) -> None:
    answer = call(f"/studies/{study.slug}/participants", "POST", json={"count": 2})
    assert answer.status_code == 201
    assert [each["participant"] for each in answer.json()] == ["P03", "P04"]
    path = answer.json()[0]["link"].removeprefix("http://testserver")
    assert path.startswith("/p/")
    assert new_browser().get(path).status_code == 303


def test_a_table_comes_in_pages_with_the_same_rows_as_its_file(
    call: Call, database: Database, study: Study, experimenter: TestClient
) -> None:
    rows: list[dict[str, Any]] = []
    page: str | None = f"/api/v1/studies/{study.slug}/tables/labels?limit=5"
    while page:
        answer = call(page.removeprefix("/api/v1")).json()
        assert len(answer["rows"]) <= 5
        rows, page = rows + answer["rows"], answer["next"]
    lines = experimenter.get(f"/studies/{study.slug}/export/labels.jsonl").text.splitlines()
    expected = [json.loads(line) for line in lines]
    for row in (*rows, *expected):
        del row["exported_at"]
    assert rows == expected


@pytest.mark.parametrize("table", [table.name for table in export_tables.TABLES])
def test_every_exported_table_can_be_read(call: Call, study: Study, table: str) -> None:
    answer = call(f"/studies/{study.slug}/tables/{table}")
    assert answer.status_code == 200
    described = next(each for each in call(f"/studies/{study.slug}/tables").json() if each["name"] == table)
    names = [column["name"] for column in described["columns"]]
    assert all(list(row) == names for row in answer.json()["rows"])
    document = call("/openapi.json").json()
    schema = document["paths"]["/studies/{slug}/tables/{table}"]["get"]["responses"]["200"]["content"]
    page = schema["application/json"]["schema"]["discriminator"]["mapping"][table]
    Draft202012Validator({"$ref": page, "components": document["components"]}).validate(answer.json())


@pytest.mark.parametrize("kind", ["csv", "parquet"])
def test_a_whole_table_is_one_file_and_comes_again_only_when_it_has_changed(
    kind: str, call: Call, experimenter: TestClient, study: Study, database: Database
) -> None:
    address = f"/studies/{study.slug}/tables/labels.{kind}"
    first = call(address)
    rows = _read(kind, first.content)
    lines = experimenter.get(f"/studies/{study.slug}/export/labels.jsonl").text.splitlines()
    assert list(rows["response"]) == [json.loads(line)["response"] for line in lines]
    same = call(address, headers={"If-None-Match": f'"other", {first.headers["etag"]}'})
    assert (same.status_code, same.content, same.headers["etag"]) == (304, b"", first.headers["etag"])
    with database.writing() as session:
        query = session.scalars(select(Query).order_by(Query.id)).first()
        assert query is not None
        factories.make_label(session, query, Response.EQUAL)
    changed = call(address, headers={"If-None-Match": first.headers["etag"]})
    assert changed.status_code == 200
    assert len(_read(kind, changed.content)) == len(rows) + 1
    other = {"csv": "parquet", "parquet": "csv"}[kind]
    there = call(address.replace(kind, other), headers={"If-None-Match": changed.headers["etag"]})
    assert there.status_code == 200, "the same rows in another format are another file"


def _read(kind: str, content: bytes) -> pd.DataFrame:
    return (pd.read_csv if kind == "csv" else pd.read_parquet)(io.BytesIO(content))


def test_bundles_are_listed_and_downloaded(call: Call, database: Database, store: ArtefactStore) -> None:
    with database.writing() as session:
        study = factories.make_study(session)
        person, _ = factories.make_participant(session, study)
        model = factories.make_model(session, study, person, ModelKind.FILTER, factories.filter_metrics(), labels=10)
        factories.make_bundle(session, store, model)
    (bundle,) = call(f"/studies/{study.slug}/participants/P01/bundles").json()
    assert (bundle["version"], bundle["label_count"]) == (1, 10)
    assert call(bundle["download"].removeprefix("/api/v1")).content == b"PK a bundle"


def test_the_newest_report_and_its_figures(call: Call, database: Database, store: ArtefactStore, study: Study) -> None:
    assert call(f"/studies/{study.slug}/report").status_code == 404
    with database.writing() as session:
        run = factories.make_run(session, study, kind="report")
        figures = {"ratings": {"svg": store.put(b"<svg/>")}}
        contents = {"version": reports.VERSION, "blinded": False, "x": 1}
        session.add(Report(study_id=study.id, run_id=run.id, basis="", contents=contents, figures=figures))
    report = call(f"/studies/{study.slug}/report").json()
    assert report["contents"]["x"] == 1
    assert (report["lock_hash"], report["deviations"]) == ("not locked", "none")
    figure = call(report["figures"]["ratings"]["svg"].removeprefix("/api/v1"))
    assert (figure.content, figure.headers["content-type"]) == (b"<svg/>", "image/svg+xml")


def test_whatever_tells_something_of_people_is_kept_with_who_read_it(
    call: Call, studio_app: FastAPI, database: Database, store: ArtefactStore, study: Study
) -> None:
    """Every address of a study, those left out that tell of settings, of files that there are, or draw averages."""
    with database.writing() as session:
        person = session.scalars(select(Participant).where(Participant.study_id == study.id)).first()
        assert person is not None
        factories.make_bundle(session, store, factories.make_model(session, study, person, ModelKind.FILTER, {}))
        run = factories.make_run(session, study, kind="report")
        contents = {"version": reports.VERSION}
        session.add(Report(study_id=study.id, run_id=run.id, basis="", contents=contents, figures={}))
    impersonal = {"/studies/{slug}", "/studies/{slug}/members", "/studies/{slug}/tables", "/studies/{slug}/exports"}
    files = ("/studies/{slug}/exports/{export_id}.zip", "/studies/{slug}/report/figures/{name}.{kind}")
    asked = []
    for route in iter_route_contexts(studio_app.state.api.routes):
        path = getattr(route, "path", "")
        if (
            "GET" not in (getattr(route, "methods", None) or ())
            or "{slug}" not in path
            or path in {*impersonal, *files}
        ):
            continue
        address = path.format(slug=study.slug, code="P01", version=1, table="labels", kind="csv")
        with database.reading() as session:
            before = session.scalar(select(func.count(AuditEvent.id)))
        assert call(address).status_code == 200, address
        with database.reading() as session:
            assert session.scalar(select(func.count(AuditEvent.id))) == (before or 0) + 1, address
        asked.append(path)
    assert len(asked) == 6, asked


def test_a_file_is_asked_for(call: Call, study: Study) -> None:
    answer = call(f"/studies/{study.slug}/exports", "POST", json={"kind": "data"})
    assert (answer.status_code, answer.json()["download"]) == (202, None)
    assert call(f"/studies/{study.slug}/exports").json() == [answer.json()]


@pytest.mark.usefixtures("as_reader")
def test_a_reader_looks_and_does_nothing_else(call: Call, study: Study) -> None:
    assert call(f"/studies/{study.slug}/participants").status_code == 200
    for path, method in (("participants", "POST"), ("tables/ratings", "GET"), ("exports", "POST")):
        answer = call(f"/studies/{study.slug}/{path}", method, json={} if method == "POST" else None)
        assert answer.status_code == 403
        assert "another role" in answer.json()["detail"]


@pytest.mark.parametrize(
    ("path", "status", "words"),
    [
        ("/studies/nowhere", 404, "no such study"),
        ("/nothing", 404, "/api/docs"),
        ("/studies/{slug}/tables/secrets", 404, "no table of this name"),
        ("/studies/{slug}/tables/ratings?limit=0", 422, "limit"),
        ("/studies/{slug}/participants/P99/bundles", 404, "no such participant"),
    ],
)
def test_what_goes_wrong_is_said_in_words(call: Call, study: Study, path: str, status: int, words: str) -> None:
    answer = call(path.format(slug=study.slug))
    assert answer.status_code == answer.json()["status"] == status
    assert answer.headers["content-type"] == "application/problem+json"
    assert words in answer.json()["detail"]


def test_an_address_with_a_line_break_is_answered_as_all_others_are(client: TestClient) -> None:
    """It does not reach the API: patterns of mounted applications end at line breaks."""
    answer = client.get("/api/v1/studies/a%0Ab")
    assert (answer.status_code, answer.headers["content-type"]) == (404, "application/problem+json")


def test_the_openapi_document_has_a_security_scheme_and_an_example_for_everything(client: TestClient) -> None:
    document = client.get("/api/v1/openapi.json").json()
    assert document["components"]["securitySchemes"]["HTTPBearer"]["scheme"] == "bearer"
    operations = [each for methods in document["paths"].values() for each in methods.values()]
    assert all(operation["security"] == [{"HTTPBearer": []}] for operation in operations)
    assert all(operation["description"] for operation in operations)
    assert all("404" in operation["responses"] for operation in operations)
    refusals = [answer for each in operations for code, answer in each["responses"].items() if code >= "400"]
    assert {kind for answer in refusals for kind in answer["content"]} == {"application/problem+json"}


def test_the_documentation_needs_nothing_from_anywhere_else(client: TestClient, studio_app: FastAPI) -> None:
    text = client.get("/api/docs").text
    sources = [part.split('"')[0] for mark in ('src="', 'href="') for part in text.split(mark)[1:]]
    assert [each for each in sources if not each.startswith(("/", "#"))] == []
    paths = studio_app.state.api.openapi()["paths"]
    assert all(f"/api/v1{path}" in text for path in paths)


def test_tokens_are_made_and_revoked_on_a_page(experimenter: TestClient, client: TestClient) -> None:
    made = experimenter.post("/tokens", data={"name": "laptop"}).text
    text = made.split('value="pbarl_')[1].split('"')[0]
    headers = {"Authorization": f"Bearer pbarl_{text}"}
    assert client.get("/api/v1/me", headers=headers).status_code == 200
    shown_later = experimenter.get("/tokens").text
    assert "laptop" in shown_later
    assert text not in shown_later
    address = shown_later.split('action="/tokens/')[1].split('"')[0]
    assert experimenter.post(f"/tokens/{address}").status_code == 303
    assert client.get("/api/v1/me", headers=headers).status_code == 401


def test_nobody_revokes_the_token_of_somebody_else(database: Database, token: str, password_hash: str) -> None:
    with database.writing() as session:
        other = Experimenter(name="other", password_hash=password_hash, must_change_password=False)
        session.add(other)
        session.flush()
        theirs = session.scalars(select(ApiToken)).one()
        with pytest.raises(api_tokens.TokenNotFound):
            api_tokens.revoke(session, other, theirs.id)
