"""Recording answers: each exactly once, whatever the network, the browser or an impatient finger does."""

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from http import HTTPStatus
from typing import Any, NamedTuple, cast
from uuid import UUID

from sqlalchemy import Table, bindparam, func, select
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.orm import Session

from app.domain.preferences import LabelEvent, Query, Response, SkipReason
from app.domain.studies import Participant
from app.errors import AppError
from app.installed_tasks import qualities
from app.services.answers import next_query


class QueryNotFound(AppError):
    """There is no such pair for you. Please go on with the pair you are shown."""

    status = HTTPStatus.NOT_FOUND


class QueryNotShown(AppError):
    """This pair has not been shown to you yet. Please go on with the pair you are shown."""

    status = HTTPStatus.CONFLICT


class AnswerMisdirected(AppError):
    """This answer was already given to another pair. Please reload the page and answer again."""

    status = HTTPStatus.CONFLICT


class QualityUnknown(AppError):
    """This study does not ask about that. Please reload the page and answer again."""

    status = HTTPStatus.UNPROCESSABLE_ENTITY


class UndoTooLate(AppError):
    """Only your newest answer can be taken back, and this is an older one."""

    status = HTTPStatus.CONFLICT


@dataclass(frozen=True)
class Watching:
    """How a pair was watched, as the browser measured it; None where it could not."""

    response_time_ms: int | None = None
    replay_count: int | None = None
    play_error_count: int | None = None
    stall_count: int | None = None
    stalled_ms: int | None = None
    largest_drift_ms: int | None = None
    playback_rate: float | None = None
    scrub_count: int | None = None
    watched_whole: bool | None = None
    left_watched_ms: int | None = None
    right_watched_ms: int | None = None
    by_script: bool | None = None
    """Whether a script measured at all; a browser without one sends the plain form."""


def record_label(
    session: Session,
    participant: Participant,
    query_id: int,
    response: Response,
    client_uuid: UUID,
    watching: Watching,
    reason: SkipReason | None = None,
    mattered: str | None = None,
) -> None:
    """Store one answer, unless this repeats or contradicts an earlier one, which then goes on counting.

    ``reason``: why somebody could not tell; ``mattered``: what made the difference between the clips, where the study
    asks. Each is kept with the answers it belongs to only.

    Raises QueryNotFound (missing, or put to someone else), QueryNotShown, AnswerMisdirected and QualityUnknown.
    """
    study = participant.study
    if mattered is not None and mattered not in qualities.of_task(study.task):
        raise QualityUnknown
    asked = _asked(session, participant, query_id, client_uuid)
    if asked.sent_to is not None:
        return
    if asked.served_at is None:
        raise QueryNotShown
    if asked.response is None:
        reason = reason if response is Response.SKIP else None
        chosen = response in {Response.LEFT, Response.RIGHT}
        mattered = mattered if chosen and study.settings.asks_what_mattered else None
        said = {"response": response, "reason": reason, "mattered": mattered}
        _append(session, asked, client_uuid, {**said, **vars(watching)})


def undo_label(session: Session, participant: Participant, query_id: int, client_uuid: UUID) -> None:
    """Take back the newest answer, so that its pair is shown again. Taking it back twice is taking it back once.

    Raises QueryNotFound, AnswerMisdirected and UndoTooLate.
    """
    asked = _asked(session, participant, query_id, client_uuid)
    if asked.sent_to is not None or asked.response is None:
        return
    if next_query.answers_given(session, participant).newest_query_id != query_id:
        raise UndoTooLate
    _append(session, asked, client_uuid, {})


class _Asked(NamedTuple):
    """A pair that the participant was asked about, and what is known of the answer to it."""

    query_id: int
    served_at: datetime | None
    revision: int
    """the newest; 0: none"""
    response: str | None
    """None: not answered, or taken back"""
    sent_to: int | None
    """the pair that this client's message was stored for already"""


_OF_THIS = LabelEvent.query_id == Query.id
_ASKED = (
    select(
        Query.id,
        Query.served_at,
        select(func.coalesce(func.max(LabelEvent.revision), 0)).where(_OF_THIS).scalar_subquery(),
        select(LabelEvent.response)
        .where(_OF_THIS)
        .order_by(LabelEvent.revision.desc())
        .limit(1)
        .correlate(Query)
        .scalar_subquery(),
        select(LabelEvent.query_id).where(LabelEvent.client_uuid == bindparam("client_uuid")).scalar_subquery(),
    )
    .where(Query.id == bindparam("query_id"), Query.participant_id == bindparam("participant_id"))
    .with_for_update()  # SQLite: the whole database is already ours
)
_EVENTS = cast(Table, LabelEvent.__table__)
_INSERT = {
    dialect.name: insert(_EVENTS).on_conflict_do_nothing().returning(_EVENTS.c.id)
    for dialect, insert in ((sqlite.dialect, sqlite.insert), (postgresql.dialect, postgresql.insert))
}


def _asked(session: Session, participant: Participant, query_id: int, client_uuid: UUID) -> _Asked:
    """Raises QueryNotFound, and AnswerMisdirected for a message that was stored for another pair."""
    sought = {"query_id": query_id, "participant_id": participant.id, "client_uuid": str(client_uuid)}
    row = session.execute(_ASKED, sought).one_or_none()
    if row is None:
        raise QueryNotFound
    asked = _Asked(*row)
    if asked.sent_to not in (None, query_id):
        raise AnswerMisdirected
    return asked


def _append(session: Session, asked: _Asked, client_uuid: UUID, said: Mapping[str, Any]) -> None:
    """Add the event; if another request was first, theirs counts. The unique constraints are the last judge."""
    event = {"query_id": asked.query_id, "revision": asked.revision + 1, "client_uuid": str(client_uuid), **said}
    if session.scalar(_INSERT[session.get_bind().dialect.name], event) is None:
        elsewhere = select(LabelEvent.query_id).where(LabelEvent.client_uuid == str(client_uuid))
        if session.scalar(elsewhere) not in (None, asked.query_id):
            raise AnswerMisdirected
