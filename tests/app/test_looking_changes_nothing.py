"""Looking at any page changes nothing: link scanners, prefetching browsers and reloads do it without anybody's wish."""

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import pytest
from fastapi import FastAPI
from fastapi.routing import iter_route_contexts
from fastapi.testclient import TestClient
from sqlalchemy import select
from sqlalchemy.orm import Session

from app.db import Base, Database, now
from app.domain.models import Export, ModelKind
from app.domain.people import Experimenter
from app.domain.preferences import Query
from app.domain.protocol import EvaluationSettings
from app.domain.studies import Study
from app.questionnaires import library
from app.services.accounts import api_tokens
from app.services.answers import form_answers
from app.services.evaluation import head_to_heads
from app.services.participants import recruitment_panel
from app.storage import ArtefactStore
from tests import factories
from tests.made_once import made_once

WHO_LOOKED = {"audit_event", "browser_session"}
"""Tables that remember who looked, and in which browser they may look on."""
REACHED = {
    ("participant", "last_seen_at"),
    ("participant", "completed_at"),
    ("query", "served_at"),
    ("trial", "shown_at"),
    ("head_to_head", "shown_at"),
    ("stage_record", "row"),
    ("participant_event", "row"),
}
"""That a participant's own browser has reached something, noted once; looking again adds nothing."""

Rows = dict[tuple[Any, ...], dict[str, Any]]
Change = tuple[str, str]


def everything(database: Database) -> Rows:
    with database.reading() as session:
        return {
            (table.name, *(row[column.name] for column in table.primary_key)): dict(row)
            for table in Base.metadata.sorted_tables
            for row in session.execute(select(table)).mappings()
        }


def changes(before: Rows, after: Rows) -> set[Change]:
    """Table and column of whatever differs; of a row that came or went the column is called "row"."""
    found = {(key[0], "row") for key in before.keys() ^ after.keys()}
    for key in before.keys() & after.keys():
        found |= {(key[0], name) for name, value in before[key].items() if after[key][name] != value}
    return {each for each in found if each[0] not in WHO_LOOKED}


@dataclass
class Place:
    """A study with something at every address, and the words that fill the addresses in."""

    addresses: list[str]
    database: Database
    person: str
    """The personal link of somebody who is being asked."""
    rater: str
    """That of somebody who is shown robots."""
    chooser: str
    """That of somebody who has rated them and is shown two side by side."""
    api_token: str

    def changed_by(
        self, browser: TestClient, headers: dict[str, str] | None = None, link: str = ""
    ) -> tuple[set[Change], int]:
        """What opening every address once has changed, and how many of them there were for this visitor.

        ``link``: the visitor's own personal link; with that of somebody else they would become that person.
        """
        before, found = everything(self.database), 0
        for address in self.addresses:
            found += browser.get(address.replace(self.person, link or self.person), headers=headers).status_code < 400
        return changes(before, everything(self.database)), found


@pytest.fixture
def place(studio_app: FastAPI, database: Database, store: ArtefactStore, password: str) -> Place:
    with database.writing() as session:
        words, join_token, person, rater, chooser, api_token = made_once(_make_place, session, store)
    addresses = list(_addresses(studio_app, words, join_token, person))
    return Place(addresses, database, f"/p/{person}", f"/p/{rater}", f"/p/{chooser}", api_token)


def _make_place(session: Session, store: ArtefactStore) -> tuple[dict[str, str], str, str, str, str, str]:
    """Words that fill in addresses, then tokens: to join, of the person, the rater and the chooser, and of the API."""
    settings = EvaluationSettings(methods=("reference", "pbarl"), head_to_heads=1, instruments=("tia",))
    study = factories.make_study(session, evaluation=settings, instruments=("tia",), panel_parameter="")
    person, person_token = factories.make_participant(session, study)
    factories.make_queries(session, store, person, 4)
    model = factories.make_model(session, study, person, ModelKind.FILTER, factories.filter_metrics())
    factories.make_bundle(session, store, model)
    rater, rater_token = factories.make_participant(session, study)
    factories.answer_everything(session, store, study, rater)
    trial = factories.make_robots(session, store, study, rater)[0]
    factories.make_controller(session, store, rater, "pbarl")
    chooser, chooser_token = factories.make_participant(session, study)
    factories.answer_everything(session, store, study, chooser)
    factories.rate_everything(session, factories.make_robots(session, store, study, chooser))
    given = {item.name: "3" for item in library.every()["tia"].items}
    for letter in "AB":
        form_answers.append(session, chooser, "tia", given, letter)
    head_to_head = head_to_heads.of_participant(session, chooser.id)[0]
    file = store.put(b"PK an export")
    export = Export(
        study_id=study.id,
        kind="data",
        requested_by="pat",
        finished_at=now(),
        artefact_sha256=file,
        byte_count=12,
    )
    session.add(export)
    session.flush()
    query = session.scalars(select(Query).where(Query.participant_id == person.id)).first()
    assert query is not None
    session.refresh(query, ["left_clip"])
    words = {
        "slug": study.slug,
        "code": person.code,
        "version": "1",
        "letter": "A",
        "instrument": "tia",
        "export_id": str(export.id),
        "trial_id": str(trial.id),
        "head_to_head_id": str(head_to_head.id),
        "query_id": str(query.id),
        "sha256": query.left_clip.video_sha256,
        "table": "labels",
        "script": "analysis.py",
        "name": "ratings",
        "key": "x" * 20,
        "number": "1",
    }
    join_token = recruitment_panel.open_joining(session, study, "pat")
    token = api_tokens.create(session, session.scalars(select(Experimenter)).one(), "a notebook")[1]
    return words, join_token, person_token, rater_token, chooser_token, token


def _addresses(application: FastAPI, words: dict[str, str], join_token: str, person_token: str) -> Iterator[str]:
    """Every address that can be looked at, filled in; from the router, so that a new one is among them."""
    paths = {
        each.path for each in iter_route_contexts(application.routes) if each.path and "GET" in (each.methods or ())
    }
    api = application.state.api
    paths |= {f"/api/v1{path}" for path, methods in api.openapi()["paths"].items() if "get" in methods}
    for path in sorted(paths):
        if path.endswith("/live"):
            continue  # an endless stream; reads through the same functions as its page
        token = join_token if path.startswith("/join") else person_token
        for kind in ("csv", "jsonl") if "{table}.{kind}" in path else ("svg", "png"):
            filled = {**words, "token": token, "kind": kind}
            yield re.sub(r"{(\w+)(:\w+)?}", lambda part, known=filled: known[part[1]], path)  # type: ignore[misc]


def test_every_address_is_tried(place: Place) -> None:
    assert len(set(place.addresses)) > 45
    assert any(address.startswith("/join/") for address in place.addresses)
    assert any(address.startswith("/api/v1/studies/feeding-at-home/tables/") for address in place.addresses)


def test_a_stranger_changes_nothing(place: Place, new_browser: Callable[[], TestClient]) -> None:
    """Whoever finds a link in a mail, such as the program that looks for harmful ones, opens it without cookies."""
    before = everything(place.database)
    for address in place.addresses:
        new_browser().get(address)
    assert changes(before, everything(place.database)) == set()


@pytest.mark.parametrize("who", ["person", "rater", "chooser"])
def test_a_participant_changes_only_what_they_have_reached_and_that_once(
    place: Place, client: TestClient, who: str
) -> None:
    link = getattr(place, who)
    client.get(link)
    first, found = place.changed_by(client, link=link)
    assert first <= REACHED
    assert found > 10
    again, _ = place.changed_by(client, link=link)
    assert again <= {("participant", "last_seen_at")}


def test_an_experimenter_changes_nothing(place: Place, experimenter: TestClient) -> None:
    changed, found = place.changed_by(experimenter)
    assert changed == set()
    assert found > 25


def test_a_program_changes_nothing_but_when_its_token_was_used(place: Place, client: TestClient) -> None:
    changed, found = place.changed_by(client, {"Authorization": f"Bearer {place.api_token}"})
    assert changed == {("api_token", "last_used_at")}
    assert found > 12


def test_a_study_whose_address_was_looked_at_has_nobody_new(
    place: Place, client: TestClient, database: Database
) -> None:
    with database.reading() as session:
        study = session.scalars(select(Study)).one()
    assert client.get(f"/join/{study.join_token}").status_code == 200
    assert not client.cookies
