"""What was lost of clips and films is really made again, and never replaced by something people did not see."""

import io
from collections.abc import Callable
from typing import Any

import av
import pytest
from sqlalchemy import select

from app.db import Database
from app.domain.clips import Clip, Rollout
from app.domain.models import RunKind
from app.domain.preferences import Query, Response
from app.domain.studies import Participant, Study
from app.storage import ArtefactStore
from tests import factories, stored_files
from tests.worker.at_hand import AtHand, at_once
from worker.compute import simulation
from worker.domain.trajectory import Trajectory
from worker.jobs import reconcile
from worker.jobs.clips import repairs
from worker.jobs.clips.evaluation_films import make_films
from worker.jobs.clips.pool_clips import build_clips
from worker.jobs.clips.repairs import FilmLost, NotTheSameAgain
from worker.jobs.runtime import records
from worker.jobs.runtime.context import WorkerContext
from worker.jobs.runtime.records import Job

pytestmark = pytest.mark.slow


@pytest.fixture
def context(database: Database, store: ArtefactStore) -> WorkerContext:
    return WorkerContext(database, store, AtHand())


@pytest.fixture
def clips(context: WorkerContext, study: Study) -> list[Clip]:
    """Of one scenario, really simulated and filmed."""
    with context.database.writing() as session:
        settings = study.settings.model_copy(update={"behaviours_per_scenario": 2, "pool_scenarios": 20})
        session.get_one(Study, study.id).stored_settings = settings.model_dump(mode="json")
    job = next(job for job in due(context) if job.kind == RunKind.CLIPS)
    assert not repairs.is_about(job)
    work(context, job)
    with context.database.reading() as session:
        return list(session.scalars(select(Clip).order_by(Clip.id)))


def due(context: WorkerContext) -> list[Job]:
    """What the worker would begin now."""
    with context.database.reading() as session:
        return [job for job, _ in reconcile.due(session, context.store.lost())]


def to_mend(context: WorkerContext) -> list[Job]:
    """What of that is about lost files."""
    return [job for job in due(context) if repairs.is_about(job)]


def work(context: WorkerContext, job: Job) -> None:
    """Do one job from beginning to end."""
    with context.database.writing() as session:
        run_id = records.begin_run(session, job, seed=1)
    (make_films if job.kind == RunKind.FILMS else build_clips)(context, job, run_id, at_once)
    with context.database.writing() as session:
        records.finish_run(session, run_id)


def test_a_damaged_clip_is_rendered_again(context: WorkerContext, clips: list[Clip]) -> None:
    clip = clips[1]
    for _ in range(2):  # what is lost again is made again
        stored_files.damage(context.store, clip.video_sha256)
        assert not context.store.has(clip.video_sha256)
        (job,) = to_mend(context)
        work(context, job)
        with context.database.reading() as session:
            again = session.get_one(Clip, clip.id)
        with av.open(io.BytesIO(context.store.read(again.video_sha256)), "r") as video:
            frames = len(list(video.decode(video=0)))
        assert frames * 1000 == again.duration_ms * again.fps
        assert context.store.has(again.poster_sha256)
        assert to_mend(context) == []
        assert context.store.lost() == {}
        clip = again


def test_what_was_never_looked_at_is_found_by_a_scrub_and_made_again(context: WorkerContext, clips: list[Clip]) -> None:
    stored_files.damage(context.store, clips[0].video_sha256)
    stored_files.lose(context.store, clips[1].poster_sha256)
    assert to_mend(context) == []
    assert not any(context.store.scrub(sha256) for sha256 in (clips[0].video_sha256, clips[1].poster_sha256))
    for job in to_mend(context):
        work(context, job)
    with context.database.reading() as session:
        again = session.scalars(select(Clip).order_by(Clip.id)).all()
    assert all(context.store.scrub(sha256) for clip in again for sha256 in (clip.video_sha256, clip.poster_sha256))


def test_a_lost_recording_is_simulated_again(context: WorkerContext, clips: list[Clip]) -> None:
    sha256 = trajectory_of(context, clips[0])
    stored_files.lose(context.store, sha256)
    assert not context.store.has(sha256)
    (job,) = to_mend(context)
    work(context, job)
    again = Trajectory.load(io.BytesIO(context.store.read(trajectory_of(context, clips[0]))))
    assert again.scenario == rollout_of(context, clips[0]).scenario
    assert to_mend(context) == []


@pytest.mark.parametrize("answered", [False, True])
def test_another_recording_takes_its_place_only_where_nobody_has_answered(
    context: WorkerContext,
    clips: list[Clip],
    answer: Callable[[Clip, Clip, Response], Query],
    monkeypatch: pytest.MonkeyPatch,
    answered: bool,
) -> None:
    if answered:
        answer(clips[0], clips[1], Response.LEFT)
    before = trajectory_of(context, clips[0])
    stored_files.damage(context.store, before)
    assert not context.store.has(before)
    simulate = simulation.record_clip

    def differently(name: str, quality: str, scenario: int, *shot: Any) -> simulation.RecordedClip:
        return simulate(name, quality, scenario + 1, *shot)

    monkeypatch.setattr(simulation, "record_clip", differently)
    (job,) = to_mend(context)
    if answered:
        with pytest.raises(NotTheSameAgain, match="backup"):
            work(context, job)
        assert trajectory_of(context, clips[0]) == before
        return
    work(context, job)
    assert trajectory_of(context, clips[0]) != before
    with context.database.reading() as session:
        assert session.get_one(Clip, clips[0].id).video_sha256 != clips[0].video_sha256


def test_a_film_is_rendered_again_from_its_recording(
    context: WorkerContext, clips: list[Clip], study: Study, participant: Participant
) -> None:
    with context.database.writing() as session:
        film = factories.make_film(session, context.store, session.get_one(Participant, participant.id), "reference")
        film.trajectory_sha256 = trajectory_of(context, clips[0])
    stored_files.damage(context.store, film.video_sha256)
    assert not context.store.has(film.video_sha256)
    (job,) = to_mend(context)
    assert job.participant_id == participant.id
    work(context, job)
    with context.database.reading() as session:
        again = session.get_one(type(film), film.id)
    assert context.store.has(again.video_sha256)
    stored_files.damage(context.store, film.trajectory_sha256)
    stored_files.lose(context.store, again.video_sha256)
    assert not context.store.has(again.video_sha256)
    assert not context.store.has(film.trajectory_sha256)
    with pytest.raises(FilmLost, match="backup"):
        work(context, next(job for job in to_mend(context) if job.kind == RunKind.FILMS))


def trajectory_of(context: WorkerContext, clip: Clip) -> str:
    """The name of what was recorded of a clip."""
    return rollout_of(context, clip).trajectory_sha256


def rollout_of(context: WorkerContext, clip: Clip) -> Rollout:
    """What a clip shows a stretch of."""
    with context.database.reading() as session:
        return session.get_one(Rollout, clip.rollout_id)
