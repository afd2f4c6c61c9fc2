"""Tables over the API page by page, while people go on answering; and who read what is kept."""

import base64
import json
from collections.abc import Callable
from datetime import timedelta
from typing import Any

import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient
from sqlalchemy import event, select, update
from sqlalchemy.orm import Session

from app.db import Database, now
from app.domain.clips import Clip
from app.domain.evaluation import HeadToHead, HeadToHeadAnswer, Rating, Trial
from app.domain.hints import HintEvent, newest_hints
from app.domain.models import ModelKind
from app.domain.participation import Allocation, ConsentRecord, FormAnswer, ParticipantEvent, StageRecord
from app.domain.people import AuditEvent, Experimenter
from app.domain.preferences import LabelEvent, Query, Response
from app.domain.protocol import EvaluatedMethod
from app.domain.self_setting import SelfSetting
from app.domain.studies import Deviation, Participant, Study
from app.questionnaires import library
from app.services.accounts import api_tokens
from app.services.answers import form_answers
from app.services.evaluation import donors, self_setting
from app.services.exports import export_tables
from app.services.participants import withdrawal
from app.storage import ArtefactStore
from tests import factories
from tests.finished_study import make_finished_study

Rows = list[dict[str, Any]]
Get = Callable[..., Any]
ALL_TABLES = [table.name for table in export_tables.TABLES]


@pytest.fixture
def study(database: Database, store: ArtefactStore) -> Study:
    with database.writing() as session:
        study = make_finished_study(session, store, people=3, labels=4)
        for number in range(3):
            session.add(Deviation(study_id=study.id, actor="pat", reason=f"why {number}", before={}, after={}))
        return study


@pytest.fixture
def get(client: TestClient, database: Database, password: str, study: Study) -> Get:
    """Asks the API with a token of the only account."""
    with database.writing() as session:
        token = api_tokens.create(session, session.scalars(select(Experimenter)).one(), "a notebook")[1]

    def ask(path: str) -> Any:
        return client.get(path, headers={"Authorization": f"Bearer {token}"})

    return ask


def plain(rows: Rows) -> Rows:
    return [{name: value for name, value in row.items() if name not in ("exported_at", "deviations")} for row in rows]


def read_all(get: Get, first: str, between: Callable[[], None] = lambda: None) -> Rows:
    """Every row, page by page, with something happening between any two pages."""
    rows: Rows = []
    page: str | None = first
    while page:
        answer = get(page).json()
        rows, page = rows + answer["rows"], answer["next"]
        between()
    return plain(rows)


def address(study: Study, table: str, limit: int = 2) -> str:
    return f"/api/v1/studies/{study.slug}/tables/{table}?limit={limit}"


def somebody_does_everything(session: Session, store: ArtefactStore, study: Study) -> None:
    """One more of everything that tables are made of, for somebody who is there already and for somebody new."""
    people = session.scalars(select(Participant).where(Participant.withdrawn_at.is_(None))).all()
    clip = factories.make_clip(session, store, study)
    first = session.scalars(select(Clip)).first()
    assert first is not None
    for person in people[:2]:
        queries = session.scalars(select(Query).where(Query.participant_id == person.id)).all()
        _undo(session, queries[0])
        factories.make_label(session, queries[1], Response.SKIP)
        factories.make_label(session, factories.make_query(session, person, clip, first))
        session.add(ConsentRecord(participant_id=person.id, version="2", language="en", text="Once more."))
        session.add(FormAnswer(participant_id=person.id, form="demographics", item="age", value="99"))
        _fill_in(session, person, "1")
        session.add(ParticipantEvent(participant_id=person.id, kind="page_hidden", detail={}))
        known = session.scalars(select(StageRecord.stage).where(StageRecord.participant_id == person.id)).all()
        session.add(StageRecord(participant_id=person.id, stage=f"stage {len(known)}"))
        factories.make_model(session, study, person, ModelKind.FILTER, factories.filter_metrics(), labels=len(queries))
        trial = session.scalars(select(Trial).where(Trial.participant_id == person.id).order_by(Trial.ordinal)).first()
        assert trial is not None
        given = session.scalars(select(Rating).where(Rating.trial_id == trial.id)).all()
        uuid = f"{person.id}-{len(given)}"
        more = Rating(trial_id=trial.id, revision=len(given) + 1, satisfaction=1, personalisation=1, client_uuid=uuid)
        session.add(more)
        compared = session.scalars(select(HeadToHead.id).where(HeadToHead.participant_id == person.id)).first()
        said = select(HeadToHeadAnswer.id).where(HeadToHeadAnswer.head_to_head_id == compared)
        revision = len(session.scalars(said).all()) + 1
        answered = {"head_to_head_id": compared, "revision": revision, "client_uuid": f"{person.id}-h{revision}"}
        session.add(HeadToHeadAnswer(response="equal", by_script=True, **answered))
        last = self_setting.newest(session, person.id)
        revision = last.revision + 1 if last else 1
        uuid = f"{person.id}-s{revision}"
        mode = {"speed_far": 0.1, "press": 0.0}
        session.add(
            SelfSetting(
                participant_id=person.id, revision=revision, mode=mode, filmed=True, client_uuid=uuid, by_script=True
            )
        )
        hinted = newest_hints(session, person.id)
        revision = hinted.revision + 1 if hinted else 1
        event = {"revision": revision, "hints": "", "offered": "gentler", "client_uuid": f"{person.id}-t{revision}"}
        session.add(HintEvent(participant_id=person.id, answered=5, **event))
        donors.draw(session, study, person, EvaluatedMethod.AVERAGE, ("cautious",))
    newcomer, _ = factories.make_participant(session, study)
    _fill_in(session, newcomer, "5")
    session.add(Allocation(participant_id=newcomer.id, place=newcomer.number, lot=0.5, considered={}))
    session.add(Deviation(study_id=study.id, actor="pat", reason="later", before={}, after={}))


def _fill_in(session: Session, person: Participant, value: str) -> None:
    form_answers.append(session, person, "tia", {item.name: value for item in library.every()["tia"].items})


def _undo(session: Session, query: Query) -> None:
    revisions = session.scalars(select(LabelEvent.revision).where(LabelEvent.query_id == query.id)).all()
    session.add(
        LabelEvent(query_id=query.id, revision=max(revisions) + 1, client_uuid=f"{query.id}-{max(revisions) + 1}")
    )
    session.flush()


@pytest.mark.parametrize("table", ALL_TABLES)
def test_pages_are_together_the_table_as_it_was_at_the_first_one(
    get: Get, database: Database, store: ArtefactStore, study: Study, table: str
) -> None:
    before = plain(get(address(study, table, 1000)).json()["rows"])
    assert len(before) >= 3

    def meanwhile() -> None:
        with database.writing() as session:
            somebody_does_everything(session, store, session.get_one(Study, study.id))

    limit = max(2, len(before) // 8)
    assert read_all(get, address(study, table, limit), meanwhile) == before
    assert plain(get(address(study, table, 1000)).json()["rows"]) != before


def test_whoever_withdraws_between_two_pages_takes_nobody_elses_rows_along(
    get: Get, database: Database, store: ArtefactStore, study: Study
) -> None:
    before = plain(get(address(study, "labels", 1000)).json()["rows"])

    def second_person_withdraws() -> None:
        with database.writing() as session:
            second = session.scalars(select(Participant).where(Participant.number == 2)).one()
            withdrawal.withdraw(session, store, second, "P02")

    rows = read_all(get, address(study, "labels", 3), second_person_withdraws)
    assert [row for row in rows if row["participant"] != "P02"] == [
        row for row in before if row["participant"] != "P02"
    ]


@pytest.mark.parametrize("table", ["labels", "queries", "forms", "ratings", "evaluations"])
def test_a_page_asks_the_database_for_nothing_that_lies_before_it(
    get: Get, database: Database, study: Study, table: str
) -> None:
    statements: list[str] = []
    event.listen(database.reader, "before_cursor_execute", lambda *call: statements.append(call[2]))
    asked, page = [], address(study, table)
    while page:
        statements.clear()
        page = get(page).json()["next"]
        asked.append(len(statements))
    assert len(asked) >= 3
    assert max(asked[1:]) <= asked[0] + 2, "two for a page that begins with one person and ends with the next"


class TestHostileCursors:
    def forged(self, **changed: Any) -> str:
        cursor = {"of": "1/labels", "after": [1, 1], "newest": {"label_event": 10**9}, **changed}
        return base64.urlsafe_b64encode(json.dumps(cursor).encode()).decode().rstrip("=")

    def test_one_that_is_as_ours_would_be_is_taken(self, get: Get, study: Study) -> None:
        assert get(f"{address(study, 'labels')}&cursor={self.forged()}").status_code == 200

    @pytest.mark.parametrize(
        "changed",
        [
            {"of": "1/ratings"},
            {"of": "2/labels"},
            {"of": None},
            {"after": []},
            {"after": ["1", 1]},
            {"after": [1.5, 1]},
            {"after": [2**70, 1]},
            {"after": [True, 1]},
            {"after": [[1], 1]},
            {"after": [1] * 100},
            {"newest": {}},
            {"newest": {"experimenter": 1}},
            {"newest": {"label_event": None}},
            {"newest": {"label_event": 2**63}},
            {"newest": {"label_event": 1, "experimenter": 1}},
            {"more": 1},
        ],
    )
    def test_any_other_is_refused_in_words(self, get: Get, study: Study, changed: dict[str, Any]) -> None:
        answer = get(f"{address(study, 'labels')}&cursor={self.forged(**changed)}")
        assert answer.status_code == 422
        assert "Begin again without a cursor" in answer.json()["detail"]

    @pytest.mark.parametrize("after", [[1], [-5], [2**63 - 1] * 5, [-(2**63)] * 3, [1, 1, 1, 1, 1, 1]])
    def test_keys_of_any_length_and_size_do_no_harm(self, get: Get, study: Study, after: list[int]) -> None:
        for table in ALL_TABLES:
            made_of = {each.__tablename__: 2**63 - 1 for each in export_tables.BY_NAME[table].made_of}
            cursor = self.forged(of=f"1/{table}", after=after, newest=made_of)
            assert get(f"{address(study, table)}&cursor={cursor}").status_code == 200, table

    @pytest.mark.parametrize("cursor", ["x", "%00", "AAAA", "e30", "W10", "_" * 999, "x" * 2000, "eyJ%ff"])
    def test_rubbish_is_refused(self, get: Get, study: Study, cursor: str) -> None:
        assert get(f"{address(study, 'labels')}&cursor={cursor}").status_code == 422


def test_a_parameter_that_no_address_knows_is_refused_on_every_one(
    studio_app: FastAPI, client: TestClient, database: Database, study: Study, password: str
) -> None:
    with database.writing() as session:
        token = api_tokens.create(session, session.scalars(select(Experimenter)).one(), "a notebook")[1]
    client.headers["authorization"] = f"Bearer {token}"
    api = studio_app.state.api
    for path, methods in api.openapi()["paths"].items():
        for method, operation in methods.items():
            answer = client.request(method, f"/api/v1{path.replace('{slug}', study.slug)}?surprise=1&limit=1", json={})
            known = [each["name"] for each in operation.get("parameters", []) if each["in"] == "query"]
            detail = answer.json()["detail"]
            assert (answer.status_code, "surprise" in detail) == (422, True), path
            assert all(name in detail for name in known)


def test_what_has_replaced_the_offset_is_said(get: Get, study: Study) -> None:
    answer = get(f"/api/v1/studies/{study.slug}/tables/labels?offset=100")
    assert answer.status_code == 422
    assert "cursor, limit" in answer.json()["detail"]
    assert "follow next" in answer.json()["detail"]


class TestRecord:
    def readings(self, database: Database) -> list[tuple[str, str | None]]:
        with database.reading() as session:
            rows = session.execute(
                select(AuditEvent.actor, AuditEvent.subject)
                .where(AuditEvent.action == "table read by the API")
                .order_by(AuditEvent.id)
            )
            return [(actor, subject) for actor, subject in rows]

    def test_who_read_which_table_is_kept_once_however_many_pages_it_took(
        self, get: Get, database: Database, study: Study
    ) -> None:
        read_all(get, address(study, "labels", 1))
        read_all(get, address(study, "forms", 1))
        assert self.readings(database) == [
            ("experimenter", f"{study.slug}/labels"),
            ("experimenter", f"{study.slug}/forms"),
        ]

    def test_reading_it_again_later_is_kept_again(self, get: Get, database: Database, study: Study) -> None:
        get(address(study, "labels"))
        with database.writing() as session:
            session.execute(update(AuditEvent).values(at=now() - timedelta(hours=1)))
        get(address(study, "labels"))
        assert len(self.readings(database)) == 2

    def test_beginning_with_a_forged_cursor_is_kept_as_well(self, get: Get, database: Database, study: Study) -> None:
        cursor = TestHostileCursors().forged()
        get(f"{address(study, 'labels')}&cursor={cursor}")
        assert len(self.readings(database)) == 1

    def test_what_was_refused_was_not_read(self, get: Get, database: Database, study: Study) -> None:
        get(f"/api/v1/studies/{study.slug}/tables/secrets")
        get(f"{address(study, 'labels')}&cursor=x")
        assert self.readings(database) == []
