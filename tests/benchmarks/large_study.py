"""A large study for benchmarks: everybody has answered, been trained for, rated robots, and been looked at."""

from collections.abc import Sequence
from datetime import timedelta
from random import Random
from typing import Any
from uuid import UUID

from sqlalchemy import insert
from sqlalchemy.orm import Session

from app.db import now
from app.domain.clips import Clip
from app.domain.evaluation import Rating
from app.domain.models import ModelKind
from app.domain.participation import ConsentRecord, FormAnswer, ParticipantEvent, StageRecord
from app.domain.preferences import LabelEvent, Purpose, Query
from app.domain.protocol import PAPER_METHODS, EvaluationSettings, FormItem, Stage
from app.domain.studies import Deviation, Participant, Study
from app.services import audit
from app.services.evaluation import evaluation_plan
from app.services.participant_events import EventKind
from app.storage import ArtefactStore
from tests import factories

CLIPS = 40
EVENTS_PER_LABEL = 0.2
RETRAIN_EVERY_LABELS = 10


def make_study(session: Session, labels: int, **settings: Any) -> Study:
    """A study with breaks, catch pairs, a video evaluation, and a questionnaire."""
    questions = tuple(
        FormItem(
            name=f"q{number}", kind="likert", question=f"Question {number}", low_label="not at all", high_label="very"
        )
        for number in range(8)
    )
    usual = {
        "labels_per_participant": max(10, labels),
        "pool_scenarios": 500,
        "retrain_every_labels": RETRAIN_EVERY_LABELS,
        "break_every": 50,
        "questionnaire": questions,
        "evaluation": EvaluationSettings(methods=PAPER_METHODS),
    }
    return factories.make_study(session, **{**usual, **settings})


def make_clips(session: Session, store: ArtefactStore, study: Study) -> Sequence[Clip]:
    """The clips of every pair."""
    return [factories.make_clip(session, store, study) for _ in range(CLIPS)]


def fill(session: Session, store: ArtefactStore, study: Study, clips: Sequence[Clip], people: int, labels: int) -> None:
    """Everything about so many people, who are all through with the study."""
    for _ in range(people):
        person, _ = factories.make_participant(session, study)
        random = Random(person.number)  # noqa: S311
        _answer(session, person, clips, labels, random)
        _tell(session, person, study, labels, random)
        _train(session, store, study, person, labels)
        _rate(session, study, person, random)
        audit.record(session, "ada", "participant's page viewed", f"{study.slug}/{person.code}", participant=person)
        audit.record(session, "ada", "answers viewed", f"{study.slug}/{person.code}", participant=person)
    session.add_all(
        Deviation(study_id=study.id, actor="ada", reason=f"reason {number}", before={"a": number}, after={"a": 0})
        for number in range(5)
    )
    session.flush()


def begin(session: Session, study: Study, clips: Sequence[Clip], given: int, labels: int) -> str:
    """Somebody who has given so many answers of all; the token of their link."""
    person, token = factories.make_participant(session, study)
    random = Random(person.number)  # noqa: S311
    _answer(session, person, clips, given, random)
    session.execute(insert(Query), [_query(person, clips, place, random) for place in range(given, labels)])
    return token


def _query(person: Participant, clips: Sequence[Clip], place: int, random: Random) -> dict[str, object]:
    left, right = random.sample(range(len(clips)), 2)
    return {
        "participant_id": person.id,
        "ordinal": 1 + place,
        "left_clip_id": clips[left].id,
        "right_clip_id": clips[right].id,
        "purpose": Purpose.CATCH if place % 25 == 24 else Purpose.PREFERENCE,
        "expected": "left" if place % 25 == 24 else None,
        "strategy": "uniform",
        "propensity": 1.0,
        "predicted_right": random.random() if place > RETRAIN_EVERY_LABELS else None,
        "served_at": None,
    }


def _answer(session: Session, person: Participant, clips: Sequence[Clip], labels: int, random: Random) -> None:
    begun = now() - timedelta(hours=3)
    queries = [_query(person, clips, place, random) for place in range(labels)]
    if not queries:
        return
    for place, query in enumerate(queries):
        query["served_at"] = begun + timedelta(seconds=8 * place)
    ids = session.scalars(insert(Query).returning(Query.id, sort_by_parameter_order=True), queries).all()
    said = [
        {
            "query_id": query,
            "revision": 1,
            "response": random.choice(("left", "right", "right", "equal", "skip")),
            "client_uuid": str(UUID(int=random.getrandbits(128))),
            "response_time_ms": random.randrange(1500, 9000),
            "replay_count": random.randrange(3),
            "watched_whole": True,
            "left_watched_ms": 4000,
            "right_watched_ms": 4000,
            "playback_rate": 1.0,
            "by_script": True,
            "created_at": begun + timedelta(seconds=8 * place + 6),
        }
        for place, query in enumerate(ids)
    ]
    session.execute(insert(LabelEvent), said)


def _tell(session: Session, person: Participant, study: Study, labels: int, random: Random) -> None:
    person.completed_at = person.last_seen_at = now()
    session.add(ConsentRecord(participant_id=person.id, version="1", language="en", text="I agree. " * 200))
    done = (Stage.CONSENT, Stage.INSTRUCTIONS, Stage.PAIRS, Stage.EVALUATION, Stage.QUESTIONNAIRE, Stage.DEBRIEF)
    session.add_all(
        StageRecord(
            participant_id=person.id,
            stage=stage,
            entered_at=now() - timedelta(minutes=60 - 8 * place),
            finished_at=now() - timedelta(minutes=53 - 8 * place),
        )
        for place, stage in enumerate(done)
    )
    session.add_all(
        FormAnswer(participant_id=person.id, form="questionnaire", item=item.name, value=str(random.randrange(1, 8)))
        for item in study.settings.questionnaire
    )
    events = [
        {"participant_id": person.id, "kind": EventKind.STALLED, "detail": {"query_id": 1, "duration_ms": 700}}
        for _ in range(int(EVENTS_PER_LABEL * labels))
    ]
    for answered in range(50, labels, 50):
        for kind in (EventKind.BREAK_BEGUN, EventKind.BREAK_OVER):
            events.append({"participant_id": person.id, "kind": kind, "detail": {"answered": answered}})
    if events:
        session.execute(insert(ParticipantEvent), events)


def _train(session: Session, store: ArtefactStore, study: Study, person: Participant, labels: int) -> None:
    for known in range(RETRAIN_EVERY_LABELS, labels + 1, RETRAIN_EVERY_LABELS):
        factories.make_model(session, study, person, ModelKind.REWARD, factories.reward_metrics(), known)
    model = factories.make_model(session, study, person, ModelKind.FILTER, factories.filter_metrics(), labels)
    factories.make_bundle(session, store, model)


def _rate(session: Session, study: Study, person: Participant, random: Random) -> None:
    evaluation_plan.draw(session, study, person)
    trials = evaluation_plan.trials_of(session, person.id)
    for trial in trials:
        trial.shown_at = now()
    for trial in trials:
        session.add(_rating(trial.id, random))


def _rating(trial_id: int, random: Random) -> Rating:
    return Rating(
        trial_id=trial_id,
        revision=1,
        satisfaction=random.randrange(1, 6),
        personalisation=random.randrange(1, 6),
        client_uuid=str(UUID(int=random.getrandbits(128))),
        response_time_ms=4000,
    )
