"""What a participant is shown next."""

from datetime import timedelta

import pytest

from app.db import Database
from app.domain.clips import Clip
from app.domain.preferences import Query
from app.storage import ArtefactStore
from tests import factories
from tests.app.conftest import TakingPart


def test_pairs_come_in_their_order_and_the_showing_is_stored(taking_part: TakingPart, database: Database) -> None:
    turn = taking_part.turn().json()
    assert turn["pair"]["query_id"] == taking_part.queries[0].id
    with database.reading() as session:
        shown = [session.get_one(Query, query.id).served_at is not None for query in taking_part.queries[:2]]
    assert shown == [True, False]


@pytest.mark.parametrize("kind", ["video_sha256", "poster_sha256"])
def test_a_pair_whose_files_are_missing_is_passed_over(
    taking_part: TakingPart, store: ArtefactStore, database: Database, kind: str, caplog: pytest.LogCaptureFixture
) -> None:
    with database.reading() as session:
        clip = session.get_one(Clip, taking_part.queries[0].left_clip_id)
    store.delete(getattr(clip, kind))
    taking_part.browser.get(f"/media/{getattr(clip, kind)}.mp4")
    assert taking_part.turn().json()["pair"]["query_id"] == taking_part.queries[1].id
    assert "lost its files" in caplog.text


def test_while_no_pair_is_ready_a_page_waits_by_itself(database: Database, taking_part: TakingPart) -> None:
    with database.writing() as session:
        _, token = factories.make_participant(session, taking_part.study)
    taking_part.browser.get(f"/p/{token}")
    page = taking_part.browser.get("/p/next")
    assert page.status_code == 200
    assert "being prepared" in page.text
    assert 'http-equiv="refresh"' in page.text
    assert taking_part.turn().json()["state"] == "waiting"


def test_after_the_last_answer_the_participant_is_thanked(taking_part: TakingPart) -> None:
    taking_part.turn()
    session_queue = [taking_part.answer(query).json() for query in taking_part.queries[:10]]
    assert session_queue[8]["following"] == []
    assert session_queue[9]["state"] == "finished"
    assert taking_part.browser.get("/p/next").headers["location"] == "/p/finished"
    assert "Thank you" in taking_part.browser.get("/p/finished").text
    assert taking_part.answer(taking_part.queries[10]).status_code == 409


def test_thanks_are_not_given_early(taking_part: TakingPart) -> None:
    assert taking_part.browser.get("/p/finished").headers["location"] == "/p/next"


def test_the_time_left_is_hidden_until_the_pace_is_known(taking_part: TakingPart, database: Database) -> None:
    with database.writing() as session:
        for number, query in enumerate(taking_part.queries[:5]):
            factories.make_label(session, query, ago=timedelta(seconds=300 - 30 * number))
    assert taking_part.turn().json()["time_left"] is None
    with database.writing() as session:
        factories.make_label(session, taking_part.queries[5], ago=timedelta(seconds=150))
    assert taking_part.turn().json()["time_left"] == "about 2 min"  # 4 pairs at 30 s


def test_a_break_does_not_slow_the_time_left(taking_part: TakingPart, database: Database) -> None:
    with database.writing() as session:
        for number, query in enumerate(taking_part.queries[:7]):
            hours = 5 if number < 3 else 0
            factories.make_label(session, query, ago=timedelta(hours=hours, seconds=300 - 20 * number))
    assert taking_part.turn().json()["time_left"] == "about a minute"  # 3 pairs at 20 s
