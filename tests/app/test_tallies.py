"""What was counted earlier is never shown once it no longer holds."""

from collections.abc import Callable, Sequence

import pytest
from sqlalchemy import event
from sqlalchemy.orm import Session

from app.db import Database
from app.domain.models import ModelKind
from app.domain.preferences import Query, Response
from app.domain.studies import Participant, Study
from app.services.monitoring import dashboard
from app.services.monitoring.tallies import AT_ONCE, Tallies
from app.services.participants import withdrawal
from app.storage import ArtefactStore
from tests import factories

Act = Callable[[Session, ArtefactStore, Participant, Sequence[Query]], object]


def undo(session: Session, _store: ArtefactStore, _person: Participant, queries: Sequence[Query]) -> None:
    """The first answer is taken back."""
    factories.make_label(session, queries[0]).response = None


CHANGES: dict[str, Act] = {
    "an answer": lambda session, _store, _person, queries: factories.make_label(session, queries[5]),
    "another answer": lambda session, _store, _person, queries: factories.make_label(
        session, queries[0], Response.EQUAL
    ),
    "an answer taken back": undo,
    "a reward model": lambda session, _store, person, _queries: factories.make_model(
        session, person.study, person, ModelKind.REWARD, {"advice": {"relative_regret": 0.05}}
    ),
    "a filter": lambda session, _store, person, _queries: factories.make_model(
        session, person.study, person, ModelKind.FILTER, factories.filter_metrics()
    ),
    "a bundle": lambda session, store, person, _queries: factories.make_bundle(
        session,
        store,
        factories.make_model(session, person.study, person, ModelKind.FILTER, factories.filter_metrics(), 20),
    ),
    "withdrawal": lambda session, store, person, _queries: withdrawal.withdraw(session, store, person, "P01"),
}


@pytest.fixture
def study(database: Database) -> Study:
    with database.writing() as session:
        return factories.make_study(session, "Pilot")


def rows(session: Session, study: Study, tallies: Tallies) -> Sequence[dashboard.ParticipantRow]:
    """Everybody in the study."""
    return dashboard.study_overview(session, study, tallies).rows


@pytest.mark.parametrize("change", CHANGES)
def test_whatever_changes_is_counted_again(change: str, database: Database, store: ArtefactStore, study: Study) -> None:
    tallies = Tallies()
    with database.writing() as session:
        person, _ = factories.make_participant(session, study)
        other, _ = factories.make_participant(session, study)
        person.study = study
        for each in (person, other):
            queries = factories.make_queries(session, store, each, 6)
            for query in queries[:5]:
                factories.make_label(session, query, response_time_ms=3000)
        queries = factories.make_queries(session, store, person, 6)
        for query in queries[:5]:
            factories.make_label(session, query)
        before = rows(session, study, tallies)
        CHANGES[change](session, store, person, queries)
        session.flush()
        after = rows(session, study, tallies)
        assert after == rows(session, study, Tallies()), "as if nothing had been counted before"
        assert after[0] != before[0]
        assert after[1] == before[1]


def test_who_has_not_gone_on_costs_no_reading_of_answers(
    database: Database, store: ArtefactStore, study: Study
) -> None:
    tallies, statements = Tallies(), list[str]()
    with database.writing() as session:
        for _ in range(3):
            person, _ = factories.make_participant(session, study)
            for query in factories.make_queries(session, store, person, 3):
                factories.make_label(session, query)
        rows(session, study, tallies)
    event.listen(database.reader, "before_cursor_execute", lambda *given: statements.append(given[2]))
    with database.reading() as session:
        rows(session, session.get_one(Study, study.id), tallies)
    assert not [each for each in statements if "response_time_ms" in each]


def test_counting_without_hurry_counts_the_same(database: Database, store: ArtefactStore, study: Study) -> None:
    tallies = Tallies()
    with database.writing() as session:
        for _ in range(AT_ONCE + 3):
            person, _ = factories.make_participant(session, study)
            factories.make_label(session, factories.make_queries(session, store, person, 1)[0])
        assert rows(session, study, tallies.unhurried()) == rows(session, study, Tallies())
    statements = list[str]()
    event.listen(database.reader, "before_cursor_execute", lambda *given: statements.append(given[2]))
    with database.reading() as session:
        rows(session, session.get_one(Study, study.id), tallies)
    assert not [each for each in statements if "response_time_ms" in each], "both know what either has counted"
