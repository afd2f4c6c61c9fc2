"""What a cookie stands for. The cookie is random and opaque, only its hash is stored, and it can be revoked."""

import hashlib
import secrets
from collections.abc import Sequence
from datetime import datetime, timedelta
from http import HTTPStatus

from sqlalchemy import bindparam, delete, select, update
from sqlalchemy.orm import Session, joinedload

from app.db import now
from app.domain.people import BrowserSession, Experimenter
from app.domain.studies import Participant
from app.errors import AppError
from app.services import audit
from app.services.accounts import browser_names

USE_NOTED_EVERY = timedelta(minutes=1)


class SessionNotFound(AppError):
    """You are not logged in there any more."""

    status = HTTPStatus.NOT_FOUND


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


def open_for_experimenter(
    session: Session,
    experimenter: Experimenter,
    lifetime: timedelta,
    *,
    user_agent: str = "",
    second_factor_due: bool = False,
) -> str:
    """A new cookie for this experimenter's browser; ``second_factor_due``: it opens the form for the code only."""
    cookie = secrets.token_urlsafe(32)
    _forget_expired(session)
    session.add(
        BrowserSession(
            cookie_sha256=_hash(cookie),
            experimenter_id=experimenter.id,
            expires_at=now() + lifetime,
            browser=browser_names.in_words(user_agent),
            second_factor_due=second_factor_due,
        )
    )
    return cookie


def participant_of(session: Session, cookie: str, *, lock: bool = False) -> Participant | None:
    """The participant the cookie stands for, study loaded; None when it stands for nobody (any more).

    ``lock``: until the transaction ends, nobody else changes the participant's row or locks it.
    """
    return session.scalar(_PARTICIPANT_LOCKED if lock else _PARTICIPANT, {"cookie": _hash(cookie), "moment": now()})


def experimenter_of(session: Session, cookie: str, *, second_factor_due: bool = False) -> Experimenter | None:
    """The experimenter the cookie stands for; None when it stands for nobody (any more).

    ``second_factor_due``: the one whose password was right and whose code is still to come; otherwise nobody is.
    """
    found = login_of(session, cookie, second_factor_due=second_factor_due)
    return None if found is None else found[0]


def login_of(
    session: Session, cookie: str, *, second_factor_due: bool = False
) -> tuple[Experimenter, BrowserSession] | None:
    """Like experimenter_of(), with the login."""
    return session.execute(
        select(Experimenter, BrowserSession)
        .join(BrowserSession, BrowserSession.experimenter_id == Experimenter.id)
        .where(BrowserSession.cookie_sha256 == _hash(cookie), BrowserSession.expires_at > now())
        .where(Experimenter.disabled_at.is_(None), BrowserSession.second_factor_due.is_(second_factor_due))
    ).one_or_none()


def lasts_until(login: BrowserSession, idle: timedelta, whole: timedelta) -> datetime | None:
    """When a login ends that is used now; None while that is about when it ends anyway.

    ``idle``: after which one ends that is not used. ``whole``: after which it ends in any case.
    """
    until = min(login.created_at + whole, now() + idle)
    return until if abs(until - login.expires_at) > USE_NOTED_EVERY else None


def prolong(session: Session, cookie: str, until: datetime) -> None:
    """Let the login of this cookie last until then, if it has not ended meanwhile."""
    mine = BrowserSession.cookie_sha256 == _hash(cookie), BrowserSession.expires_at > now()
    session.execute(update(BrowserSession).where(*mine).values(expires_at=until))


def of_experimenter(session: Session, experimenter: Experimenter, cookie: str) -> Sequence[tuple[BrowserSession, bool]]:
    """Where they are logged in, the newest first, and which of these is the browser with this cookie."""
    theirs = select(BrowserSession).where(
        BrowserSession.experimenter_id == experimenter.id,
        BrowserSession.expires_at > now(),
        BrowserSession.second_factor_due.is_(False),
    )
    found = session.scalars(theirs.order_by(BrowserSession.id.desc()))
    return [(each, each.cookie_sha256 == _hash(cookie)) for each in found]


def end(session: Session, experimenter: Experimenter, session_id: int) -> None:
    """Log one's own account out in another browser. Raises SessionNotFound."""
    login = session.get(BrowserSession, session_id)
    if login is None or login.experimenter_id != experimenter.id:
        raise SessionNotFound
    session.delete(login)
    audit.record(session, experimenter.name, "logged out elsewhere", experimenter.name)


def end_others(session: Session, experimenter: Experimenter, cookie: str) -> None:
    """Log one's own account out everywhere but in the browser with this cookie."""
    others = delete(BrowserSession).where(
        BrowserSession.experimenter_id == experimenter.id, BrowserSession.cookie_sha256 != _hash(cookie)
    )
    session.execute(others)
    audit.record(session, experimenter.name, "logged out everywhere else", experimenter.name)


def close(session: Session, cookie: str) -> None:
    """Make the cookie stand for nobody."""
    session.execute(delete(BrowserSession).where(BrowserSession.cookie_sha256 == _hash(cookie)))


def _forget_expired(session: Session) -> None:
    session.execute(delete(BrowserSession).where(BrowserSession.expires_at <= now()))


def _hash(cookie: str) -> str:
    return hashlib.sha256(cookie.encode()).hexdigest()
