"""The client for notebooks: what it reads is what the studio exports."""

import json
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from typing import Any

import pandas as pd
import pytest
from fastapi.testclient import TestClient
from pbarl_client import Client, Refused
from sqlalchemy import select

from app.db import Database
from app.domain.models import ModelKind
from app.domain.people import Experimenter
from app.domain.preferences import Query, Response
from app.domain.studies import Participant, Study
from app.paths import DOCS
from app.services.accounts import api_tokens
from app.services.exports import export_tables
from app.services.exports.export_formats import ColumnKind
from app.storage import ArtefactStore
from tests import factories
from tests.finished_study import make_finished_study


@pytest.fixture
def study(database: Database, store: ArtefactStore) -> Study:
    with database.writing() as session:
        return make_finished_study(session, store, people=2, labels=4)


@pytest.fixture
def token(database: Database, password: str) -> str:
    with database.writing() as session:
        return api_tokens.create(session, session.scalars(select(Experimenter)).one(), "a notebook")[1]


@pytest.fixture
def reader(address: str, token: str, study: Study) -> Client:
    return Client(address, token, study.slug)


@pytest.mark.parametrize("page", [2, 1000])
def test_every_table_is_the_one_that_is_exported(
    page: int, reader: Client, experimenter: TestClient, study: Study, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pbarl_client.PAGE", page)
    assert reader.tables() == [table.name for table in export_tables.TABLES]
    for table in export_tables.TABLES:
        plain = [column.name for column in table.columns if column.kind is not ColumnKind.TIME]
        read = reader.table(table.name)[plain].astype("object")
        lines = experimenter.get(f"/studies/{study.slug}/export/{table.name}.jsonl").text.splitlines()
        assert read.where(read.notna(), None).to_dict("records") == [
            {name: row[name] for name in plain} for row in map(json.loads, lines)
        ]


def test_columns_have_the_types_of_the_dictionary(reader: Client) -> None:
    labels = reader.table("labels")
    assert str(labels["response_time_ms"].dtype) == "Int64"
    assert str(labels["superseded"].dtype) == "boolean"
    assert str(labels["created_at"].dtype).endswith("UTC]")


@pytest.mark.sqlite("only there ids are in the order of commits")
def test_what_was_added_since_is_read_alone(
    reader: Client, database: Database, study: Study, store: ArtefactStore
) -> None:
    before = reader.table("labels")
    assert reader.table("labels", since=before).empty
    with database.writing() as session:
        person = session.scalars(select(Participant).where(Participant.study_id == study.id)).first()
        assert person is not None
        query = session.scalars(select(Query).where(Query.participant_id == person.id)).first()
        assert query is not None
        factories.make_label(session, query, Response.EQUAL)
    added = reader.table("labels", since=before)
    assert list(added["response"]) == ["equal"]
    assert reader.table("labels", since=added).empty
    assert len(reader.table("labels")) == len(before) + 1


@pytest.mark.slow  # beside other tests: what makes whole tables gives way to all else
def test_a_whole_table_is_the_same_from_one_file_and_is_fetched_again_only_when_it_has_changed(
    reader: Client, database: Database, study: Study
) -> None:
    for name in reader.tables():
        whole, paged = reader.whole(name), reader.table(name)
        told_of = [column for column in paged if column != "exported_at"]
        pd.testing.assert_frame_equal(whole[told_of], paged[told_of])
        assert reader.whole(name, earlier=whole) is whole
    before = reader.whole("participants")
    with database.writing() as session:
        factories.make_participant(session, session.get_one(Study, study.id))
    after = reader.whole("participants", earlier=before)
    assert len(after) == len(before) + 1
    with pytest.raises(ValueError, match="not what whole"):
        reader.whole("labels", earlier=before)
    with pytest.raises(Refused):
        reader.whole("nothing")


def test_tables_whose_rows_change_cannot_be_read_since(reader: Client) -> None:
    with pytest.raises(ValueError, match="leave `since` out"):
        reader.table("participants", since=reader.table("participants"))
    with pytest.raises(ValueError, match="leave `since` out"):
        reader.table("labels", since=reader.table("ratings"))


def test_bundles_come_by_participant(reader: Client, database: Database, study: Study, store: ArtefactStore) -> None:
    with database.writing() as session:
        theirs = session.get_one(Study, study.id)
        person, _ = factories.make_participant(session, theirs)
        code = person.code
        model = factories.make_model(session, theirs, person, ModelKind.FILTER, factories.filter_metrics(), 20)
        factories.make_bundle(session, store, model)
    assert len(reader.bundles(code)) == 1
    assert reader.bundle(code) == store.read(reader.bundles(code)["sha256"][0])
    with pytest.raises(Refused):
        reader.bundle(code, version=7)


@pytest.mark.sqlite("only there ids are in the order of commits")
def test_the_example_of_the_manual_runs(
    address: str, token: str, study: Study, database: Database, store: ArtefactStore
) -> None:
    with database.writing() as session:
        theirs = session.get_one(Study, study.id)
        person = session.scalars(select(Participant).where(Participant.study_id == study.id)).first()
        assert person is not None
        model = factories.make_model(session, theirs, person, ModelKind.FILTER, factories.filter_metrics(), 21)
        factories.make_bundle(session, store, model)
        code = person.code
    text = (DOCS / "notebooks.md").read_text().partition("```python\n")[2].partition("```")[0]
    for theirs_is, ours in (("http://127.0.0.1:8000", address), ("pbarl_...", token), ("pilot-at-home", study.slug)):
        assert theirs_is in text
        text = text.replace(theirs_is, ours)
    found: dict[str, Any] = {}
    exec(text.replace('"P01"', repr(code)), found)  # noqa: S102  (our own page)
    assert len(found["ratings"]) > 0
    assert found["more"].empty
    assert found["bundle"]


def test_a_refusal_says_what_to_do(address: str, token: str, study: Study) -> None:
    with pytest.raises(Refused, match="401"):
        Client(address, "pbarl_wrong", study.slug).tables()
    with pytest.raises(Refused, match="There is no table of this name"):
        Client(address, token, study.slug).table("nothing")


@pytest.fixture
def elsewhere() -> Iterator[tuple[str, list[str]]]:
    """A server that sends everybody to another of its addresses, and what it was asked."""
    asked = list[str]()

    class Sending(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            asked.append(self.path)
            self.send_response(302)
            self.send_header("Location", "/taken")
            self.end_headers()

        def log_message(self, *_: object) -> None:
            """Nothing."""

    server = HTTPServer(("127.0.0.1", 0), Sending)
    threading.Thread(target=server.serve_forever, args=(0.02,)).start()
    yield f"http://127.0.0.1:{server.server_port}", asked
    server.shutdown()
    server.server_close()


def test_nobody_else_gets_the_token(elsewhere: tuple[str, list[str]]) -> None:
    address, asked = elsewhere
    with pytest.raises(Refused, match="302"):
        Client(address, "pbarl_secret", "pilot").tables()
    assert asked == ["/api/v1/studies/pilot/tables"]
