"""What happened on somebody's way besides answers: breaks, hidden pages, clips that would not play. No verdicts."""

from collections.abc import Mapping
from enum import StrEnum

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from app.domain.participation import ParticipantEvent
from app.domain.studies import Participant

MOST_EVENTS = 5000
"""Of one participant; what a browser gone wild reports beyond is dropped."""


class EventKind(StrEnum):
    """What can be noted."""

    BREAK_BEGUN = "break_begun"
    """detail: answered, the number of answers at which the break was offered"""
    BREAK_OVER = "break_over"
    """detail: answered"""
    PAGE_HIDDEN = "page_hidden"
    """The page went into the background; detail: query_id"""
    PAGE_SHOWN = "page_shown"
    """It came back; detail: query_id, duration_ms for which it was hidden"""
    PLAY_ERROR = "play_error"
    """A clip could not be loaded or played; detail: query_id"""
    STALLED = "stalled"
    """A clip had to wait for the network; detail: query_id, duration_ms"""
    ANSWERS_OPENED = "answers_opened"
    """Answers were opened although the clips could not be watched to their end; detail: query_id"""
    KEYS_USED = "keys_used"
    """The keys were used in practice; detail: count of different ones"""


def note(session: Session, participant: Participant, kind: EventKind, detail: Mapping[str, int]) -> None:
    """Keep one event."""
    known = session.scalar(
        select(func.count(ParticipantEvent.id)).where(ParticipantEvent.participant_id == participant.id)
    )
    if (known or 0) < MOST_EVENTS:
        session.add(ParticipantEvent(participant_id=participant.id, kind=kind, detail=dict(detail)))


def note_once(session: Session, participant: Participant, kind: EventKind, answered: int) -> None:
    """Keep an event that belongs to a number of answers, unless it is kept already."""
    if not known_at(session, participant, kind, answered):
        note(session, participant, kind, {"answered": answered})


def known_at(session: Session, participant: Participant, kind: EventKind, answered: int) -> bool:
    """Whether such an event was kept for this number of answers."""
    details = session.scalars(
        select(ParticipantEvent.detail).where(
            ParticipantEvent.participant_id == participant.id, ParticipantEvent.kind == kind
        )
    )
    return any(detail.get("answered") == answered for detail in details)
