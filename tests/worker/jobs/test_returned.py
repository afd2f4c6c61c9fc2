"""Whoever comes back for another visit is learned about from all they have said."""

from collections.abc import Callable

import pytest
from sqlalchemy import select

from app.db import Database
from app.domain.clips import Clip
from app.domain.hints import HintEvent
from app.domain.preferences import LabelEvent, Query, Response
from app.domain.studies import Participant, Study
from app.storage import ArtefactStore
from worker.jobs import reconcile
from worker.jobs.learning import dataset, filters

AddClips = Callable[..., list[Clip]]
Answer = Callable[[Clip, Clip, Response], Query]


@pytest.fixture
def returned(database: Database, study: Study, participant: Participant) -> Participant:
    """The participant at their second visit, in a study that goes on from the first."""
    settings = {**study.stored_settings, "goes_on_from": study.slug}
    with database.writing() as session:
        second = Study(slug="second", name="Second", stored_settings=settings, seed=4)
        session.add(second)
        session.flush()
        again = Participant(study_id=second.id, number=1, token_sha256="1" * 64, seed=6)
        again.earlier_id, again.visit = participant.id, 2
        session.add(again)
    return again


def say(database: Database, person: Participant, left: Clip, right: Clip) -> None:
    """Their first answer at the second visit: left."""
    with database.writing() as session:
        sides = {"left_clip_id": left.id, "right_clip_id": right.id}
        query = Query(participant_id=person.id, ordinal=1, strategy="uniform", propensity=0.1, **sides)
        session.add(query)
        session.flush()
        session.add(LabelEvent(query_id=query.id, revision=1, response=Response.LEFT, client_uuid="second visit"))


def test_answers_of_the_visit_before_come_first_and_are_not_counted(
    database: Database, store: ArtefactStore, returned: Participant, add_clips: AddClips, answer: Answer
) -> None:
    first, second, third, _ = add_clips(7)
    answer(first, second, Response.RIGHT)
    answer(first, third, Response.EQUAL)
    say(database, returned, second, third)
    with database.reading() as session:
        preferences = dataset.load_preferences(session, store, returned.id)
    assert preferences.targets.tolist() == [1.0, 0.5, 0.0]
    assert preferences.label_count == 1


def test_hints_hold_until_new_ones_are_given(
    database: Database, store: ArtefactStore, participant: Participant, returned: Participant
) -> None:
    def give(person: Participant, hints: str) -> None:
        given = {"revision": 1, "offered": "", "answered": 0, "client_uuid": hints}
        with database.writing() as session:
            session.add(HintEvent(participant_id=person.id, hints=hints, **given))

    def learned() -> int:
        with database.reading() as session:
            return len(dataset.load_preferences(session, store, returned.id).hints)

    give(participant, "slower_near slower")
    assert learned() == 2
    give(returned, "slower_near")
    assert learned() == 1


def test_a_reward_model_is_due_before_the_first_new_answer(
    database: Database, returned: Participant, add_clips: AddClips, answer: Answer
) -> None:
    first, second, *_ = add_clips(7)
    answer(first, second, Response.RIGHT)

    def due() -> set[str]:
        with database.reading() as session:
            keys = {job.key for job, _ in reconcile.due(session)}
        return {key for key in keys if f"/participant-{returned.id}/" in key}

    assert due() == set(), "there may be no clips yet"
    with database.writing() as session:
        sides = {"left_clip_id": first.id, "right_clip_id": second.id}
        session.add(Query(participant_id=returned.id, ordinal=1, strategy="uniform", propensity=0.1, **sides))
    assert due() == {f"reward/participant-{returned.id}/labels-0"}


def test_the_model_card_counts_the_answers_of_earlier_visits(
    database: Database, participant: Participant, returned: Participant, add_clips: AddClips, answer: Answer
) -> None:
    first, second, *_ = add_clips(7)
    answer(first, second, Response.RIGHT)
    with database.reading() as session:
        people = [
            session.scalars(select(Participant).where(Participant.id == each.id)).one()
            for each in (participant, returned)
        ]
        notes = [list(filters.notes_on_visits(session, each)) for each in people]
    assert notes == [[], ["This is visit 2: 1 answers of the visits before were learned from as well."]]
