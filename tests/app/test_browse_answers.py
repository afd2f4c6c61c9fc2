"""The browser of answers: every pair to look at; an answer left out with a reason, and taken in again."""

import csv
import io
from collections.abc import Callable
from datetime import timedelta
from uuid import uuid4

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import event, insert, select

from app.db import Database, now
from app.domain.people import AuditEvent, Role
from app.domain.preferences import Exclusion, LabelEvent, Purpose, Query, Response, current_answers, current_labels
from app.domain.studies import Participant, Study
from app.services.answers import answers
from app.services.answers.answers import Mark, Wanted
from app.services.monitoring import dashboard
from app.storage import ArtefactStore
from tests import factories

PAIRS = 6


@pytest.fixture
def study(database: Database, store: ArtefactStore) -> Study:
    """Two people: P01 answers six pairs, the third of which is foreseen wrongly; P02 answers one."""
    with database.writing() as session:
        study = factories.make_study(session, "Pilot")
        first, _ = factories.make_participant(session, study)
        second, _ = factories.make_participant(session, study)
        queries = factories.make_queries(session, store, first, PAIRS)
        for place, query in enumerate(queries):
            query.predicted_right = {2: 0.9, 3: 0.2}.get(place)
            factories.make_label(session, query, Response.LEFT, timedelta(minutes=9 - place), response_time_ms=3000)
        (other,) = factories.make_queries(session, store, second, 1)
        factories.make_label(session, other, Response.EQUAL, by_script=False)
    return study


@pytest.fixture
def queries(database: Database, study: Study) -> list[Query]:
    with database.reading() as session:
        return list(session.scalars(select(Query).where(Query.participant_id == 1).order_by(Query.ordinal)))


def found(database: Database, study: Study, **wanted: object) -> list[tuple[str, int]]:
    with database.reading() as session:
        page = answers.find(session, study, Wanted(**wanted))  # type: ignore[arg-type]
    return [(each.participant.code, each.query.ordinal) for each in page.answers]


def exclude(experimenter: TestClient, query: Query, reason: str = "was on the phone") -> int:
    return experimenter.post(f"/studies/pilot/answers/{query.id}/exclude", data={"reason": reason}).status_code


class TestLooking:
    """What the list and the page of an answer show."""

    def test_every_answer_is_listed_by_person_and_order(self, database: Database, study: Study) -> None:
        assert found(database, study) == [*(("P01", place) for place in range(1, PAIRS + 1)), ("P02", 1)]

    def test_an_answer_taken_back_is_not_there_and_one_given_anew_is(
        self, database: Database, study: Study, queries: list[Query]
    ) -> None:
        with database.writing() as session:
            session.add(LabelEvent(query_id=queries[0].id, revision=2, response=None, client_uuid=str(uuid4())))
        assert ("P01", 1) not in found(database, study)
        with database.writing() as session:
            factories.make_label(session, session.get_one(Query, queries[0].id), Response.RIGHT)
        assert ("P01", 1) in found(database, study, response=Response.RIGHT)

    @pytest.mark.parametrize(
        ("wanted", "expected"),
        [
            ({"code": "P02"}, [("P02", 1)]),
            ({"response": Response.EQUAL}, [("P02", 1)]),
            ({"mark": Mark.MISPREDICTED}, [("P01", 3)]),
            ({"mark": Mark.QUICK}, []),
            ({"mark": Mark.WITHOUT_SCRIPT}, [("P02", 1)]),
            ({"purpose": Purpose.CATCH}, []),
        ],
    )
    def test_answers_are_narrowed(
        self, database: Database, study: Study, wanted: dict[str, object], expected: list[tuple[str, int]]
    ) -> None:
        assert found(database, study, **wanted) == expected

    def test_quick_means_before_half_of_both_clips_was_played(
        self, database: Database, study: Study, queries: list[Query]
    ) -> None:
        with database.writing() as session:
            events = {each.query_id: each for each in session.scalars(select(LabelEvent))}
            played = {0: (999, 2000), 1: (1000, 2000), 2: (0, 0), 3: (0, 0)}  # of 2 s
            for place, (left_ms, right_ms) in played.items():
                event = events[queries[place].id]
                event.left_watched_ms, event.right_watched_ms, event.response_time_ms = left_ms, right_ms, 100
            events[queries[2].id].watched_whole = True
            events[queries[3].id].scrub_count = 1
        assert found(database, study, mark=Mark.QUICK) == [("P01", 1)]

    def test_of_answers_before_playing_was_recorded_the_highest_speed_is_allowed_for(
        self, database: Database, study: Study, queries: list[Query]
    ) -> None:
        with database.writing() as session:
            events = {each.query_id: each for each in session.scalars(select(LabelEvent))}
            for event in events.values():
                event.left_watched_ms = event.right_watched_ms = event.response_time_ms = None
            events[queries[0].id].response_time_ms = 499  # half of 2 s at twice the speed
            events[queries[1].id].response_time_ms = 500
        assert found(database, study, mark=Mark.QUICK) == [("P01", 1)]

    @pytest.mark.parametrize(
        ("sides_swapped", "again", "contradicts"),
        [
            (False, Response.LEFT, False),
            (False, Response.RIGHT, True),
            (True, Response.RIGHT, False),
            (True, Response.LEFT, True),
            (True, Response.EQUAL, True),
            (True, Response.SKIP, False),
        ],
    )
    def test_a_repeat_contradicts_when_another_clip_is_preferred_whatever_the_side(
        self,
        database: Database,
        study: Study,
        queries: list[Query],
        sides_swapped: bool,
        again: Response,
        contradicts: bool,
    ) -> None:
        with database.writing() as session:
            first, person = queries[0], session.get_one(Participant, 1)
            sides = (first.left_clip_id, first.right_clip_id)
            left, right = reversed(sides) if sides_swapped else sides
            repeat = Query(
                participant_id=person.id,
                ordinal=PAIRS + 1,
                left_clip_id=left,
                right_clip_id=right,
                purpose=Purpose.REPEAT,
                repeats_query_id=first.id,
                strategy="uniform",
                propensity=1.0,
            )
            session.add(repeat)
            session.flush()
            factories.make_label(session, repeat, again)
        assert (("P01", PAIRS + 1) in found(database, study, mark=Mark.CONTRADICTS)) is contradicts

    def test_the_worse_side_of_a_catch_pair_is_found(
        self, database: Database, study: Study, queries: list[Query]
    ) -> None:
        with database.writing() as session:
            for query, expected in ((queries[0], Response.RIGHT), (queries[1], Response.LEFT)):
                stored = session.get_one(Query, query.id)
                stored.purpose, stored.expected = Purpose.CATCH, expected
        assert found(database, study, mark=Mark.MISSED_CATCH) == [("P01", 1)]

    def test_the_page_of_an_answer_plays_both_clips_and_leads_to_its_neighbours(
        self, experimenter: TestClient, study: Study, queries: list[Query]
    ) -> None:
        text = experimenter.get(f"/studies/pilot/answers/{queries[2].id}?participant=P01").text
        assert text.count("<video") == 2
        assert "predicted wrongly" in text
        assert f"/answers/{queries[1].id}?participant=P01" in text
        assert f"/answers/{queries[3].id}?participant=P01" in text

    def test_answers_of_another_study_and_of_previews_are_not_there(
        self, experimenter: TestClient, database: Database, store: ArtefactStore, study: Study, queries: list[Query]
    ) -> None:
        with database.writing() as session:
            factories.make_study(session, "Other")
            session.get_one(Participant, 2).is_preview = True
        assert experimenter.get(f"/studies/other/answers/{queries[0].id}").status_code == 404
        assert ("P02", 1) not in found(database, study)

    @pytest.mark.parametrize("address", ["?participant=x", "?mark=nice", "?page=0", "?purpose=x"])
    def test_an_address_that_makes_no_sense_is_refused(
        self, experimenter: TestClient, study: Study, address: str
    ) -> None:
        assert experimenter.get(f"/studies/pilot/answers{address}").status_code == 422

    def test_what_the_form_sends_when_nothing_is_chosen_means_everything(
        self, experimenter: TestClient, study: Study
    ) -> None:
        text = experimenter.get("/studies/pilot/answers?participant=&purpose=&response=&mark=").text
        assert f"<strong>{PAIRS + 1}</strong> answers" in text


class TestExcluding:
    """Left out of learning and statistics, never deleted."""

    def test_an_excluded_answer_is_neither_learned_from_nor_judged_but_was_given(
        self, experimenter: TestClient, database: Database, study: Study, queries: list[Query]
    ) -> None:
        assert exclude(experimenter, queries[2]) == 303
        with database.reading() as session:
            assert queries[2].id not in {label.query.id for label in current_labels(session, 1)}
            assert len(current_answers(session, 1)) == PAIRS - 1
            row = dashboard.participant_detail(session, study, session.get_one(Participant, 1)).row
        assert row.answered == PAIRS
        assert row.watched.consistency.answered == PAIRS - 1
        assert row.curve.overall is not None
        assert (row.curve.overall.correct, row.curve.overall.scored) == (1, 1)

    def test_taking_it_in_again_restores_everything_and_both_are_in_the_audit_log(
        self, experimenter: TestClient, database: Database, study: Study, queries: list[Query]
    ) -> None:
        exclude(experimenter, queries[2])
        assert experimenter.post(f"/studies/pilot/answers/{queries[2].id}/include").status_code == 303
        with database.reading() as session:
            assert len(current_labels(session, 1)) == PAIRS
            acts = session.execute(select(AuditEvent.action, AuditEvent.subject).order_by(AuditEvent.id)).all()
        subject = "pilot/P01/3"
        assert [tuple(act) for act in acts[-2:]] == [("answer excluded", subject), ("answer taken in again", subject)]

    def test_doing_it_twice_is_doing_it_once(
        self, experimenter: TestClient, database: Database, queries: list[Query]
    ) -> None:
        exclude(experimenter, queries[0], "first")
        exclude(experimenter, queries[0], "second")
        with database.reading() as session:
            assert [word.reason for word in session.scalars(select(Exclusion))] == ["first"]

    def test_without_a_reason_nothing_is_excluded(
        self, experimenter: TestClient, database: Database, queries: list[Query]
    ) -> None:
        assert exclude(experimenter, queries[0], "   ") == 422
        with database.reading() as session:
            assert session.scalars(select(Exclusion)).all() == []

    def test_readers_cannot_exclude(self, experimenter: TestClient, database: Database, queries: list[Query]) -> None:
        with database.writing() as session:
            factories.give_role(session, Role.READER)
        assert exclude(experimenter, queries[0]) == 403

    def test_a_new_answer_to_the_same_pair_counts(
        self, experimenter: TestClient, database: Database, queries: list[Query]
    ) -> None:
        exclude(experimenter, queries[-1])
        with database.writing() as session:
            query = session.get_one(Query, queries[-1].id)
            session.add(LabelEvent(query_id=query.id, revision=2, response=None, client_uuid=str(uuid4())))
            session.flush()
            factories.make_label(session, query, Response.RIGHT)
            assert len(current_labels(session, 1)) == PAIRS

    def test_exports_keep_the_answer_with_the_reason_beside_it(
        self, experimenter: TestClient, queries: list[Query]
    ) -> None:
        exclude(experimenter, queries[2], "=looked away")

        def table(name: str) -> list[dict[str, str]]:
            return list(csv.DictReader(io.StringIO(experimenter.get(f"/studies/pilot/export/{name}.csv").text)))

        rows = {row["ordinal"]: row for row in table("queries") if row["participant"] == "P01"}
        assert (rows["3"]["response"], rows["3"]["excluded"], rows["3"]["is_label"]) == ("left", "true", "false")
        assert rows["3"]["exclusion_reason"].lstrip("'") == "=looked away"
        assert (rows["2"]["excluded"], rows["2"]["is_label"], rows["2"]["exclusion_reason"]) == ("false", "true", "")
        assert [row["ordinal"] for row in table("labels") if row["excluded"] == "true"] == ["3"]

    def test_the_participant_goes_on_as_if_nothing_had_happened(
        self, experimenter: TestClient, database: Database, store: ArtefactStore, new_browser: Callable[[], TestClient]
    ) -> None:
        with database.writing() as session:
            study = factories.make_study(session, "Going on")
            person, token = factories.make_participant(session, study)
            given, _ = factories.make_queries(session, store, person, 2)
            factories.make_label(session, given)
        browser = new_browser()
        browser.get(f"/p/{token}")
        before = browser.get("/p/next", headers={"Accept": "application/json"}).json()
        experimenter.post(f"/studies/going-on/answers/{given.id}/exclude", data={"reason": "phone"})
        assert browser.get("/p/next", headers={"Accept": "application/json"}).json() == before


def test_pages_of_a_hundred_people_with_two_hundred_answers_each_are_cut_by_the_database(
    database: Database, store: ArtefactStore
) -> None:
    with database.writing() as session:
        study = factories.make_study(session, "Large")
        clips = [factories.make_clip(session, store, study) for _ in range(4)]
        people = [factories.make_participant(session, study)[0] for _ in range(100)]
        rows = [
            {"participant_id": person.id, "ordinal": ordinal, "left_clip_id": clips[0].id, "right_clip_id": clips[1].id,
             "strategy": "uniform", "propensity": 1.0, "purpose": "preference", "created_at": now()}
            for person in people
            for ordinal in range(1, 201)
        ]  # fmt: skip
        session.execute(insert(Query), rows)
        ids = session.scalars(select(Query.id)).all()
        events = [
            {"query_id": each, "revision": 1, "response": "left", "client_uuid": str(uuid4()), "created_at": now()}
            for each in ids
        ]
        session.execute(insert(LabelEvent), events)
    asked: list[str] = []
    event.listen(database.reader, "before_cursor_execute", lambda *arguments: asked.append(arguments[2]))
    with database.reading() as session:
        page = answers.find(session, study, Wanted(page=700))
    assert (page.count, page.pages, len(page.answers)) == (20_000, 800, answers.PAGE_SIZE)
    questions = [each for each in asked if each.startswith("SELECT")]
    assert len(questions) == 4, "however many there are: how many, which, their pairs, their exclusions"
