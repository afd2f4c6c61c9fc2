"""Pairs that are made for one person while they answer: what is asked for, shown, left by a kill, and erased."""

import io
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from sqlalchemy import select

from app.db import Database
from app.domain.choices import Strategy
from app.domain.clips import Clip, Rollout
from app.domain.models import RunKind
from app.domain.preferences import FOLLOWING, Query, Response
from app.domain.run_keys import AGAIN
from app.domain.studies import Participant, Study
from app.services.participants import withdrawal
from app.storage import ArtefactStore
from tests.waiting import until
from tests.worker.at_hand import AtHand, at_once
from tests.worker.jobs.test_evaluation_films import done, due
from tests.worker.jobs.test_query_selection import FIRST_SIGNAL, queries_of, save_model_of, settle_on, somebody_else
from worker.compute.behaviours import DIFFERENT_ENOUGH
from worker.compute.simulation import surface_file
from worker.domain import scenarios
from worker.domain.trajectory import Trajectory
from worker.jobs import reconcile
from worker.jobs.clips import made_pairs
from worker.jobs.clips.pool_clips import build_clips
from worker.jobs.learning import dataset, query_selection
from worker.jobs.runtime import records
from worker.jobs.runtime.context import WorkerContext
from worker.jobs.runtime.records import Job
from worker.ml.filters.fitting.response_surface import ResponseSurface, best_mode
from worker.ml.rewards.reward_models import StructuredReward
from worker.tasks import registry

AddClips = Callable[..., list[Clip]]
Answer = Callable[[Clip, Clip, Response], Query]


@pytest.fixture
def context(database: Database, store: ArtefactStore) -> WorkerContext:
    return WorkerContext(database, store, AtHand())


@pytest.fixture
def ten_said(context: WorkerContext, participant: Participant, add_clips: AddClips, answer: Answer) -> None:
    """The participant has given ten of twenty answers in a study in which pairs follow, and is asked on."""
    settle_on(context, Strategy.UNIFORM, following_share=0.2)
    clips = [clip for scenario in range(5) for clip in add_clips(scenario)]
    for index in range(10):
        answer(clips[index], clips[index + 1], Response.LEFT)
    query_selection.refill_queries(context, participant.id)


def learned(context: WorkerContext, participant: Participant, weights: Any, labels: int) -> None:
    """The reward model that was due is there."""
    (job,) = due(context.database, RunKind.REWARD)
    save_model_of(context, participant.study_id, participant.id, weights, labels)
    done(context, job)


def pairs_due(database: Database) -> list[Job]:
    return [job for job in due(database, RunKind.CLIPS) if made_pairs.is_about(job)]


def made_for(database: Database, participant_id: int) -> list[Rollout]:
    with database.reading() as session:
        theirs = select(Rollout).where(Rollout.participant_id == participant_id)
        return list(session.scalars(theirs.order_by(Rollout.scenario, Rollout.behaviour)))


def mode_in(rollout: Rollout) -> np.ndarray[Any, np.dtype[np.float64]]:
    return np.array(registry.task("feeding").modes.vector(rollout.mode["mode"]))


@pytest.mark.usefixtures("ten_said")
def test_pairs_are_due_after_a_model_of_ten_answers_for_whoever_answers_on(
    context: WorkerContext, participant: Participant, study: Study
) -> None:
    assert pairs_due(context.database) == [], "nothing was learned yet"
    learned(context, participant, FIRST_SIGNAL, 10)
    (job,) = pairs_due(context.database)
    assert job.key == f"clips/participant-{participant.id}/made/labels-10"
    settle_on(context, Strategy.UNIFORM, following_share=0.0)
    assert pairs_due(context.database) == []
    settle_on(context, Strategy.UNIFORM, following_share=0.2, labels_per_participant=10)
    assert not any("/labels-10" in each.key for each in pairs_due(context.database)), "no pair comes any more"
    settle_on(context, Strategy.UNIFORM, following_share=0.2, labels_per_participant=20)
    with context.database.writing() as session:
        session.get_one(Participant, participant.id).is_preview = True
    assert pairs_due(context.database) == [], "previews are in no archive, so nothing may be theirs"


def test_as_many_pairs_are_made_as_can_be_shown_before_the_next_model() -> None:
    study = Study(stored_settings={"following_share": 0.25, "retrain_every_labels": 10})
    assert made_pairs.at_most(study.settings) == 3
    study = Study(stored_settings={"following_share": 0.5, "retrain_every_labels": 100})
    assert made_pairs.at_most(study.settings) == records.QUERIES_AHEAD / 2


@pytest.mark.slow
@pytest.mark.usefixtures("ten_said")
def test_a_pair_shows_the_robot_as_it_would_be_now_beside_a_variation_and_is_for_this_person_alone(
    context: WorkerContext, participant: Participant, study: Study
) -> None:
    with context.database.reading() as session:
        pool = {clip.id for clip in dataset.pool_clips(session, study.id)}
        clips_due = [job for job, _ in reconcile.due(session) if job.kind == RunKind.CLIPS]
    other = somebody_else(context, participant, 2, FIRST_SIGNAL, labels=10)
    learned(context, participant, FIRST_SIGNAL, 10)
    (job,) = pairs_due(context.database)
    done(context, job, build_clips)

    made = made_for(context.database, participant.id)
    assert len(made) == 2 * 2
    assert {each.scenario for each in made} == {scenarios.of_made(study.seed, number) for number in (0, 1)}
    surface = ResponseSurface.load(surface_file("feeding"), registry.task("feeding").modes)
    wanted = best_mode(surface, StructuredReward(np.tile(FIRST_SIGNAL, (8, 1))).signal_weights(), participant.seed)
    for now, varied in (made[:2], made[2:]):
        np.testing.assert_allclose(mode_in(now), wanted)
        apart = np.abs(mode_in(varied) - mode_in(now)) / (surface.high - surface.low)
        assert apart.max() >= DIFFERENT_ENOUGH, "people see the difference"
    shown = [query for query in queries_of(context.database, participant) if query.strategy == FOLLOWING]
    assert shown
    assert all(0.0 < query.propensity <= 0.2 for query in shown)
    assert not {query.left_clip_id for query in shown} & pool

    query_selection.refill_queries(context, other)
    with context.database.reading() as session:
        of_other = session.scalars(select(Query).where(Query.participant_id == other)).all()
        assert {clip.id for clip in dataset.pool_clips(session, study.id)} == pool, "nobody's pool or scale changes"
        assert [job for job, _ in reconcile.due(session) if job.kind == RunKind.CLIPS] == clips_due
    assert of_other
    assert all({query.left_clip_id, query.right_clip_id} <= pool for query in of_other)


@pytest.mark.slow
@pytest.mark.usefixtures("ten_said")
def test_a_worker_that_dies_in_the_middle_goes_on_with_the_same_pairs(
    context: WorkerContext, participant: Participant
) -> None:
    class Killed(Exception):
        pass

    learned(context, participant, FIRST_SIGNAL, 10)
    (job,) = pairs_due(context.database)
    plan: list[Any] = []

    def dies(name: str, function: Callable[..., Any], *arguments: Any) -> Any:
        found = at_once(name, function, *arguments)
        plan.append(found)
        if name == "pair-0":
            raise Killed
        return found

    with context.database.writing() as session:
        run_id = records.begin_run(session, job, seed=1)
    with pytest.raises(Killed):
        build_clips(context, job, run_id, dies)
    before = {rollout.id: rollout.trajectory_sha256 for rollout in made_for(context.database, participant.id)}
    assert len(before) == 2

    def knows_the_plan(name: str, function: Callable[..., Any], *arguments: Any) -> Any:
        return plan[0] if name == "plan" else at_once(name, function, *arguments)

    build_clips(context, job, run_id, knows_the_plan)
    after = {rollout.id: rollout.trajectory_sha256 for rollout in made_for(context.database, participant.id)}
    assert len(after) == 4
    assert before.items() <= after.items()


@pytest.mark.slow
@pytest.mark.usefixtures("ten_said")
def test_what_follows_an_older_model_is_neither_made_on_nor_shown(
    context: WorkerContext, participant: Participant
) -> None:
    learned(context, participant, FIRST_SIGNAL, 10)
    (job,) = pairs_due(context.database)

    def overtaken(name: str, function: Callable[..., Any], *arguments: Any) -> Any:
        found = at_once(name, function, *arguments)
        if name == "choose-0":
            save_model_of(context, participant.study_id, participant.id, -FIRST_SIGNAL, 20)
        return found

    with context.database.writing() as session:
        run_id = records.begin_run(session, job, seed=1)
    build_clips(context, job, run_id, overtaken)
    assert len(made_for(context.database, participant.id)) == 2, "the second pair would follow a robot of before"
    with context.database.writing() as session:
        records.drop_unseen_queries(session, participant.id, keep=0)
    query_selection.refill_queries(context, participant.id)
    assert FOLLOWING not in {query.strategy for query in queries_of(context.database, participant)}


@pytest.mark.slow
@pytest.mark.usefixtures("ten_said")
def test_what_was_made_for_somebody_is_made_again_when_it_is_lost_and_erased_when_they_withdraw(
    context: WorkerContext, participant: Participant, study: Study
) -> None:
    settle_on(context, Strategy.UNIFORM, following_share=0.1)
    learned(context, participant, FIRST_SIGNAL, 10)
    (job,) = pairs_due(context.database)
    done(context, job, build_clips)
    made = made_for(context.database, participant.id)
    files = [each.trajectory_sha256 for each in made]
    behaviour = mode_in(made[1])
    context.store.delete(files[1])
    lost = {files[1]: 1}
    with context.database.reading() as session:
        (again,) = [each for each, _ in reconcile.due(session, lost) if each.about.subject == AGAIN]
    assert again.participant_id == participant.id, "it is erased with them when they withdraw meanwhile"
    done(context, again, build_clips)
    stored = Trajectory.load(
        io.BytesIO(context.store.read(made_for(context.database, participant.id)[1].trajectory_sha256))
    )
    assert stored.scenario == made[1].scenario
    np.testing.assert_allclose(mode_in(made_for(context.database, participant.id)[1]), behaviour)

    with context.database.reading() as session:
        clips = session.scalars(select(Clip).join(Rollout).where(Rollout.participant_id == participant.id)).all()
    files += [clip.video_sha256 for clip in clips]
    with context.database.writing() as session:
        withdrawal.withdraw(session, context.store, session.get_one(Participant, participant.id), "the participant")
    assert made_for(context.database, participant.id) == []
    assert until(lambda: not any(context.store.has(each) for each in files))
    with context.database.reading() as session:
        assert dataset.pool_clips(session, study.id), "what everybody is shown stays"
