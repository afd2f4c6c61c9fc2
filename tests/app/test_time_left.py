"""The time that is left: of everything that comes, by medians, and of the comparing alone while the rest is unknown."""

from datetime import timedelta
from typing import Any

import pytest

from app.db import Database, now
from app.domain.participation import ParticipantEvent, StageRecord
from app.domain.preferences import LabelEvent, Query
from app.domain.protocol import Stage
from app.domain.studies import Study
from app.services.participant_events import EventKind
from app.services.participants import time_left
from tests import factories
from tests.app.conftest import TakingPart


def settle(at: TakingPart, **settings: Any) -> None:
    with at.database.writing() as session:
        study = session.get_one(Study, at.study.id)
        study.stored_settings = {**study.stored_settings, **settings}


def answer_at_pace(at: TakingPart, count: int, pace_s: float) -> None:
    with at.database.writing() as session:
        for place, query in enumerate(at.queries[:count]):
            label = factories.make_label(session, session.get_one(Query, query.id))
            session.get_one(LabelEvent, label.id).created_at = now() - timedelta(seconds=pace_s * (count - place))


def went_before(database: Database, at: TakingPart, stage: Stage, *seconds: float) -> None:
    with database.writing() as session:
        for each in seconds:
            other, _ = factories.make_participant(session, session.get_one(Study, at.study.id))
            record = StageRecord(participant_id=other.id, stage=stage, entered_at=now())
            record.finished_at = record.entered_at + timedelta(seconds=each)
            session.add(record)


@pytest.fixture(autouse=True)
def asked_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    """What others took is looked up for every answer here, and not twice a minute."""
    monkeypatch.setattr(time_left, "KNOWN_FOR_S", -1.0)


@pytest.fixture
def comparing(taking_part: TakingPart) -> TakingPart:
    """Six of ten pairs answered, one every 30 s."""
    answer_at_pace(taking_part, 6, 30.0)
    return taking_part


def left(at: TakingPart) -> str:
    said: str = at.turn().json()["time_left"]
    return said


def test_what_comes_after_the_pairs_is_counted_by_the_median_of_those_before(
    comparing: TakingPart, database: Database
) -> None:
    settle(comparing, debrief=True)
    assert left(comparing) == "about 2 min of comparing", "nobody knows yet how long the rest takes"
    went_before(database, comparing, Stage.DEBRIEF, 60.0, 5000.0)
    assert "of comparing" in left(comparing), "two people are no median"
    went_before(database, comparing, Stage.DEBRIEF, 300.0)
    assert left(comparing) == "about 7 min"


def test_breaks_to_come_are_counted_once_their_length_is_known(comparing: TakingPart, database: Database) -> None:
    settle(comparing, break_every=4)
    before = left(comparing)
    with database.writing() as session:
        for kind, ago_s in ((EventKind.BREAK_BEGUN, 200), (EventKind.BREAK_OVER, 110)):
            at = now() - timedelta(seconds=ago_s)
            detail = {"answered": 4}
            session.add(ParticipantEvent(participant_id=comparing.participant.id, kind=kind, at=at, detail=detail))
    assert (before, left(comparing)) == ("about 2 min", "about 4 min"), "one more break of 90 s, after eight answers"


def test_whole_episodes_in_the_beginning_do_not_make_the_rest_look_longer(comparing: TakingPart) -> None:
    settle(comparing, introduction_pairs=7, clip_steps=20)
    assert left(comparing) == "about 2 min", "one at 30 s, three that play 8 s less"
