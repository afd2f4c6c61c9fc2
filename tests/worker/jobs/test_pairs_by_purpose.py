"""Practice, whole trajectories, repeats and catch pairs: which clips they get; and only labels are learned from."""

import io
import logging
from collections.abc import Callable, Sequence
from dataclasses import replace

import pytest
from sqlalchemy import select

from app.db import Database
from app.domain.clips import Clip, Rollout
from app.domain.models import RunKind
from app.domain.preferences import NO_OBVIOUS_PAIR, LabelEvent, Purpose, Query, Response
from app.domain.studies import Participant, Study
from app.installed_tasks.by_name import longest_clip_steps
from app.storage import ArtefactStore
from tests.worker.conftest import STEPS, make_trajectory
from tests.worker.invented import job_of
from worker.compute.pools import Compute
from worker.domain import scenarios
from worker.domain.trajectory import SIGNALS
from worker.jobs import reconcile
from worker.jobs.learning import dataset, query_plan, query_selection, reward_models
from worker.jobs.runtime import records
from worker.jobs.runtime.context import WorkerContext

WHOLE = longest_clip_steps("feeding") or 0
ENDS = ("undelivered", "spilled_on_person", "high_force_n")


@pytest.fixture
def context(database: Database, store: ArtefactStore) -> WorkerContext:
    return WorkerContext(database, store, Compute(1))


@pytest.fixture
def settle(database: Database, study: Study) -> Callable[..., None]:
    """Give the study other settings."""

    def change(**settings: object) -> None:
        with database.writing() as session:
            row = session.get_one(Study, study.id)
            row.stored_settings = {**row.stored_settings, **settings}

    return change


def add_runs(context: WorkerContext, study: Study, scenario: int, ends_well: Sequence[bool]) -> None:
    """One rollout per behaviour, filmed as a clip and whole; it ends well within the clip or fails."""
    for behaviour, well in enumerate(ends_well):
        run = make_trajectory(scenario, behaviour, WHOLE)
        signals = run.signals.copy()
        signals[:, [SIGNALS.index(name) for name in ENDS]] = 0.0
        signals[:, SIGNALS.index("undelivered")] = 0.0 if well else 1.0
        target = io.BytesIO()
        replace(run, signals=signals, success=well).save(target)
        rollout = {
            "scenario": scenario,
            "behaviour": behaviour,
            "mode": {},
            "trajectory_sha256": context.store.put(target.getvalue()),
            "success": well,
        }
        for steps in (STEPS, WHOLE):
            name = f"{scenario:032x}{behaviour:016x}{steps:016x}"
            clip = {"first_step": 0, "step_count": steps, "video_sha256": name, "poster_sha256": name}
            size = {"width": 640, "height": 480, "fps": 15, "duration_ms": 100 * steps, "byte_count": 1}
            with context.database.writing() as session:
                records.save_clip(session, study.id, rollout, {**clip, **size})


def fill_pool(context: WorkerContext, study: Study) -> None:
    for scenario in range(4):
        add_runs(context, study, scenario, (True, True, False, True))


def queries_of(context: WorkerContext, participant: Participant) -> Sequence[Query]:
    of_person = select(Query).where(Query.participant_id == participant.id).order_by(Query.ordinal)
    with context.database.reading() as session:
        return session.scalars(of_person.options(*dataset.CLIPS_AND_ROLLOUTS)).all()


def answer_all(context: WorkerContext, participant: Participant, response: Response = Response.LEFT) -> None:
    """Refill and answer until nothing more is asked."""
    for _ in range(10):
        query_selection.refill_queries(context, participant.id)
        with context.database.writing() as session:
            waiting = records.unanswered(session, participant.id)
            for query in waiting:
                uuid = f"{query.ordinal}"
                session.add(LabelEvent(query_id=query.id, revision=1, response=response, client_uuid=uuid))
        if not waiting:
            return


def test_the_queries_follow_the_plan_to_its_end(
    context: WorkerContext, study: Study, participant: Participant, settle: Callable[..., None]
) -> None:
    settle(practice_pairs=2, introduction_pairs=5, repeated_pairs=4, catch_pairs=2)
    fill_pool(context, study)
    answer_all(context, participant)
    with context.database.reading() as session:
        plan = query_plan.plan(session.get_one(Study, study.id).settings, participant.seed)
    queries = queries_of(context, participant)
    assert [(query.ordinal, query.purpose) for query in queries] == [(slot.ordinal, slot.purpose) for slot in plan]


def test_the_introduction_shows_whole_episodes_and_everything_else_clips(
    context: WorkerContext, study: Study, participant: Participant, settle: Callable[..., None]
) -> None:
    settle(practice_pairs=1, introduction_pairs=5, repeated_pairs=2)
    fill_pool(context, study)
    answer_all(context, participant)
    for query in queries_of(context, participant):
        expected = WHOLE if query.purpose == Purpose.INTRODUCTION else STEPS
        assert {query.left_clip.step_count, query.right_clip.step_count} == {expected}
        assert query.left_clip.rollout.scenario == query.right_clip.rollout.scenario


def test_while_whole_episodes_are_being_filmed_nobody_is_sent_ahead(
    context: WorkerContext,
    participant: Participant,
    settle: Callable[..., None],
    add_clips: Callable[[int], list[Clip]],
) -> None:
    settle(practice_pairs=1, introduction_pairs=5)
    for scenario in range(4):
        add_clips(scenario)
    query_selection.refill_queries(context, participant.id)
    assert [query.purpose for query in queries_of(context, participant)] == [Purpose.PRACTICE]


def test_a_repeat_asks_the_same_clips_again_on_the_sides_the_plan_says(
    context: WorkerContext, study: Study, participant: Participant, settle: Callable[..., None]
) -> None:
    settle(repeated_pairs=4)
    fill_pool(context, study)
    answer_all(context, participant)
    with context.database.reading() as session:
        plan = query_plan.plan(session.get_one(Study, study.id).settings, participant.seed)
    by_ordinal = {query.ordinal: query for query in queries_of(context, participant)}
    repeats = [slot for slot in plan if slot.purpose is Purpose.REPEAT]
    assert len(repeats) == 4
    for slot in repeats:
        again, before = by_ordinal[slot.ordinal], by_ordinal[slot.repeats_ordinal or 0]
        sides = (before.left_clip_id, before.right_clip_id)
        assert again.repeats_query_id == before.id
        assert (again.left_clip_id, again.right_clip_id) == (sides[::-1] if slot.swapped else sides)


def test_a_catch_pair_shows_a_success_beside_a_failure_and_says_which_is_which(
    context: WorkerContext, study: Study, participant: Participant, settle: Callable[..., None]
) -> None:
    settle(catch_pairs=3)
    fill_pool(context, study)
    answer_all(context, participant)
    caught = [query for query in queries_of(context, participant) if query.purpose == Purpose.CATCH]
    assert len(caught) == 3
    for query in caught:
        assert query.left_clip.rollout.success != query.right_clip.rollout.success
        assert query.expected == ("left" if query.left_clip.rollout.success else "right")


def test_a_pool_without_an_obvious_pair_gives_repeats_instead_and_a_note(
    context: WorkerContext,
    study: Study,
    participant: Participant,
    settle: Callable[..., None],
    caplog: pytest.LogCaptureFixture,
) -> None:
    settle(catch_pairs=3)
    for scenario in range(4):
        add_runs(context, study, scenario, (True, True, True, True))
    with caplog.at_level(logging.WARNING, logger="worker.jobs.learning.query_selection"):
        answer_all(context, participant)
    instead = [query for query in queries_of(context, participant) if query.strategy == NO_OBVIOUS_PAIR]
    assert {(query.purpose, query.expected) for query in instead} == {(Purpose.REPEAT, None)}
    assert len(instead) == 3
    assert "no pair with an obvious answer" in caplog.text
    with context.database.reading() as session:
        (note,) = reward_models.notes_on_pairs(session, participant.id)
    assert note.startswith("3 catch pairs could not be had")


def test_a_catch_pair_waits_for_the_pool_to_grow_and_nobody_waits_for_it(
    context: WorkerContext, study: Study, participant: Participant, settle: Callable[..., None]
) -> None:
    settle(catch_pairs=3)
    for scenario in range(3):
        add_runs(context, study, scenario, (True, True, True, True))
    query_selection.refill_queries(context, participant.id)
    with context.database.writing() as session:
        waiting = records.unanswered(session, participant.id)
        for query in waiting[:-1]:
            session.add(LabelEvent(query_id=query.id, revision=1, response="left", client_uuid=f"{query.id}"))
        plan = query_plan.plan(session.get_one(Study, study.id).settings, participant.seed)
    query_selection.refill_queries(context, participant.id)
    caught = [slot.ordinal for slot in plan if slot.purpose is Purpose.CATCH]
    made = [query.ordinal for query in queries_of(context, participant)]
    assert caught[0] not in made
    assert max(made) > caught[0]
    add_runs(context, study, 3, (True, True, False, False))
    query_selection.refill_queries(context, participant.id)
    purposes = {query.ordinal: query.purpose for query in queries_of(context, participant)}
    assert purposes[caught[0]] == Purpose.CATCH


def test_only_labels_are_learned_from_counted_and_fingerprinted(
    context: WorkerContext, study: Study, participant: Participant, settle: Callable[..., None]
) -> None:
    settle(practice_pairs=2, introduction_pairs=5, repeated_pairs=4, catch_pairs=2)
    fill_pool(context, study)
    answer_all(context, participant, Response.RIGHT)
    with context.database.reading() as session:
        learned = dataset.load_preferences(session, context.store, participant.id)
    assert learned.pairs is not None
    assert (learned.label_count, len(learned.pairs), len(learned.targets)) == (20, 20, 20)
    assert learned.pairs.shown.sum(axis=2).tolist() == [[WHOLE] * 2] * 5 + [[STEPS] * 2] * 15
    with context.database.writing() as session:
        measured = select(Query.id).where(Query.purpose.in_([Purpose.REPEAT, Purpose.CATCH, Purpose.PRACTICE]))
        for event in session.scalars(select(LabelEvent).where(LabelEvent.query_id.in_(measured))):
            event.response = Response.LEFT
    with context.database.reading() as session:
        assert dataset.load_preferences(session, context.store, participant.id).label_hash == learned.label_hash


def test_models_are_due_by_labels_alone(
    context: WorkerContext, study: Study, participant: Participant, settle: Callable[..., None]
) -> None:
    settle(practice_pairs=2, introduction_pairs=2, repeated_pairs=4, catch_pairs=2)
    fill_pool(context, study)
    query_selection.refill_queries(context, participant.id)
    with context.database.writing() as session:
        waiting = records.unanswered(session, participant.id)
        for query in waiting[:11]:  # two of them practice
            session.add(LabelEvent(query_id=query.id, revision=1, response="left", client_uuid=f"{query.id}"))
    with context.database.reading() as session:
        assert RunKind.REWARD not in {job.kind for job, _ in reconcile.due(session)}


def test_only_labels_are_predicted(
    context: WorkerContext, study: Study, participant: Participant, settle: Callable[..., None]
) -> None:
    from tests.worker.jobs.test_query_selection import save_reward_model

    settle(practice_pairs=1, introduction_pairs=3, repeated_pairs=4, catch_pairs=2)
    fill_pool(context, study)
    query_selection.refill_queries(context, participant.id)
    with context.database.writing() as session:
        for query in records.unanswered(session, participant.id):
            session.add(LabelEvent(query_id=query.id, revision=1, response="right", client_uuid=f"{query.id}"))
    model_id = save_reward_model(context, participant)
    query_selection.refill_queries(context, participant.id)
    later = queries_of(context, participant)[12:]
    assert Purpose.REPEAT in {query.purpose for query in later}
    for query in later:
        assert (query.predicted_by_model_id == model_id) == (query.purpose == Purpose.PREFERENCE)


def test_a_newer_model_chooses_other_pairs_but_leaves_the_plan_as_it_is(
    context: WorkerContext, study: Study, participant: Participant, settle: Callable[..., None]
) -> None:
    settle(practice_pairs=1, introduction_pairs=2, repeated_pairs=4)
    fill_pool(context, study)
    query_selection.refill_queries(context, participant.id)
    before = [(query.ordinal, query.purpose) for query in queries_of(context, participant)]
    with context.database.writing() as session:
        records.drop_unseen_queries(session, participant.id, keep=3)
    kept = [query.ordinal for query in queries_of(context, participant)]
    assert kept == [1, 2, 3]
    query_selection.refill_queries(context, participant.id)
    assert [(query.ordinal, query.purpose) for query in queries_of(context, participant)] == before


def test_as_many_scenarios_are_filmed_whole_as_the_introduction_needs(
    context: WorkerContext, study: Study, settle: Callable[..., None], add_clips: Callable[[int], list[Clip]]
) -> None:
    settle(introduction_pairs=7)  # four behaviours make six pairs
    for index in range(4):
        add_clips(scenarios.of_pool(study.seed, index))
    with context.database.reading() as session:
        found = {job.key for job, _ in reconcile.due(session)}
    assert found == {f"clips/study-1/whole-{scenarios.of_pool(study.seed, index)}" for index in range(2)}


def test_whole_episodes_are_filmed_of_the_rollouts_that_are_there(
    context: WorkerContext, study: Study, settle: Callable[..., None], monkeypatch: pytest.MonkeyPatch
) -> None:
    from worker.compute import simulation
    from worker.jobs.clips import pool_clips
    from worker.sim.render.clip import RenderedClip

    settle(introduction_pairs=1)
    scenario = scenarios.of_pool(study.seed, 0)
    add_runs(context, study, scenario, (True, True))
    with context.database.writing() as session:
        for clip in session.scalars(select(Clip).where(Clip.step_count == WHOLE)):
            session.delete(clip)
    filmed: list[tuple[bytes, int, int]] = []

    def film(_quality: str, trajectory: bytes, first_step: int, step_count: int) -> RenderedClip:
        filmed.append((trajectory, first_step, step_count))
        return RenderedClip(b"video", b"poster", 640, 480, 15, step_count, 100 * step_count)

    monkeypatch.setattr(simulation, "film_again", film)
    monkeypatch.setattr(
        context.compute, "run_all", lambda _lane, _beat, function, shots: [function(*shot) for shot in shots]
    )
    job = job_of(f"clips/study-{study.id}/whole-{scenario}", study.id)
    with context.database.writing() as session:
        run_id = records.begin_run(session, job, 0)
    pool_clips.build_clips(context, job, run_id, lambda _name, function, *arguments: function(*arguments))
    with context.database.reading() as session:
        rollouts = session.scalars(select(Rollout).order_by(Rollout.behaviour)).all()
        whole = session.scalars(select(Clip).where(Clip.step_count == WHOLE).order_by(Clip.id)).all()
    assert [clip.rollout_id for clip in whole] == [rollout.id for rollout in rollouts]
    stored = [context.store.read(rollout.trajectory_sha256) for rollout in rollouts]
    assert filmed == [(trajectory, 0, WHOLE) for trajectory in stored]
