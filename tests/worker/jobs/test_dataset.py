"""From rows to arrays: polarity, ties, undone answers, fingerprints."""

from collections.abc import Callable

import numpy as np
import pytest
from sqlalchemy import select

from app.db import Database
from app.domain.clips import Clip
from app.domain.hints import HintEvent
from app.domain.preferences import Exclusion, LabelEvent, Query, Response
from app.domain.studies import Participant
from app.storage import ArtefactStore
from tests.worker.conftest import STEPS, make_trajectory
from worker.domain.responses import TARGETS
from worker.domain.trajectory import SIGNALS
from worker.jobs.learning import dataset

AddClips = Callable[..., list[Clip]]
Answer = Callable[[Clip, Clip, Response], Query]


@pytest.mark.parametrize(
    ("response", "target"),
    [(Response.LEFT, 0.0), (Response.RIGHT, 1.0), (Response.EQUAL, 0.5), (Response.SKIP, None)],
)
def test_the_target_is_the_probability_that_right_is_preferred(response: Response, target: float | None) -> None:
    assert TARGETS[response] == target


def test_every_response_has_a_target_rule() -> None:
    assert all(TARGETS[response] in (0.0, 0.5, 1.0, None) for response in Response)


def test_left_and_right_keep_their_places_and_cant_tell_is_left_out(
    database: Database, store: ArtefactStore, participant: Participant, add_clips: AddClips, answer: Answer
) -> None:
    first, second, third, _ = add_clips(7)
    answer(second, first, Response.RIGHT)
    answer(first, third, Response.SKIP)
    answer(third, first, Response.EQUAL)
    with database.reading() as session:
        preferences = dataset.load_preferences(session, store, participant.id)
    assert preferences.pairs is not None
    assert preferences.targets.tolist() == [1.0, 0.5]
    assert preferences.label_count == 3
    np.testing.assert_array_equal(preferences.pairs.signals[0, 0], make_trajectory(7, 1).signals)
    np.testing.assert_array_equal(preferences.pairs.signals[0, 1], make_trajectory(7, 0).signals)
    assert preferences.pairs.actions.shape == (2, 2, STEPS, 7)


def test_what_mattered_names_its_signals_and_is_part_of_the_fingerprint(
    database: Database, store: ArtefactStore, participant: Participant, add_clips: AddClips, answer: Answer
) -> None:
    first, second, third, _ = add_clips(7)
    answer(first, second, Response.EQUAL)
    query = answer(first, third, Response.LEFT)
    with database.reading() as session:
        before = dataset.load_preferences(session, store, participant.id)
    with database.writing() as session:
        session.scalars(select(LabelEvent).where(LabelEvent.query_id == query.id)).one().mattered = "speed"
    with database.reading() as session:
        after = dataset.load_preferences(session, store, participant.id)
    named = [[SIGNALS[column] for column in np.flatnonzero(row)] for row in after.mattered]
    assert named == [[], ["speed_m_s", "speed_squared_m2_s2"]]
    assert not before.mattered.any()
    assert before.label_hash != after.label_hash


def test_the_newest_hints_point_where_they_say_and_are_part_of_the_fingerprint(
    database: Database, store: ArtefactStore, participant: Participant, add_clips: AddClips, answer: Answer
) -> None:
    first, second, *_ = add_clips(7)
    answer(first, second, Response.LEFT)

    def after(revision: int, hints: str) -> dataset.Preferences:
        with database.writing() as session:
            event = {"revision": revision, "hints": hints, "client_uuid": f"hints {revision}"}
            session.add(HintEvent(participant_id=participant.id, offered="", answered=1, **event))
        with database.reading() as session:
            return dataset.load_preferences(session, store, participant.id)

    given, taken_back = after(1, "gone_from_the_task quicker"), after(2, "")
    [direction] = given.hints
    wished = {SIGNALS[column]: direction[column] for column in np.flatnonzero(direction)}
    assert wished == {"distance_m": -1.0, "speed_m_s": 1.0, "speed_squared_m2_s2": 1.0}
    assert taken_back.hints.shape == (0, len(SIGNALS))
    assert given.label_hash != taken_back.label_hash


def test_only_cant_tell_means_nothing_to_learn_from(
    database: Database, store: ArtefactStore, participant: Participant, add_clips: AddClips, answer: Answer
) -> None:
    first, second, *_ = add_clips(7)
    answer(first, second, Response.SKIP)
    with database.reading() as session:
        assert dataset.load_preferences(session, store, participant.id).pairs is None


def test_an_undone_answer_does_not_count(
    database: Database, store: ArtefactStore, participant: Participant, add_clips: AddClips, answer: Answer
) -> None:
    first, second, third, _ = add_clips(7)
    answer(first, second, Response.LEFT)
    undone = answer(first, third, Response.LEFT)
    with database.writing() as session:
        session.add(LabelEvent(query_id=undone.id, revision=2, response=None, client_uuid="undo"))
    with database.reading() as session:
        assert dataset.load_preferences(session, store, participant.id).label_count == 1
    with database.writing() as session:
        session.add(LabelEvent(query_id=undone.id, revision=3, response=Response.RIGHT, client_uuid="again"))
    with database.reading() as session:
        assert dataset.load_preferences(session, store, participant.id).targets.tolist() == [0.0, 1.0]


def test_an_excluded_answer_is_not_learned_from_and_was_still_given(
    database: Database, store: ArtefactStore, participant: Participant, add_clips: AddClips, answer: Answer
) -> None:
    first, second, third, _ = add_clips(7)
    answer(first, second, Response.LEFT)
    excluded = answer(first, third, Response.RIGHT)
    with database.reading() as session:
        before = dataset.load_preferences(session, store, participant.id)
    with database.writing() as session:
        event = session.scalars(select(LabelEvent).where(LabelEvent.query_id == excluded.id)).one()
        session.add(Exclusion(label_event_id=event.id, excluded=True, reason="phone", actor="x"))
    with database.reading() as session:
        after = dataset.load_preferences(session, store, participant.id)
    assert (before.targets.tolist(), after.targets.tolist()) == ([0.0, 1.0], [0.0])
    assert after.label_count == 2
    assert after.label_hash != before.label_hash


def test_of_the_first_answers_nothing_changes_when_others_follow(
    database: Database, store: ArtefactStore, participant: Participant, add_clips: AddClips, answer: Answer
) -> None:
    first, second, third, _ = add_clips(7)
    answer(first, second, Response.LEFT)
    answer(first, third, Response.RIGHT)
    with database.reading() as session:
        whole = dataset.load_preferences(session, store, participant.id)
    answer(second, third, Response.RIGHT)
    with database.reading() as session:
        begun = dataset.load_preferences(session, store, participant.id, first=2)
    assert (begun.targets.tolist(), begun.label_count) == ([0.0, 1.0], 2)
    assert begun.label_hash == whole.label_hash


def test_the_fingerprint_depends_on_what_was_shown_and_said_and_on_nothing_else(
    database: Database, store: ArtefactStore, participant: Participant, add_clips: AddClips, answer: Answer
) -> None:
    first, second, third, _ = add_clips(7)
    answer(first, second, Response.LEFT)

    def fingerprint() -> str:
        with database.reading() as session:
            return dataset.load_preferences(session, store, participant.id).label_hash

    before = fingerprint()
    query = answer(first, third, Response.LEFT)
    after = fingerprint()
    with database.writing() as session:
        session.add(LabelEvent(query_id=query.id, revision=2, response=None, client_uuid="undo"))
    assert fingerprint() == before != after
    with database.writing() as session:
        session.add(LabelEvent(query_id=query.id, revision=3, response=Response.LEFT, client_uuid="same again"))
    assert fingerprint() == after
    with database.writing() as session:
        session.add(LabelEvent(query_id=query.id, revision=4, response=Response.RIGHT, client_uuid="changed"))
    assert fingerprint() not in (before, after)


def test_pairs_of_the_pool_share_their_scenario(
    database: Database, store: ArtefactStore, participant: Participant, add_clips: AddClips
) -> None:
    add_clips(7)
    add_clips(8, 2)
    with database.reading() as session:
        clips = dataset.pool_clips(session, participant.study_id)
        pairs = dataset.matched_pairs(clips)
    assert len(pairs) == 6 + 1
    assert all(left.rollout.scenario == right.rollout.scenario for left, right in pairs)
