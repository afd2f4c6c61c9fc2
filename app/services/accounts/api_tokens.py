"""Keys to the API, with the rights of the account that made them or fewer: shown once, and good for a time."""

import hashlib
import secrets
from collections.abc import Sequence
from datetime import timedelta
from http import HTTPStatus

from sqlalchemy import select
from sqlalchemy.orm import Session

from app.db import now
from app.domain.people import ApiToken, Experimenter, TokenScope
from app.domain.studies import Study
from app.errors import AppError, Refused
from app.services import audit

PREFIX = "pbarl_"
"""So that people, and programs that search code for secrets, recognise one."""
LONGEST_NAME = 80
MOST_TOKENS = 50
LIFETIMES_DAYS = (7, 30, 90, 365)
USUAL_LIFETIME_DAYS = 90
USE_NOTED_EVERY = timedelta(minutes=1)


class TokenInvalid(AppError):
    """This token is not valid. It may have expired or been revoked; make a new one on the page of API tokens."""

    status = HTTPStatus.UNAUTHORIZED


class TokenNotFound(AppError):
    """You have no such token."""

    status = HTTPStatus.NOT_FOUND


class TooManyTokens(AppError):
    """You have very many tokens already. Revoke some that you do not use any more."""

    status = HTTPStatus.CONFLICT


class ScopeTooNarrow(Refused):
    """This token may only read. Make one that may also write."""


def create(
    session: Session,
    experimenter: Experimenter,
    name: str,
    *,
    scope: TokenScope = TokenScope.WRITE,
    study: Study | None = None,
    days: int = USUAL_LIFETIME_DAYS,
) -> tuple[ApiToken, str]:
    """A new token and its text, which is returned here and nowhere else: its hash is kept. Raises TooManyTokens.

    ``study``: the only one it opens.
    """
    if len(of_experimenter(session, experimenter)) >= MOST_TOKENS:
        raise TooManyTokens
    text = PREFIX + secrets.token_urlsafe(32)
    token = ApiToken(
        experimenter_id=experimenter.id,
        name=name.strip()[:LONGEST_NAME] or "token",
        token_sha256=_hash(text),
        scope=scope,
        study_id=None if study is None else study.id,
        expires_at=now() + timedelta(days=days),
    )
    session.add(token)
    session.flush()
    audit.record(session, experimenter.name, "API token made", token.name)
    return token, text


def revoke(session: Session, experimenter: Experimenter, token_id: int) -> None:
    """Make one's own token worthless. Raises TokenNotFound."""
    token = session.scalar(select(ApiToken).where(ApiToken.id == token_id, ApiToken.experimenter_id == experimenter.id))
    if token is None:
        raise TokenNotFound
    if token.revoked_at is None:
        token.revoked_at = now()
        audit.record(session, experimenter.name, "API token revoked", token.name)


def of_experimenter(session: Session, experimenter: Experimenter) -> Sequence[ApiToken]:
    """The tokens that are not revoked, those that have expired included, the newest first."""
    theirs = select(ApiToken).where(ApiToken.experimenter_id == experimenter.id, ApiToken.revoked_at.is_(None))
    return session.scalars(theirs.order_by(ApiToken.id.desc())).all()


def find(session: Session, text: str) -> tuple[ApiToken, Experimenter]:
    """The token of this text and its account. Raises TokenInvalid, also for accounts that cannot log in now."""
    row = session.execute(
        select(ApiToken, Experimenter)
        .join(Experimenter, Experimenter.id == ApiToken.experimenter_id)
        .where(ApiToken.token_sha256 == _hash(text), ApiToken.revoked_at.is_(None))
    ).one_or_none()
    if row is None:
        raise TokenInvalid
    token, experimenter = row
    if token.expires_at is not None and token.expires_at <= now():
        raise TokenInvalid
    if experimenter.must_change_password or experimenter.disabled_at is not None:
        raise TokenInvalid
    return token, experimenter


def use_is_worth_noting(token: ApiToken) -> bool:
    """Whether the last use was noted long enough ago."""
    return token.last_used_at is None or now() - token.last_used_at > USE_NOTED_EVERY


def note_use(session: Session, token_id: int) -> None:
    """Remember that the token was used just now."""
    session.get_one(ApiToken, token_id).last_used_at = now()


def _hash(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()
