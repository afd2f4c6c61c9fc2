"""What is missing or stale is found from the rows alone."""

from collections.abc import Callable
from datetime import timedelta

import pytest
from sqlalchemy import select

from app.db import Database, now
from app.domain.clips import Clip
from app.domain.evaluation import Trial
from app.domain.models import Run, RunKind, RunStatus
from app.domain.preferences import Exclusion, LabelEvent, Query, Response
from app.domain.protocol import PAPER_METHODS, EvaluationSettings
from app.domain.studies import Participant, Study
from app.domain.study_settings import StudySettings
from app.installed_tasks.refinements import SHORTEST_REFINEMENT
from tests.worker.invented import job_of
from worker.domain import scenarios
from worker.jobs import reconcile
from worker.jobs.runtime import due_work, records

AddClips = Callable[..., list[Clip]]
Answer = Callable[[Clip, Clip, Response], Query]


@pytest.fixture
def found(database: Database) -> Callable[[], dict[str, int]]:
    def look() -> dict[str, int]:
        with database.reading() as session:
            found = reconcile.due(session)
            return {job.key: attempt for job, attempt in found if job.kind is not RunKind.REPORT}

    return look


@pytest.fixture
def labels(add_clips: AddClips, answer: Answer, study: Study) -> Callable[[int], list[Query]]:
    """Fill the pool, then give so many answers; then so many more."""
    pairs: list[tuple[Clip, Clip]] = []

    def give(count: int) -> list[Query]:
        if not pairs:
            clips = [add_clips(scenarios.of_pool(study.seed, index)) for index in range(4)]
            pairs.extend((four[i], four[j]) for four in clips for i in range(4) for j in range(i))
        return [answer(*pairs.pop(0), Response.LEFT) for _ in range(count)]

    return give


def succeed(database: Database, key: str) -> None:
    with database.writing() as session:
        session.add(Run(workflow_id=key, kind="reward", study_id=1, status=RunStatus.SUCCEEDED))


def test_a_new_study_needs_clips_a_few_scenarios_at_a_time(study: Study, found: Callable[[], dict[str, int]]) -> None:
    first, second = (scenarios.of_pool(study.seed, index) for index in (0, 1))
    assert found() == {f"clips/study-1/scenario-{first}": 1, f"clips/study-1/scenario-{second}": 1}


def test_a_scenario_with_some_of_its_clips_still_needs_the_rest(
    study: Study, add_clips: AddClips, found: Callable[[], dict[str, int]]
) -> None:
    add_clips(scenarios.of_pool(study.seed, 0), 3)
    assert f"clips/study-1/scenario-{scenarios.of_pool(study.seed, 0)}" in found()
    add_clips(scenarios.of_pool(study.seed, 1), 4)
    assert f"clips/study-1/scenario-{scenarios.of_pool(study.seed, 1)}" not in found()


def test_the_reward_model_is_due_at_every_tenth_label(
    labels: Callable[[int], list[Query]], found: Callable[[], dict[str, int]]
) -> None:
    labels(9)
    assert found() == {}


def test_the_first_answer_is_noticed(database: Database, labels: Callable[[int], list[Query]]) -> None:
    with database.reading() as session:
        assert reconcile.studies_with_answers(session) == []
    labels(1)
    with database.reading() as session:
        assert [study.task for study in reconcile.studies_with_answers(session)] == ["feeding"]


def test_the_tenth_label_asks_for_a_reward_model_and_then_for_the_milestones_filter(
    database: Database, labels: Callable[[int], list[Query]], found: Callable[[], dict[str, int]]
) -> None:
    labels(10)
    assert found() == {"reward/participant-1/labels-10": 1}
    succeed(database, "reward/participant-1/labels-10")
    assert found() == {"filter/participant-1/labels-10": 1}
    succeed(database, "filter/participant-1/labels-10")
    assert found() == {}


def test_a_refinement_is_begun_with_the_first_answers_while_the_others_are_given(
    database: Database, labels: Callable[[int], list[Query]], found: Callable[[], dict[str, int]]
) -> None:
    with database.writing() as session:
        study = session.get_one(Study, 1)
        study.stored_settings = {**study.stored_settings, "refinement_steps": SHORTEST_REFINEMENT}
        settings = study.settings
    labels(11)
    assert set(found()) == {"reward/participant-1/labels-10", "refinement/participant-1/ahead/labels-10"}
    assert not due_work.is_refinement_due(settings, 10), "the tenth answer can still be undone"
    assert not due_work.is_refinement_due(settings, 20), "the last filter goes on from there by itself"


def test_an_earlier_filter_waits_for_what_is_refined_ahead_while_its_person_is_here(
    database: Database, labels: Callable[[int], list[Query]], found: Callable[[], dict[str, int]]
) -> None:
    """Nobody waits for it, and both need the same processors."""
    with database.writing() as session:
        study = session.get_one(Study, 1)
        study.stored_settings = {**study.stored_settings, "refinement_steps": SHORTEST_REFINEMENT}
    ahead, earlier = "refinement/participant-1/ahead/labels-10", "filter/participant-1/labels-10"

    def due_for_somebody_last_seen(since: timedelta) -> set[str]:
        with database.writing() as session:
            session.get_one(Participant, 1).last_seen_at = now() - since
        return set(found())

    labels(10)
    succeed(database, "reward/participant-1/labels-10")
    assert due_for_somebody_last_seen(timedelta()) == set(), "the refinement is due with the next answer"
    assert due_for_somebody_last_seen(timedelta(minutes=10)) == {earlier}
    labels(1)
    assert due_for_somebody_last_seen(timedelta()) == {ahead}
    succeed(database, ahead)
    assert due_for_somebody_last_seen(timedelta()) == {earlier}


def test_a_last_answer_that_is_changed_makes_the_last_models_stale(
    database: Database, labels: Callable[[int], list[Query]], found: Callable[[], dict[str, int]]
) -> None:
    queries = labels(20)
    (first,) = found()
    succeed(database, first)
    for _ in ("filter", "films"):
        (following,) = found()
        succeed(database, following)
    assert found() == {}
    with database.writing() as session:
        session.add(LabelEvent(query_id=queries[-1].id, revision=2, response=None, client_uuid="undo"))
        session.add(LabelEvent(query_id=queries[-1].id, revision=3, response=Response.RIGHT, client_uuid="other"))
    (third,) = found()
    assert third.startswith("reward/participant-1/labels-20")
    assert third != first


def test_a_running_run_is_left_alone_until_nobody_has_heard_of_it_for_a_while(
    database: Database, labels: Callable[[int], list[Query]], found: Callable[[], dict[str, int]]
) -> None:
    labels(10)
    job = job_of("reward/participant-1/labels-10", 1)
    with database.writing() as session:
        run_id = records.begin_run(session, job, seed=5)
    assert found() == {}
    with database.reading() as session:
        assert reconcile.abandoned(session, ()) == []
    with database.writing() as session:
        session.get_one(Run, run_id).heartbeat_at = now() - 1.01 * records.LEASE
    with database.reading() as session:
        assert reconcile.abandoned(session, ()) == [(job, 1)]
        assert reconcile.abandoned(session, {"reward/participant-1/labels-10"}) == []


def test_a_sign_of_life_from_before_the_clock_was_set_back_keeps_nobody_from_taking_over(
    database: Database, labels: Callable[[int], list[Query]]
) -> None:
    """It would for as many minutes as the clock was wrong. Who is alive gives another one within seconds."""
    labels(10)
    job = job_of("filter/participant-1/labels-10", 1)
    with database.writing() as session:
        run_id = records.begin_run(session, job, seed=5)
        session.get_one(Run, run_id).heartbeat_at = now() + timedelta(minutes=7)
    with database.reading() as session:
        assert reconcile.abandoned(session, ()) == [(job, 1)]


def test_a_failed_run_is_tried_again_a_few_times_and_then_only_when_somebody_asks(
    database: Database, labels: Callable[[int], list[Query]], found: Callable[[], dict[str, int]]
) -> None:
    labels(10)
    job = job_of("reward/participant-1/labels-10", 1)
    for attempt in range(1, records.ATTEMPTS + 1):
        assert found() == {job.key: attempt}
        with database.writing() as session:
            run_id = records.begin_run(session, job, seed=5)
            records.fail_run(session, job.key, "it broke")
        assert found() == {}, "a failed run waits before it is tried again"
        with database.writing() as session:
            session.get_one(Run, run_id).finished_at = now() - timedelta(hours=1)
    assert found() == {}
    with database.writing() as session:
        session.get_one(Run, run_id).status = RunStatus.RETRY
    assert found() == {job.key: records.ATTEMPTS + 1}


def test_milestones_that_were_passed_in_the_meantime_are_skipped() -> None:
    settings = StudySettings(labels_per_participant=200, filter_milestones=(50, 100))
    assert [due_work.filter_due(settings, count) for count in (49, 50, 99, 130, 199, 200)] == [
        0,
        50,
        50,
        100,
        100,
        200,
    ]


def test_the_end_is_a_retraining_even_when_the_cadence_does_not_divide_it() -> None:
    settings = StudySettings(labels_per_participant=25, retrain_every_labels=10)
    assert [due_work.reward_due(settings, count) for count in (9, 10, 24, 25)] == [0, 10, 20, 25]


def test_queries_are_made_ahead_but_never_more_than_planned(
    database: Database, study: Study, participant: Participant, labels: Callable[[int], list[Query]]
) -> None:
    with database.reading() as session:
        assert records.next_queries(session, participant.id, study.settings) == (1, records.QUERIES_AHEAD)
    labels(15)
    with database.reading() as session:
        assert records.next_queries(session, participant.id, study.settings) == (16, 5)


def exclude(database: Database, query: Query, *, excluded: bool = True) -> None:
    with database.writing() as session:
        event = session.scalars(select(LabelEvent).where(LabelEvent.query_id == query.id)).one()
        session.add(Exclusion(label_event_id=event.id, excluded=excluded, reason="phone", actor="x"))


def test_an_excluded_answer_makes_the_models_stale_and_so_does_taking_it_in_again(
    database: Database, labels: Callable[[int], list[Query]], found: Callable[[], dict[str, int]]
) -> None:
    given = labels(11)
    succeed(database, "reward/participant-1/labels-10")
    succeed(database, "filter/participant-1/labels-10")
    assert found() == {}
    exclude(database, given[3])
    assert found() == {"reward/participant-1/labels-10/exclusion-1": 1}
    succeed(database, "reward/participant-1/labels-10/exclusion-1")
    assert found() == {"filter/participant-1/labels-10/exclusion-1": 1}
    exclude(database, given[3], excluded=False)
    assert found() == {"reward/participant-1/labels-10/exclusion-2": 1}


def test_an_excluded_last_answer_leaves_nobody_short_of_labels(
    database: Database, labels: Callable[[int], list[Query]], found: Callable[[], dict[str, int]]
) -> None:
    given = labels(20)
    exclude(database, given[-1])
    assert found() == {"reward/participant-1/labels-20/answer-20-exclusion-1": 1}


def test_whoever_has_been_shown_robots_keeps_them_when_an_answer_is_excluded(
    database: Database, study: Study, labels: Callable[[int], list[Query]], found: Callable[[], dict[str, int]]
) -> None:
    with database.writing() as session:
        settings = study.settings.model_copy(update={"evaluation": EvaluationSettings(methods=PAPER_METHODS)})
        session.get_one(Study, study.id).stored_settings = settings.model_dump(mode="json")
    given = labels(20)
    exclude(database, given[3])
    ending = "labels-20/answer-20-exclusion-1"
    succeed(database, f"reward/participant-1/{ending}")
    succeed(database, f"filter/participant-1/{ending}")
    before_after = f"films/participant-1/before-after/{ending}"
    assert set(found()) == {before_after, f"method/participant-1/prefft/{ending}"}
    with database.writing() as session:
        session.add(Trial(participant_id=1, ordinal=1, letter="A", repetition=1, scenario=1, shown_at=now()))
    assert set(found()) == {before_after}


def test_nothing_is_done_for_a_study_that_is_put_away_or_deleted(
    database: Database, study: Study, labels: Callable[[int], list[Query]], found: Callable[[], dict[str, int]]
) -> None:
    labels(10)
    for column in ("put_away_at", "deleted_at"):
        with database.writing() as session:
            setattr(session.get_one(Study, study.id), column, now())
        assert found() == {}
        with database.reading() as session:
            assert reconcile.short_of_queries(session) == []
            assert reconcile.studies_with_answers(session) == []
        with database.writing() as session:
            setattr(session.get_one(Study, study.id), column, None)
    assert found() == {"reward/participant-1/labels-10": 1}
