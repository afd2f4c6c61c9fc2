"""Recording answers: each exactly once, whatever the network, the browser or an impatient finger does."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from http import HTTPStatus
from uuid import UUID

from sqlalchemy import select
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from app.domain.preferences import LabelEvent, Query, Response, SkipReason
from app.domain.studies import Participant
from app.errors import AppError
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
) -> LabelEvent:
    """Store one answer and return the one that counts: this, or an earlier one that this repeats or contradicts.

    ``reason``: why somebody could not tell; kept with that answer only.

    Raises QueryNotFound (missing, or put to someone else), QueryNotShown and AnswerMisdirected.
    """
    query = _own_query(session, participant, query_id)
    events = _events(session, query)
    known = _earlier(session, events, client_uuid)
    if known is not None:
        return known
    if query.served_at is None:
        raise QueryNotShown
    if events and events[-1].response is not None:
        return events[-1]
    event = LabelEvent(
        query_id=query.id,
        revision=len(events) + 1,
        response=response,
        client_uuid=str(client_uuid),
        reason=reason if response is Response.SKIP else None,
        **asdict(watching),
    )
    return _append(session, query, event)


def undo_label(session: Session, participant: Participant, query_id: int, client_uuid: UUID) -> None:
    """Take back the newest answer, so that its pair is shown again. Taking it back twice is taking it back once.

    Raises QueryNotFound, AnswerMisdirected and UndoTooLate.
    """
    query = _own_query(session, participant, query_id)
    events = _events(session, query)
    if _earlier(session, events, client_uuid) is not None or not events or events[-1].response is None:
        return
    if next_query.answers_given(session, participant).newest_query_id != query.id:
        raise UndoTooLate
    _append(session, query, LabelEvent(query_id=query.id, revision=len(events) + 1, client_uuid=str(client_uuid)))


def _own_query(session: Session, participant: Participant, query_id: int) -> Query:
    mine = select(Query).where(Query.id == query_id, Query.participant_id == participant.id)
    query = session.scalar(mine.with_for_update())  # SQLite: the whole database is already ours
    if query is None:
        raise QueryNotFound
    return query


def _events(session: Session, query: Query) -> Sequence[LabelEvent]:
    return session.scalars(
        select(LabelEvent).where(LabelEvent.query_id == query.id).order_by(LabelEvent.revision)
    ).all()


def _earlier(session: Session, events: Sequence[LabelEvent], client_uuid: UUID) -> LabelEvent | None:
    """The event this client already sent. Raises AnswerMisdirected when it was sent to another pair."""
    mine = next((event for event in events if event.client_uuid == str(client_uuid)), None)
    elsewhere = select(LabelEvent.id).where(LabelEvent.client_uuid == str(client_uuid))
    if mine is None and session.scalar(elsewhere) is not None:
        raise AnswerMisdirected
    return mine


def _append(session: Session, query: Query, event: LabelEvent) -> LabelEvent:
    """Add the event; if another request was first, theirs counts. The unique constraints are the last judge."""
    try:
        with session.begin_nested():
            session.add(event)
            session.flush()
    except IntegrityError as error:
        events = _events(session, query)
        if not events:
            raise AnswerMisdirected from error
        return events[-1]
    return event
