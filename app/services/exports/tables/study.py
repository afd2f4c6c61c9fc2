"""The study itself: its pool of clips, and what was changed after it was locked."""

from sqlalchemy import select
from sqlalchemy.orm import Session, aliased

from app.domain.clips import Clip, Rollout
from app.domain.studies import Deviation, Participant, Study
from app.services.exports.export_formats import Column, Table
from app.services.exports.paging import KeyedRows, Window
from app.services.exports.tables.columns import SHA256, B, I, J, T, W

AT_ONCE = 200
"""Clips: there may be tens of thousands, and a page wants a hundred."""


def _clips(session: Session, study: Study, window: Window) -> KeyedRows:
    rollout = aliased(Rollout)
    place = (rollout.scenario, rollout.behaviour, Clip.first_step, Clip.step_count, Clip.id)
    wanted = (
        select(Clip, rollout, Participant)
        .join(rollout, Clip.rollout_id == rollout.id)
        .outerjoin(Participant, Participant.id == rollout.participant_id)
        .where(rollout.study_id == study.id, window.beyond(*place), window.known(Clip))
        .order_by(*place)
        .execution_options(yield_per=AT_ONCE)
    )
    with session.execute(wanted) as rows:  # whoever wants a page only stops in the middle
        for clip, run, person in rows:
            yield (
                (run.scenario, run.behaviour, clip.first_step, clip.step_count, clip.id),
                (
                    clip.video_sha256,
                    run.scenario,
                    run.behaviour,
                    run.mode,
                    run.success,
                    clip.first_step,
                    clip.step_count,
                    clip.duration_ms,
                    clip.fps,
                    run.trajectory_sha256,
                    None if person is None else person.code,
                ),
            )


CLIPS = Table(
    "clips",
    "The pool of clips that pairs are made of.",
    (
        Column("video_sha256", T, "The video.", allowed=SHA256),
        Column("scenario", I, "Situation: its seed, or the number given when clips were imported."),
        Column("behaviour", I, "Way of doing the task in this situation.", allowed="from 0"),
        Column("mode", J, "What the behaviour is."),
        Column("success", B, "Whether the whole trajectory succeeded."),
        Column("first_step", I, "First control step that is shown."),
        Column("step_count", I, "How many steps are shown.", "control steps"),
        Column("duration_ms", I, "Length of the video.", "ms"),
        Column("fps", I, "Frames per second.", "1/s"),
        Column("trajectory_sha256", T, "The stored trajectory.", allowed=SHA256),
        Column("made_for", T, "Participant for whom alone it was made; empty: it is of the study's pool."),
    ),
    _clips,
    (Clip,),
)


def _deviations(session: Session, study: Study, window: Window) -> KeyedRows:
    known = select(Deviation).where(
        Deviation.study_id == study.id, window.beyond(Deviation.id), window.known(Deviation)
    )
    for each in session.scalars(known.order_by(Deviation.id)):
        yield (each.id,), (each.at, each.actor, each.reason, each.before, each.after)


DEVIATIONS = Table(
    "deviations",
    "Changes to the study after it was locked.",
    (
        Column("at", W, "When it was made."),
        Column("actor", T, "Account that made it."),
        Column("reason", T, "Why, in their words."),
        Column("before", J, "The changed settings, as they were."),
        Column("after", J, "The changed settings, as they are since."),
    ),
    _deviations,
    (Deviation,),
    grows_by=Deviation,
)
