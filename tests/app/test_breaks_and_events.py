"""Breaks, practice, and what the page reports besides answers, as the server sees them."""

from collections.abc import Callable, Sequence
from datetime import timedelta
from typing import Any
from uuid import uuid4

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select

from app.db import Database
from app.domain.participation import ParticipantEvent
from app.domain.preferences import Purpose, Query, count_labels, current_answers, current_labels
from app.domain.studies import Participant, Study
from app.services import participant_events
from tests import factories
from tests.app.conftest import JSON, TakingPart


@pytest.fixture
def settle(taking_part: TakingPart, database: Database) -> Callable[..., None]:
    """Change the settings of the study."""

    def change(**settings: object) -> None:
        with database.writing() as session:
            study = session.get_one(Study, taking_part.study.id)
            study.stored_settings = {**study.stored_settings, **settings}

    return change


def events(database: Database) -> Sequence[ParticipantEvent]:
    with database.reading() as session:
        return session.scalars(select(ParticipantEvent).order_by(ParticipantEvent.id)).all()


def test_a_break_stands_between_two_pairs_until_the_person_goes_on(
    taking_part: TakingPart, settle: Callable[..., None], database: Database
) -> None:
    settle(break_every=2)
    taking_part.turn()
    taking_part.answer(taking_part.queries[0])
    assert taking_part.answer(taking_part.queries[1]).json()["state"] == "break"
    page = taking_part.browser.get("/p/next").text
    assert "2 answers done" in page
    assert taking_part.browser.post("/p/break").headers["location"] == "/p/next"
    assert taking_part.turn().json()["pair"]["query_id"] == taking_part.queries[2].id
    assert [(event.kind, event.detail) for event in events(database)] == [
        ("break_begun", {"answered": 2}),
        ("break_over", {"answered": 2}),
    ]


def test_going_on_twice_or_without_a_break_notes_nothing_more(
    taking_part: TakingPart, settle: Callable[..., None], database: Database
) -> None:
    settle(break_every=1)
    taking_part.browser.post("/p/break")
    taking_part.turn()
    taking_part.answer(taking_part.queries[0])
    for _ in range(2):
        taking_part.browser.post("/p/break")
    assert [event.kind for event in events(database)] == ["break_over"]


def test_after_the_last_answer_there_is_no_break(taking_part: TakingPart, settle: Callable[..., None]) -> None:
    settle(break_every=10)
    taking_part.turn()
    session_queue = [taking_part.answer(query).json() for query in taking_part.queries[:10]]
    assert session_queue[-1]["state"] == "finished"


def test_practice_is_stored_but_is_no_label_and_no_progress(
    taking_part: TakingPart, settle: Callable[..., None], database: Database
) -> None:
    settle(practice_pairs=1)
    with database.writing() as session:
        session.get_one(Query, taking_part.queries[0].id).purpose = Purpose.PRACTICE
    shown = taking_part.turn().json()
    assert (shown["practising"], shown["answered"], shown["wanted"]) == (True, 0, 1)
    turn = taking_part.answer(taking_part.queries[0]).json()
    assert (turn["practising"], turn["answered"], turn["wanted"], turn["undo_path"]) == (False, 0, 10, None)
    with database.reading() as session:
        assert current_labels(session, taking_part.participant.id) == []
        assert count_labels(session, select(Participant.id)) == {}
        assert len(current_answers(session, taking_part.participant.id)) == 1


def test_repeats_and_catch_pairs_count_in_the_progress_people_see(
    taking_part: TakingPart, settle: Callable[..., None], database: Database
) -> None:
    settle(repeated_pairs=1, catch_pairs=1)
    with database.writing() as session:
        session.get_one(Query, taking_part.queries[0].id).purpose = Purpose.REPEAT
    assert taking_part.turn().json()["wanted"] == 12
    assert taking_part.answer(taking_part.queries[0]).json()["answered"] == 1
    with database.reading() as session:
        assert current_labels(session, taking_part.participant.id) == []


def test_how_a_pair_was_watched_and_why_it_could_not_be_told_is_stored(taking_part: TakingPart) -> None:
    taking_part.turn()
    measured: dict[str, Any] = {
        "stall_count": 1,
        "stalled_ms": 420,
        "largest_drift_ms": 31,
        "playback_rate": 0.5,
        "scrub_count": 2,
    }
    taking_part.answer(taking_part.queries[0], "skip", reason="both_bad", watched_whole="true", **measured)
    (event,) = taking_part.events(taking_part.queries[0])
    assert {name: getattr(event, name) for name in measured} == measured
    assert (event.reason, event.watched_whole) == ("both_bad", True)


def test_a_reason_belongs_to_cant_tell_alone_and_what_is_unknown_stays_unknown(taking_part: TakingPart) -> None:
    taking_part.turn()
    taking_part.answer(taking_part.queries[0], "left", reason="both_bad", playback_rate="", watched_whole="")
    (event,) = taking_part.events(taking_part.queries[0])
    assert (event.reason, event.playback_rate, event.watched_whole) == (None, None, None)


def test_a_reason_that_does_not_exist_is_refused(taking_part: TakingPart) -> None:
    taking_part.turn()
    assert taking_part.answer(taking_part.queries[0], "skip", reason="bored").status_code == 422
    assert taking_part.events(taking_part.queries[0]) == []


def test_what_the_page_noticed_is_kept(taking_part: TakingPart, database: Database) -> None:
    answer = taking_part.browser.post("/p/events", data={"kind": "page_shown", "query_id": 3, "duration_ms": 1500})
    assert answer.status_code == 204
    (event,) = events(database)
    assert (event.participant_id, event.kind) == (taking_part.participant.id, "page_shown")
    assert event.detail == {"query_id": 3, "duration_ms": 1500}


@pytest.mark.parametrize("kind", ["break_over", "break_begun"])
def test_nobody_reports_their_own_breaks(taking_part: TakingPart, database: Database, kind: str) -> None:
    assert taking_part.browser.post("/p/events", data={"kind": kind}).status_code == 204
    assert events(database) == []


def test_a_browser_gone_wild_fills_no_disk(
    taking_part: TakingPart, database: Database, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(participant_events, "MOST_EVENTS", 3)
    for _ in range(5):
        assert taking_part.browser.post("/p/events", data={"kind": "play_error"}).status_code == 204
    assert len(events(database)) == 3


def test_events_of_nobody_are_refused(client: TestClient, database: Database) -> None:
    assert client.post("/p/events", data={"kind": "play_error"}, headers=JSON).status_code == 401
    assert events(database) == []


def test_pages_in_german_say_the_time_left_in_german(taking_part: TakingPart, database: Database) -> None:
    taking_part.browser.post("/p/language", data={"language": "de"})
    with database.writing() as session:
        for number, query in enumerate(taking_part.queries[:7]):
            factories.make_label(session, query, ago=timedelta(seconds=1000 - 60 * number))
    assert taking_part.turn().json()["time_left"] == "etwa 3 min"
    assert "noch etwa 3 min" in taking_part.browser.get("/p/next").text


def test_an_answer_sent_twice_keeps_what_was_measured_at_first(taking_part: TakingPart) -> None:
    taking_part.turn()
    uuid = uuid4()
    taking_part.answer(taking_part.queries[0], uuid=uuid, scrub_count=2)
    taking_part.answer(taking_part.queries[0], uuid=uuid, scrub_count=9)
    assert [event.scrub_count for event in taking_part.events(taking_part.queries[0])] == [2]
