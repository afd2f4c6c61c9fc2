"""Which pairs a participant gets, and that every prediction comes before its label."""

from collections import Counter
from collections.abc import Callable

import pytest
from sqlalchemy import select

from app.db import Database
from app.domain.clips import Clip
from app.domain.models import ModelKind, Run
from app.domain.preferences import Query, Response
from app.domain.studies import Participant
from app.storage import ArtefactStore
from worker import dataset, querying, records
from worker.compute import Compute
from worker.ml import reward_training
from worker.workplace import Workplace

AddClips = Callable[..., list[Clip]]
Answer = Callable[[Clip, Clip, Response], Query]


@pytest.fixture
def place(database: Database, store: ArtefactStore) -> Workplace:
    return Workplace(database, store, Compute(1))


def queries_of(database: Database, participant: Participant) -> list[Query]:
    with database.reading() as session:
        return list(
            session.scalars(select(Query).where(Query.participant_id == participant.id).order_by(Query.ordinal))
        )


def test_no_pair_comes_twice_on_whichever_side(place: Workplace, participant: Participant, add_clips: AddClips) -> None:
    for scenario in (1, 2, 3):
        add_clips(scenario)
    for _ in range(3):
        querying.refill_queries(place, participant.id)
    queries = queries_of(place.database, participant)
    pairs = Counter(frozenset((query.left_clip_id, query.right_clip_id)) for query in queries)
    assert len(queries) == records.QUERIES_AHEAD
    assert set(pairs.values()) == {1}
    assert [query.ordinal for query in queries] == list(range(1, len(queries) + 1))
    assert all(0.0 < query.propensity <= 1.0 for query in queries)


def test_the_same_study_gives_a_participant_the_same_pairs(
    place: Workplace, participant: Participant, add_clips: AddClips
) -> None:
    for scenario in (1, 2, 3):
        add_clips(scenario)
    querying.refill_queries(place, participant.id)
    first = [(query.left_clip_id, query.right_clip_id) for query in queries_of(place.database, participant)]
    with place.database.writing() as session:
        records.drop_unseen_queries(session, participant.id, keep=0)
    querying.refill_queries(place, participant.id)
    assert [(query.left_clip_id, query.right_clip_id) for query in queries_of(place.database, participant)] == first


def test_two_workers_refilling_at_once_make_the_queries_once(
    place: Workplace, participant: Participant, add_clips: AddClips
) -> None:
    clips = add_clips(1)
    row = {
        "ordinal": 1,
        "left_clip_id": clips[0].id,
        "right_clip_id": clips[1].id,
        "strategy": "uniform",
        "propensity": 1.0,
    }
    for _ in range(2):
        with place.database.writing() as session:
            records.save_queries(session, participant.id, 1, [row])
    assert len(queries_of(place.database, participant)) == 1


def test_a_query_that_was_answered_in_the_meantime_keeps_its_older_prediction(
    place: Workplace, participant: Participant, add_clips: AddClips, answer: Answer
) -> None:
    clips = add_clips(1)
    answered = answer(clips[0], clips[1], Response.LEFT)
    with place.database.writing() as session:
        waiting = Query(
            participant_id=participant.id,
            ordinal=2,
            left_clip_id=clips[1].id,
            right_clip_id=clips[2].id,
            strategy="uniform",
            propensity=1.0,
        )
        session.add(waiting)
    model_id = save_reward_model(place, participant)
    with place.database.writing() as session:
        records.save_predictions(session, model_id, {answered.id: 0.9, waiting.id: 0.8})
    by_ordinal = queries_of(place.database, participant)
    assert [query.predicted_right for query in by_ordinal] == [None, 0.8]


def test_waiting_queries_are_predicted_by_the_newest_model(
    place: Workplace, participant: Participant, add_clips: AddClips, answer: Answer
) -> None:
    clips = add_clips(1)
    for left, right in ((0, 1), (1, 2), (2, 3)):
        answer(clips[left], clips[right], Response.RIGHT)
    model_id = save_reward_model(place, participant)
    querying.refill_queries(place, participant.id)
    waiting = queries_of(place.database, participant)[3:]
    assert waiting
    assert {query.predicted_by_model_id for query in waiting} == {model_id}
    assert all(query.predicted_right is not None and 0.0 < query.predicted_right < 1.0 for query in waiting)


def save_reward_model(place: Workplace, participant: Participant) -> int:
    """A reward model fitted to whatever the participant has said."""
    with place.database.reading() as session:
        preferences = dataset.load_preferences(session, place.store, participant.id)
    assert preferences.pairs is not None
    fitted = reward_training.fit(preferences.pairs, preferences.targets, "structured", 0)
    with place.database.writing() as session:
        run = Run(workflow_id="reward", kind="reward", study_id=participant.study_id, participant_id=participant.id)
        session.add(run)
        session.flush()
        run.seed = 0
        records.set_labels(session, run.id, preferences.label_count, preferences.label_hash)
        artefact = place.store.put(fitted.model.to_bytes())
        return records.save_model(session, run.id, ModelKind.REWARD, artefact, fitted.metrics).id
