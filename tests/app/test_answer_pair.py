"""Answering a pair: each answer is stored exactly once, whatever happens on the way."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from threading import Barrier
from uuid import uuid4

import httpx2
import pytest
from fastapi.testclient import TestClient

from app.db import Database, now
from app.domain.preferences import LabelEvent
from app.storage import ArtefactStore
from tests import factories
from tests.app.conftest import JSON, TakingPart
from tests.waiting import PATIENCE_S


def test_the_answer_is_stored_with_how_it_was_watched(taking_part: TakingPart) -> None:
    taking_part.turn()
    query = taking_part.queries[0]
    answer = taking_part.answer(query, "equal", response_time_ms=4321, replay_count=2, play_error_count=1)
    assert answer.status_code == 200
    (event,) = taking_part.events(query)
    assert (event.response, event.revision) == ("equal", 1)
    assert (event.response_time_ms, event.replay_count, event.play_error_count) == (4321, 2, 1)


def test_what_was_not_measured_is_unknown_and_not_zero(taking_part: TakingPart) -> None:
    taking_part.turn()
    taking_part.answer(taking_part.queries[0], response_time_ms="", replay_count="", play_error_count="")
    (event,) = taking_part.events(taking_part.queries[0])
    assert (event.response_time_ms, event.replay_count, event.play_error_count) == (None, None, None)


def test_nought_replays_are_nought(taking_part: TakingPart) -> None:
    taking_part.turn()
    taking_part.answer(taking_part.queries[0], replay_count=0)
    assert taking_part.events(taking_part.queries[0])[0].replay_count == 0


def test_the_answer_to_an_answer_is_the_next_pair_and_the_two_after(taking_part: TakingPart) -> None:
    shown = taking_part.turn().json()
    turn = taking_part.answer(taking_part.queries[0]).json()
    assert turn["pair"] == shown["following"][0]
    assert turn["following"][0] == shown["following"][1]
    assert len(turn["following"]) == 2
    assert turn["following"][0]["query_id"] == taking_part.queries[2].id
    assert (turn["answered"], turn["wanted"]) == (1, 10)


def test_without_script_the_form_leads_to_the_next_pair(taking_part: TakingPart) -> None:
    page = taking_part.browser.get("/p/next").text
    assert f'action="/p/queries/{taking_part.queries[0].id}/label"' in page
    form = {"response": "right", "client_uuid": str(uuid4())}
    answer = taking_part.browser.post(f"/p/queries/{taking_part.queries[0].id}/label", data=form)
    assert (answer.status_code, answer.headers["location"]) == (303, "/p/next")
    assert f'action="/p/queries/{taking_part.queries[1].id}/label"' in taking_part.browser.get("/p/next").text


def test_a_double_press_counts_once_and_both_lead_on(taking_part: TakingPart) -> None:
    taking_part.turn()
    first = taking_part.answer(taking_part.queries[0], "left")
    second = taking_part.answer(taking_part.queries[0], "right")
    assert first.json() == second.json()
    assert [event.response for event in taking_part.events(taking_part.queries[0])] == ["left"]


def test_a_retry_after_a_lost_response_counts_once(taking_part: TakingPart) -> None:
    taking_part.turn()
    uuid = uuid4()
    first = taking_part.answer(taking_part.queries[0], "left", uuid)
    again = taking_part.answer(taking_part.queries[0], "left", uuid)
    assert (again.status_code, again.json()) == (200, first.json())
    assert len(taking_part.events(taking_part.queries[0])) == 1


def test_a_late_retry_does_not_answer_a_pair_that_was_undone_meanwhile(taking_part: TakingPart) -> None:
    taking_part.turn()
    uuid = uuid4()
    taking_part.answer(taking_part.queries[0], "left", uuid)
    taking_part.undo(taking_part.queries[0])
    assert taking_part.answer(taking_part.queries[0], "left", uuid).status_code == 200
    assert [event.response for event in taking_part.events(taking_part.queries[0])] == ["left", None]


def test_an_answer_meant_for_one_pair_is_not_taken_for_another(taking_part: TakingPart) -> None:
    taking_part.turn()
    uuid = uuid4()
    taking_part.answer(taking_part.queries[0], "left", uuid)
    assert taking_part.answer(taking_part.queries[1], "left", uuid).status_code == 409
    assert taking_part.events(taking_part.queries[1]) == []


def test_what_came_without_a_script_is_marked_as_unmeasured(taking_part: TakingPart) -> None:
    first, second, *_ = taking_part.queries
    taking_part.turn()
    form = {"response": "left", "client_uuid": str(uuid4())}
    taking_part.browser.post(f"/p/queries/{first.id}/label", data=form)
    taking_part.turn()
    taking_part.answer(second, "right", response_time_ms=2000)
    assert [taking_part.events(query)[0].by_script for query in (first, second)] == [False, True]


def test_the_back_button_and_a_reload_change_nothing(taking_part: TakingPart) -> None:
    old_page = taking_part.browser.get("/p/next")
    taking_part.answer(taking_part.queries[0], "left")
    form = {"response": "right", "client_uuid": str(uuid4())}  # from the old page, restored by the back button
    answer = taking_part.browser.post(f"/p/queries/{taking_part.queries[0].id}/label", data=form)
    assert answer.headers["location"] == "/p/next"
    assert [event.response for event in taking_part.events(taking_part.queries[0])] == ["left"]
    assert old_page.headers["cache-control"] == "no-store"


def test_another_participants_pair_does_not_exist(
    taking_part: TakingPart, database: Database, new_browser: Callable[[], TestClient]
) -> None:
    taking_part.turn()
    with database.writing() as session:
        _, token = factories.make_participant(session, taking_part.study)
    other = new_browser()
    other.get(f"/p/{token}")
    form = {"response": "left", "client_uuid": str(uuid4())}
    answers = [other.post(f"/p/queries/{number}/label", data=form) for number in (taking_part.queries[0].id, 987654)]
    assert [answer.status_code for answer in answers] == [404, 404]
    assert answers[0].text == answers[1].text
    assert taking_part.events(taking_part.queries[0]) == []


def test_a_pair_that_was_not_shown_cannot_be_answered(taking_part: TakingPart) -> None:
    taking_part.turn()
    assert taking_part.answer(taking_part.queries[5]).status_code == 409
    assert taking_part.events(taking_part.queries[5]) == []


@pytest.mark.parametrize(
    "fields",
    [
        {"response": "banana"},
        {"response": ""},
        {"client_uuid": "not-a-uuid"},
        {"client_uuid": ""},
        {"response_time_ms": "-5"},
        {"response_time_ms": "soon"},
        {"response_time_ms": "99999999999999999999999"},
        {"replay_count": "1e9"},
        {"play_error_count": "\x00"},
        {"response": "left\x00"},
    ],
)
def test_a_garbled_answer_is_refused_with_words(taking_part: TakingPart, fields: dict[str, str]) -> None:
    taking_part.turn()
    good = {"response": "left", "client_uuid": str(uuid4()), "response_time_ms": "1000"}
    path = f"/p/queries/{taking_part.queries[0].id}/label"
    for_script = taking_part.browser.post(path, data=good | fields, headers=JSON)
    assert for_script.status_code == 422
    assert for_script.headers["content-type"] == "application/problem+json"
    for_people = taking_part.browser.post(path, data=good | fields)
    assert for_people.status_code == 422
    assert "<h1>" in for_people.text
    assert taking_part.events(taking_part.queries[0]) == []


def test_of_twenty_racing_answers_exactly_one_is_kept(database: Database, store: ArtefactStore, address: str) -> None:
    with database.writing() as session:
        study = factories.make_study(session)
        participant, token = factories.make_participant(session, study)
        query = factories.make_queries(session, store, participant, 3)[0]
    with httpx2.Client(base_url=address, timeout=PATIENCE_S) as browser:
        browser.get(f"/p/{token}")
        browser.get("/p/next")
        cookies = dict(browser.cookies)
    together = Barrier(20)

    def race(number: int) -> int:
        with httpx2.Client(base_url=address, cookies=cookies, timeout=PATIENCE_S) as racer:
            form = {"response": ("left", "right")[number % 2], "client_uuid": str(uuid4())}
            together.wait()
            return racer.post(f"/p/queries/{query.id}/label", data=form, headers=JSON).status_code

    with ThreadPoolExecutor(20) as pool:
        statuses = list(pool.map(race, range(20)))
    assert statuses == [200] * 20
    with database.reading() as session:
        assert session.query(LabelEvent).count() == 1


def test_of_twenty_racing_copies_of_one_answer_exactly_one_is_kept(taking_part: TakingPart) -> None:
    taking_part.turn()
    uuid, together = uuid4(), Barrier(20)

    def race(_number: int) -> int:
        together.wait()
        return taking_part.answer(taking_part.queries[0], "left", uuid).status_code

    with ThreadPoolExecutor(20) as pool:
        assert list(pool.map(race, range(20))) == [200] * 20
    assert len(taking_part.events(taking_part.queries[0])) == 1


def test_sixty_people_who_answer_at_once_all_get_through(
    database: Database, store: ArtefactStore, address: str
) -> None:
    """More than the server has threads: whoever waits for the write lock must not wait inside one of them."""
    people = 60
    with database.writing() as session:
        study = factories.make_study(session)
        clips = [factories.make_clip(session, store, study) for _ in range(2)]
        tokens, queries = [], []
        for _ in range(people):
            participant, token = factories.make_participant(session, study)
            queries.append(factories.make_query(session, participant, clips[0], clips[1]))
            queries[-1].served_at = now()
            tokens.append(token)
    together = Barrier(people)

    def answer(number: int) -> int:
        with httpx2.Client(base_url=address, timeout=PATIENCE_S) as browser:
            browser.get(f"/p/{tokens[number]}")
            form = {"response": "left", "client_uuid": str(uuid4())}
            together.wait()
            return browser.post(f"/p/queries/{queries[number].id}/label", data=form, headers=JSON).status_code

    with ThreadPoolExecutor(people) as pool:
        assert list(pool.map(answer, range(people))) == [200] * people
