"""What keeps the studio quick with many people, whatever the machine: how much is asked of the database, and sent."""

import asyncio
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from datetime import timedelta

import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient
from sqlalchemy import Engine, event, select
from sqlalchemy.exc import OperationalError
from sqlalchemy.orm import ORMExecuteState, Session
from starlette.routing import NoMatchFound

from app.db import Database
from app.domain.models import ModelKind
from app.domain.participation import ParticipantEvent
from app.domain.studies import Participant, Study
from app.errors import AppError
from app.services.answers import next_query
from app.services.monitoring import participant_status
from app.services.monitoring.participant_status import GivenAnswer
from app.services.monitoring.tallies import Tallies
from app.storage import ArtefactStore
from app.web.experimenter.dashboard.participants_table import PAGE_SIZE
from app.web.http.asides import count_ahead
from app.web.http.session_queue import SessionQueue
from tests import factories
from tests.app.conftest import TakingPart
from tests.finished_study import make_finished_study

MOST_STATEMENTS_PER_ANSWER = 10
"""Of one saved answer and the next pair: who asks, what was asked, the answer, what is next, how long it will take."""


@contextmanager
def statements(*engines: Engine) -> Iterator[list[tuple[str, object]]]:
    """What these are asked meanwhile, each with its parameters."""
    asked: list[tuple[str, object]] = []

    def note(_connection: object, _cursor: object, text: str, parameters: object, *_: object) -> None:
        asked.append((text, parameters))

    for engine in engines:
        event.listen(engine, "before_cursor_execute", note)
    yield asked
    for engine in engines:
        event.remove(engine, "before_cursor_execute", note)


def saved(person: TakingPart, place: int) -> list[tuple[str, object]]:
    """What was asked of the database to save this answer and to give the next pair."""
    with statements(person.database.writer) as asked:
        person.answer(person.queries[place]).raise_for_status()
    return asked


def test_an_answer_takes_few_statements_however_much_was_answered_before(
    taking_part: TakingPart, store: ArtefactStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(next_query, "SEEN_EVERY", timedelta(days=1))  # else one statement more in a slow test
    taking_part.turn()
    early = saved(taking_part, 0)
    for query in taking_part.queries[1:8]:
        taking_part.answer(query)
    with taking_part.database.writing() as session:
        for _ in range(5):
            other, _ = factories.make_participant(session, taking_part.study)
            factories.answer_everything(session, store, taking_part.study, other)
    late = saved(taking_part, 8)
    assert len(early) <= len(late) <= MOST_STATEMENTS_PER_ANSWER
    assert len(late) - len(early) <= 2, "those for the time that is left, once the pace is known"


def test_what_is_next_is_asked_in_one_statement_however_many_pairs_wait(taking_part: TakingPart) -> None:
    taking_part.turn()
    portions: list[object] = []

    def note(context: ORMExecuteState) -> None:
        portions.append(context.execution_options.get("yield_per"))  # a cursor on PostgreSQL: four ways there and back

    event.listen(Session, "do_orm_execute", note)
    taking_part.answer(taking_part.queries[0]).raise_for_status()
    event.remove(Session, "do_orm_execute", note)
    assert portions
    assert set(portions) == {None}


@pytest.mark.sqlite("PostgreSQL plans by statistics, and scans small tables")
def test_an_answer_reads_no_table_from_end_to_end(taking_part: TakingPart) -> None:
    taking_part.turn()
    for place in range(7):
        saved(taking_part, place)
    asked = saved(taking_part, 7)
    with taking_part.database.reader.connect() as connection:
        plans = [
            (text, step.detail)
            for text, parameters in asked
            if text.startswith(("SELECT", "UPDATE", "INSERT"))
            for step in connection.exec_driver_sql(f"EXPLAIN QUERY PLAN {text}", parameters)  # type: ignore[arg-type]
        ]
    assert plans
    assert not [plan for plan in plans if plan[1].startswith("SCAN") and "(subquery" not in plan[1]]


class Refused(AppError):
    """No."""


@contextmanager
def commits(database: Database) -> Iterator[list[object]]:
    """One for each commit meanwhile."""
    counted: list[object] = []
    note = counted.append
    event.listen(database.writer, "commit", note)
    yield counted
    event.remove(database.writer, "commit", note)


def in_turn(database: Database, steps: Sequence[Callable[[Session], object]]) -> Sequence[object]:
    """What came of steps that wait at the same moment, behind one that is being committed."""

    async def wait_together() -> Sequence[object]:
        queue = SessionQueue(database)
        return await asyncio.gather(*(queue.write_own_rows(step) for step in steps), return_exceptions=True)

    return asyncio.run(wait_together())


class TestTogether:
    """Answers that wait at the same moment."""

    @pytest.fixture
    def participant(self, database: Database) -> Participant:
        with database.writing() as session:
            return factories.make_participant(session, factories.make_study(session))[0]

    @staticmethod
    def noting(participant: Participant, number: int, error: Exception | None = None) -> Callable[[Session], int]:
        def note(session: Session) -> int:
            detail = {"count": number}
            session.add(ParticipantEvent(participant_id=participant.id, kind="keys_used", detail=detail))
            session.flush()
            if error is not None:
                raise error
            return number

        return note

    @staticmethod
    def noted(database: Database) -> list[int]:
        with database.reading() as session:
            return sorted(detail["count"] for detail in session.scalars(select(ParticipantEvent.detail)))

    @pytest.mark.sqlite("PostgreSQL has many writers, and lets them share a flush by itself")
    def test_share_commits_and_each_is_told_its_own(self, database: Database, participant: Participant) -> None:
        with commits(database) as counted:
            told = in_turn(database, [self.noting(participant, number) for number in range(20)])
        assert told == list(range(20))
        assert self.noted(database) == list(range(20))
        assert len(counted) < 10

    def test_one_that_is_refused_is_undone_alone(self, database: Database, participant: Participant) -> None:
        steps = [self.noting(participant, number, Refused() if number % 3 == 1 else None) for number in range(9)]
        told = in_turn(database, steps)
        assert [each for each in told if not isinstance(each, Refused)] == [0, 2, 3, 5, 6, 8]
        assert self.noted(database) == [0, 2, 3, 5, 6, 8]

    def test_none_is_told_saved_when_the_commit_fails(self, database: Database, participant: Participant) -> None:
        def fail(_connection: object) -> None:
            raise OperationalError("COMMIT", None, Exception("disk I/O error"))

        event.listen(database.writer, "commit", fail)
        told = in_turn(database, [self.noting(participant, number) for number in range(9)])
        event.remove(database.writer, "commit", fail)
        assert [type(each) for each in told] == [OperationalError] * 9
        assert self.noted(database) == []

    def test_go_on_when_somebody_no_longer_waits(self, database: Database, participant: Participant) -> None:
        async def leave() -> Sequence[object]:
            queue = SessionQueue(database)
            waiting = [
                asyncio.create_task(queue.write_own_rows(self.noting(participant, number))) for number in range(12)
            ]
            await asyncio.sleep(0)
            waiting[3].cancel()
            return await asyncio.gather(*waiting, return_exceptions=True)

        told = asyncio.run(leave())
        assert [each for place, each in enumerate(told) if place != 3] == [0, 1, 2, *range(4, 12)]


PAGES = ("", "/answers", "/results", "/export", "/joining", "/participants/P01", "/participants/P01/erase")


@pytest.mark.parametrize("page", PAGES)
def test_no_page_asks_the_database_once_per_person(
    experimenter: TestClient, database: Database, store: ArtefactStore, page: str
) -> None:
    with database.writing() as session:
        study = make_finished_study(session, store, people=2, labels=4)
        for person in session.scalars(select(Participant)):
            factories.make_bundle(session, store, factories.make_model(session, study, person, *FILTER))
    address = f"/studies/{study.slug}{page}"
    experimenter.get(address).raise_for_status()
    with statements(database.reader, database.writer) as few:
        experimenter.get(address).raise_for_status()
    with database.writing() as session:
        study = session.get_one(Study, study.id)
        clip, other = factories.make_clip(session, store, study), factories.make_clip(session, store, study)
        for _ in range(6):
            person, _ = factories.make_participant(session, study)
            factories.make_label(session, factories.make_query(session, person, clip, other))
            factories.make_bundle(session, store, factories.make_model(session, study, person, *FILTER))
    experimenter.get(address).raise_for_status()
    with statements(database.reader, database.writer) as many:
        experimenter.get(address).raise_for_status()
    assert len(many) == len(few)


FILTER = (ModelKind.FILTER, factories.filter_metrics())


def test_a_page_of_people_is_bounded_and_all_pages_have_everybody(experimenter: TestClient, database: Database) -> None:
    count = 2 * PAGE_SIZE + 10
    with database.writing() as session:
        study = factories.make_study(session, "Pilot")
        for _ in range(count):
            factories.make_participant(session, study)

    def codes(address: str) -> list[str]:
        return re.findall(r'<tr data-row="(P\d+)">', experimenter.get(f"/studies/pilot{address}").text)

    pages = [codes(f"?sort=code&page={number}") for number in (1, 2, 3)]
    assert [len(each) for each in pages] == [PAGE_SIZE, PAGE_SIZE, 10]
    assert (
        [*pages[0], *pages[1], *pages[2]]
        == codes("?sort=code&page=0")
        == [f"P{number:02d}" for number in range(1, count + 1)]
    )
    assert codes("?sort=code&page=99") == pages[-1], "a page that is no longer there is the last one"
    first = experimenter.get("/studies/pilot?sort=code").text
    assert 'rel="next" href="/studies/pilot?sort=code&amp;page=2"' in first


def test_who_goes_on_costs_reading_what_is_new(
    database: Database, store: ArtefactStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    read: list[GivenAnswer] = []
    reading = participant_status.answers_given

    def counted(*arguments: object) -> dict[int, list[GivenAnswer]]:
        given = reading(*arguments)  # type: ignore[arg-type]
        read.extend(each for some in given.values() for each in some)
        return given

    monkeypatch.setattr(participant_status, "answers_given", counted)
    with database.writing() as session:
        study, tallies = factories.make_study(session), Tallies()
        person, _ = factories.make_participant(session, study)
        queries = factories.make_queries(session, store, person, 9)
        for query in queries[:8]:
            factories.make_label(session, query)
        tallies.of(session, [person.id])
        assert len(read) == 8
        factories.make_label(session, queries[8])
        tally = tallies.of(session, [person.id])[person.id]
        assert len(read) == 9
        assert tally.answered == 9


def test_after_a_start_nobody_waits_for_the_first_counting(
    studio_app: FastAPI, experimenter: TestClient, database: Database, store: ArtefactStore
) -> None:
    with database.writing() as session:
        make_finished_study(session, store, people=3, labels=3)
    asyncio.run(count_ahead(studio_app.state.studio))
    with statements(database.reader) as asked:
        experimenter.get("/studies/feeding-finished").raise_for_status()
    assert not [text for text, _ in asked if "response_time_ms" in text]


def test_addresses_are_those_that_the_routes_give(studio_app: FastAPI) -> None:
    for _ in range(2):  # looked up, and remembered
        assert studio_app.url_path_for("label_query", query_id=7) == "/p/queries/7/label"
        assert studio_app.url_path_for("static", path="base/base.css") == "/static/base/base.css"
        assert studio_app.url_path_for("show_answer", slug="a-b", query_id=7) == "/studies/a-b/answers/7"
        for name, values in (("no_such_route", {}), ("label_query", {"other": 1}), ("label_query", {})):
            with pytest.raises(NoMatchFound):
                studio_app.url_path_for(name, **values)
        with pytest.raises(AssertionError):
            studio_app.url_path_for("show_study", slug="a/b")
