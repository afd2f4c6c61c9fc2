"""Taking the newest answer back."""

from uuid import uuid4

from sqlalchemy import select

from app.domain.preferences import count_labels
from app.domain.studies import Participant
from tests.app.conftest import TakingPart


def test_the_pair_is_shown_again_and_can_be_answered_anew(taking_part: TakingPart) -> None:
    shown = taking_part.turn().json()
    taking_part.answer(taking_part.queries[0], "left")
    turn = taking_part.undo(taking_part.queries[0]).json()
    assert turn["pair"] == shown["pair"]
    assert turn["answered"] == 0
    assert taking_part.answer(taking_part.queries[0], "right").json()["answered"] == 1
    events = taking_part.events(taking_part.queries[0])
    assert [(event.revision, event.response) for event in events] == [(1, "left"), (2, None), (3, "right")]


def test_undoing_twice_is_undoing_once(taking_part: TakingPart) -> None:
    taking_part.turn()
    taking_part.answer(taking_part.queries[0])
    uuid = uuid4()
    answers = [taking_part.undo(taking_part.queries[0], each) for each in (uuid, uuid, uuid4())]
    assert [answer.status_code for answer in answers] == [200, 200, 200]
    assert len(taking_part.events(taking_part.queries[0])) == 2


def test_one_can_go_back_step_by_step(taking_part: TakingPart) -> None:
    taking_part.turn()
    taking_part.answer(taking_part.queries[0])
    taking_part.answer(taking_part.queries[1])
    turn = taking_part.undo(taking_part.queries[1]).json()
    assert turn["undo_path"] == f"/p/queries/{taking_part.queries[0].id}/undo"
    assert taking_part.undo(taking_part.queries[0]).json()["undo_path"] is None


def test_only_the_newest_answer_can_be_taken_back(taking_part: TakingPart) -> None:
    taking_part.turn()
    taking_part.answer(taking_part.queries[0])
    taking_part.answer(taking_part.queries[1])
    assert taking_part.undo(taking_part.queries[0]).status_code == 409
    assert len(taking_part.events(taking_part.queries[0])) == 1


def test_a_pair_without_answer_has_nothing_to_undo(taking_part: TakingPart) -> None:
    taking_part.turn()
    assert taking_part.undo(taking_part.queries[0]).status_code == 200
    assert taking_part.events(taking_part.queries[0]) == []


def test_the_last_answer_of_the_study_can_be_taken_back_too(taking_part: TakingPart) -> None:
    taking_part.turn()
    for query in taking_part.queries[:10]:
        taking_part.answer(query)
    finished = taking_part.browser.get("/p/finished")
    last = taking_part.queries[9]
    assert f'action="/p/queries/{last.id}/undo"' in finished.text
    answer = taking_part.browser.post(f"/p/queries/{last.id}/undo", data={"client_uuid": str(uuid4())})
    assert answer.headers["location"] == "/p/next"
    assert taking_part.turn().json()["pair"]["query_id"] == last.id


def test_what_was_taken_back_is_not_counted_and_what_was_answered_again_counts_once(taking_part: TakingPart) -> None:
    def counted() -> int:
        with taking_part.database.reading() as session:
            return count_labels(session, select(Participant.id)).get(taking_part.participant.id, 0)

    taking_part.turn()
    taking_part.answer(taking_part.queries[0], "left")
    assert counted() == 1
    taking_part.undo(taking_part.queries[0])
    assert counted() == 0
    taking_part.answer(taking_part.queries[0], "right")
    assert counted() == 1
