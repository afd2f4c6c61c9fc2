"""Who takes part: participants, how they came into an arm, their stages, consent, and events."""

from collections.abc import Sequence
from typing import Any

from sqlalchemy.orm import Session

from app.domain.designs import Ending
from app.domain.participation import Allocation, ConsentRecord, ParticipantEvent, StageRecord
from app.domain.protocol import Stage
from app.domain.studies import Participant, Study
from app.services.evaluation import unblinding
from app.services.exports.export_formats import Column, Table
from app.services.exports.paging import KeyedRows, Window
from app.services.exports.tables.columns import PARTICIPANT, I, J, N, T, W, words
from app.services.exports.whose_rows import everybody, rows_of_each


def _participants(session: Session, study: Study, window: Window) -> KeyedRows:
    for each in everybody(session, study, window):
        if (each.number,) > window.after:
            earlier = None if each.earlier_id is None else session.get_one(Participant, each.earlier_id)
            yield (each.number,), _participant(study, each, earlier)


def _participant(study: Study, each: Participant, earlier: Participant | None) -> Sequence[Any]:
    if each.withdrawn_at is not None:
        return (each.code, "withdrawn", *[None] * 9, each.withdrawn_at, each.scripted_as, *[None] * 4)
    status = "completed" if each.completed_at else "consented" if each.consented_at else "invited"
    return (
        each.code,
        status,
        each.seed,
        each.language or study.settings.language.value,
        each.created_at,
        each.consented_at,
        each.consent_version,
        each.instructed_at,
        each.completed_at,
        each.last_seen_at,
        each.panel_id,
        None,
        each.scripted_as,
        None if unblinding.is_blinded(study) else each.arm,
        each.ended_as,
        each.visit,
        None if earlier is None else earlier.code,
    )


PARTICIPANTS = Table(
    "participants",
    "One row per participant, including tombstones of those who withdrew.",
    (
        PARTICIPANT,
        Column("status", T, "How far they have come.", allowed="invited, consented, completed, withdrawn"),
        Column("seed", I, "Seed of everything that is drawn for this person."),
        Column("language", T, "Language of the pages.", allowed="en, de"),
        Column("invited_at", W, "When the personal link was made."),
        Column("consented_at", W, "When they agreed."),
        Column("consent_version", T, "Version of the text they agreed to."),
        Column("instructed_at", W, "When they had read the instructions."),
        Column("completed_at", W, "When they had finished everything."),
        Column("last_seen_at", W, "When their browser last asked for anything."),
        Column("panel_id", T, "Their id at the recruitment panel, if they came through one. Personal data."),
        Column("withdrawn_at", W, "When they withdrew; nothing else about them is kept."),
        Column("scripted_as", T, "The user that a program played; no person has answered or rated. Empty: a person."),
        Column("arm", T, "Between subjects: the arm; empty until the study is unblinded."),
        Column("ended_as", T, "Why they were sent back before the end.", allowed=words(Ending)),
        Column("visit", I, "Which visit of theirs this study is.", allowed="from 1"),
        Column("earlier_participant", T, "Their code at the visit before, in the study that this one goes on from."),
    ),
    _participants,
    (Participant,),
)


def _allocations(session: Session, study: Study, window: Window) -> KeyedRows:
    if unblinding.is_blinded(study):
        return
    for person, each in rows_of_each(session, study, window, Allocation):
        values = (person.arm, each.place, each.lot, each.considered, each.created_at)
        yield (person.number, each.id), (person.code, *values)


ALLOCATIONS = Table(
    "allocations",
    "Between subjects: how each participant came into their arm; no rows until the study is unblinded.",
    (
        PARTICIPANT,
        Column("arm", T, "Into which arm."),
        Column("place", I, "In the arm, from 1; decides in which order they met its methods."),
        Column(
            "lot",
            N,
            "Picked among the open arms with the smallest completed + on_their_way - silent, of these the fewest "
            "silent. The first 13 hexadecimal digits of SHA-256 of <secret>/evaluation/arm/<number of the "
            "participant>, divided by 16^13.",
            allowed="0 to 1",
        ),
        Column("considered", J, "By arm, as it was then: completed, on_their_way, of these silent, open."),
        Column("allocated_at", W, "When."),
    ),
    _allocations,
    (Allocation,),
    grows_by=Allocation,
)


def _stages(session: Session, study: Study, window: Window) -> KeyedRows:
    for person, each in rows_of_each(session, study, window, StageRecord):
        yield (person.number, each.id), (person.code, each.stage, each.entered_at, each.finished_at)


STAGES = Table(
    "stages",
    "When each participant entered and finished each stage.",
    (
        PARTICIPANT,
        Column("stage", T, "Which stage.", allowed=words(Stage)),
        Column("entered_at", W, "When it was first shown."),
        Column(
            "finished_at",
            W,
            "When it was finished; empty for stages that are counted instead (practice, pairs, evaluation).",
        ),
    ),
    _stages,
    (StageRecord,),
)


def _consent(session: Session, study: Study, window: Window) -> KeyedRows:
    for person, each in rows_of_each(session, study, window, ConsentRecord):
        yield (person.number, each.id), (person.code, each.version, each.language, each.agreed_at, each.text)


CONSENT = Table(
    "consent",
    "The consent text each participant agreed to, word for word.",
    (
        PARTICIPANT,
        Column("version", T, "Version of the text."),
        Column("language", T, "Language of the text.", allowed="en, de"),
        Column("agreed_at", W, "When they agreed."),
        Column("text", T, "The text, word for word."),
    ),
    _consent,
    (ConsentRecord,),
    grows_by=ConsentRecord,
)


def _events(session: Session, study: Study, window: Window) -> KeyedRows:
    for person, each in rows_of_each(session, study, window, ParticipantEvent):
        yield (person.number, each.id), (person.code, each.at, each.kind, each.detail)


EVENTS = Table(
    "events",
    "What happened besides answers: breaks, hidden pages, clips that would not play.",
    (
        PARTICIPANT,
        Column("at", W, "When it happened."),
        Column("kind", T, "What happened; app/services/participant_events.py says what each kind means."),
        Column("detail", J, "Numbers that belong to it."),
    ),
    _events,
    (ParticipantEvent,),
    grows_by=ParticipantEvent,
)
