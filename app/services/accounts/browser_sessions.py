"""What a cookie stands for. The cookie is random and opaque, only its hash is stored, and it can be revoked."""

import hashlib
import secrets
from datetime import timedelta

from sqlalchemy import bindparam, delete, select
from sqlalchemy.orm import Session, joinedload

from app.db import now
from app.domain.people import BrowserSession, Experimenter
from app.domain.studies import Participant

# Made once, because every request of a participant needs one of them.
_PARTICIPANT = (
    select(Participant)
    .join(BrowserSession, BrowserSession.participant_id == Participant.id)
    .where(BrowserSession.cookie_sha256 == bindparam("cookie"), BrowserSession.expires_at > bindparam("moment"))
    .options(joinedload(Participant.study))
)
_PARTICIPANT_LOCKED = _PARTICIPANT.with_for_update(of=Participant)


def open_for_participant(session: Session, participant: Participant, lifetime: timedelta) -> str:
    """A new cookie for this participant's browser."""
    cookie = secrets.token_urlsafe(32)
    _forget_expired(session)
    session.add(BrowserSession(cookie_sha256=_hash(cookie), participant_id=participant.id, expires_at=now() + lifetime))
    return cookie


def open_for_experimenter(session: Session, experimenter: Experimenter, lifetime: timedelta) -> str:
    """A new cookie for this experimenter's browser."""
    cookie = secrets.token_urlsafe(32)
    _forget_expired(session)
    session.add(
        BrowserSession(cookie_sha256=_hash(cookie), experimenter_id=experimenter.id, expires_at=now() + lifetime)
    )
    return cookie


def participant_of(session: Session, cookie: str, *, lock: bool = False) -> Participant | None:
    """The participant the cookie stands for, study loaded; None when it stands for nobody (any more).

    ``lock``: until the transaction ends, nobody else changes the participant's row or locks it.
    """
    return session.scalar(_PARTICIPANT_LOCKED if lock else _PARTICIPANT, {"cookie": _hash(cookie), "moment": now()})


def experimenter_of(session: Session, cookie: str) -> Experimenter | None:
    """The experimenter the cookie stands for; None when it stands for nobody (any more)."""
    return session.scalar(
        select(Experimenter)
        .join(BrowserSession, BrowserSession.experimenter_id == Experimenter.id)
        .where(BrowserSession.cookie_sha256 == _hash(cookie), BrowserSession.expires_at > now())
        .where(Experimenter.disabled_at.is_(None))
    )


def close(session: Session, cookie: str) -> None:
    """Make the cookie stand for nobody."""
    session.execute(delete(BrowserSession).where(BrowserSession.cookie_sha256 == _hash(cookie)))


def _forget_expired(session: Session) -> None:
    session.execute(delete(BrowserSession).where(BrowserSession.expires_at <= now()))


def _hash(cookie: str) -> str:
    return hashlib.sha256(cookie.encode()).hexdigest()
