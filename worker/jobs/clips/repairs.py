"""Clips and films whose stored files were lost: made again from what is left, under the same rows.

People may have answered what they saw. So a video is made again of the very trajectory it showed, and a trajectory that
comes out differently (another machine, another version) takes the place of the old one only where nobody has answered.
"""

import hashlib
import io
from collections.abc import Mapping, Sequence
from typing import Any

from sqlalchemy import or_, select
from sqlalchemy.orm import Session

from app.domain.clips import Clip, Rollout
from app.domain.evaluation import Film
from app.domain.models import RunKind
from app.domain.preferences import LabelEvent, Query
from app.domain.run_keys import AGAIN, RunKey
from app.domain.studies import Participant, Study
from app.errors import AppError
from worker.compute import simulation
from worker.compute.behaviours import Behaviour
from worker.compute.pools import Lane
from worker.domain.trajectory import Trajectory
from worker.jobs.clips.stored_video import video_columns
from worker.jobs.runtime.context import Step, WorkerContext
from worker.jobs.runtime.records import Job


class NotTheSameAgain(AppError):
    """A recording that people have answered about is lost, and making it again gave another, so nothing was changed.
    Restore the file from a backup of the data directory, then run: python -m app scrub
    """


class FilmLost(AppError):
    """The recording of a film is lost. Restore it from a backup of the data directory, then run: python -m app scrub"""


def due(session: Session, study: Study, lost: Mapping[str, int]) -> list[Job]:
    """What is to be made again. ``lost``: as ArtefactStore.lost() gives it."""
    if study.material is not None or not lost:
        return []  # videos of other robots come from outside
    recorded, filmed = Rollout.trajectory_sha256, (Clip.video_sha256, Clip.poster_sha256)
    pool = select(Rollout.id, Rollout.participant_id, recorded, *filmed).outerjoin(Clip, Clip.rollout_id == Rollout.id)
    pool = pool.where(Rollout.study_id == study.id, or_(*(each.in_(lost) for each in (recorded, *filmed))))
    rendered = (Film.video_sha256, Film.poster_sha256)
    films = select(Film.id, Film.participant_id, *rendered).join(Participant, Participant.id == Film.participant_id)
    films = films.where(Participant.study_id == study.id, Participant.withdrawn_at.is_(None))
    films = films.where(or_(*(each.in_(lost) for each in rendered)))
    stamps: dict[tuple[int, int | None], int] = {}  # the same file may be lost twice; work of one name is done once
    for rollout, person, *hashes in session.execute(pool):
        stamp = stamps.get((rollout, person), 0)
        stamps[rollout, person] = max(stamp, *(lost.get(sha256, 0) for sha256 in hashes))
    jobs = []
    for (rollout, person), stamp in stamps.items():
        key = RunKey(RunKind.CLIPS, None if person else study.id, person, AGAIN, rollout, str(stamp))
        jobs.append(Job(key, study.id))
    for film, person, *hashes in session.execute(films):
        stamp = max(lost.get(sha256, 0) for sha256 in hashes)
        key = RunKey(RunKind.FILMS, participant_id=person, subject=AGAIN, number=film, mark=str(stamp))
        jobs.append(Job(key, study.id))
    return jobs


def is_about(job: Job) -> bool:
    """Whether the job makes something again."""
    return job.about.subject == AGAIN


def make_again(context: WorkerContext, job: Job, run_id: int, step: Step) -> None:
    """Make the lost files of the rollout or film that the job names. Raises NotTheSameAgain and FilmLost."""
    context.report(run_id, "making lost files again", 0.0)
    step(AGAIN, _film_again if job.kind == RunKind.FILMS else _clips_again, context, run_id, job.number)


def _clips_again(context: WorkerContext, run_id: int, rollout_id: int) -> None:
    with context.database.reading() as session:
        rollout = session.get_one(Rollout, rollout_id)
        clips = session.scalars(select(Clip).where(Clip.rollout_id == rollout_id)).all()
        may_differ = not _answered(session, clips)
        study = session.get_one(Study, rollout.study_id)
        task, settings, quality = study.task, study.settings, study.settings.clip_quality.value
    whole = context.store.has(rollout.trajectory_sha256)
    if whole:
        trajectory = context.store.read(rollout.trajectory_sha256)
    else:
        if rollout.participant_id is None:
            drawn = simulation.behaviours(task, rollout.scenario, settings.behaviours_per_scenario)[rollout.behaviour]
        else:
            drawn = Behaviour(**rollout.mode)
        shot = (task, quality, rollout.scenario, drawn, 0, settings.clip_steps)
        trajectory = context.compute.run(Lane.CLIPS, context.beat(run_id), simulation.record_clip, *shot).trajectory
    sha256 = hashlib.sha256(trajectory).hexdigest()
    if sha256 != rollout.trajectory_sha256 and not may_differ:
        raise NotTheSameAgain
    lost = [clip for clip in clips if sha256 != rollout.trajectory_sha256 or not _is_whole(context, clip)]
    shots = [(quality, trajectory, clip.first_step, clip.step_count) for clip in lost]
    filmed = context.compute.run_all(Lane.CLIPS, context.beat(run_id), simulation.film_again, shots)
    context.store.put(trajectory)
    columns = [video_columns(context.store, each) for each in filmed]
    success = Trajectory.load(io.BytesIO(trajectory)).success
    with context.database.writing() as session:
        again = session.get_one(Rollout, rollout_id)
        again.trajectory_sha256, again.success = sha256, success
        for clip, each in zip(lost, columns, strict=True):
            _change(session.get_one(Clip, clip.id), each)


def _film_again(context: WorkerContext, run_id: int, film_id: int) -> None:
    with context.database.reading() as session:
        film = session.get_one(Film, film_id)
        study = session.get_one(Study, session.get_one(Participant, film.participant_id).study_id)
        quality = study.settings.clip_quality.value
    if not context.store.has(film.trajectory_sha256):
        raise FilmLost
    trajectory = context.store.read(film.trajectory_sha256)
    steps = len(Trajectory.load(io.BytesIO(trajectory)))
    filmed = context.compute.run(Lane.CLIPS, context.beat(run_id), simulation.film_again, quality, trajectory, 0, steps)
    columns = video_columns(context.store, filmed)
    with context.database.writing() as session:
        _change(session.get_one(Film, film_id), columns)


def _change(row: Clip | Film, columns: Mapping[str, Any]) -> None:
    for name, value in columns.items():
        setattr(row, name, value)


def _is_whole(context: WorkerContext, clip: Clip) -> bool:
    return context.store.has(clip.video_sha256) and context.store.has(clip.poster_sha256)


def _answered(session: Session, clips: Sequence[Clip]) -> bool:
    """Whether anybody has ever said anything about one of these clips."""
    ids = [clip.id for clip in clips]
    about = select(LabelEvent.id).join(Query).where(or_(Query.left_clip_id.in_(ids), Query.right_clip_id.in_(ids)))
    return session.scalar(about.limit(1)) is not None
