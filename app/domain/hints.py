"""Plain hints, such as "slower near me", that somebody gives beside their answers."""

from collections.abc import Sequence
from datetime import datetime

from sqlalchemy import ForeignKey, String, Text, UniqueConstraint, select
from sqlalchemy.orm import Mapped, Session, mapped_column

from app.db import Base, now


class HintEvent(Base):
    """All that somebody hints at. Append-only: the highest revision counts, and one without hints takes all back.

    Names are those of app.installed_tasks.hints.
    """

    __tablename__ = "hint_event"
    __table_args__ = (UniqueConstraint("participant_id", "revision"),)

    id: Mapped[int] = mapped_column(primary_key=True)
    participant_id: Mapped[int] = mapped_column(ForeignKey("participant.id"), index=True)
    revision: Mapped[int]
    hints: Mapped[str] = mapped_column(String(200))
    """Names with spaces between; empty: nothing special."""
    offered: Mapped[str] = mapped_column(Text)
    """Everything that could be hinted at, in the order of the page."""
    answered: Mapped[int]
    """How many answers this person had given, practice not counted."""
    client_uuid: Mapped[str] = mapped_column(String(36), unique=True)
    created_at: Mapped[datetime] = mapped_column(default=now)


def newest_hints(session: Session, participant_id: int) -> HintEvent | None:
    """What counts now; None while the person was not asked or has not said."""
    theirs = select(HintEvent).where(HintEvent.participant_id == participant_id)
    return session.scalars(theirs.order_by(HintEvent.revision.desc()).limit(1)).first()


def hints_of(session: Session, participant_id: int) -> Sequence[str]:
    """The names of the hints that count now."""
    newest = newest_hints(session, participant_id)
    return newest.hints.split() if newest else ()
