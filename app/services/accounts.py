"""Experimenters: their passwords, kept as argon2 hashes, and how they are changed."""

import secrets

from argon2 import PasswordHasher
from argon2.exceptions import VerificationError
from sqlalchemy import func, select
from sqlalchemy.orm import Session

from app.domain.people import BrowserSession, Experimenter
from app.errors import AppError
from app.services import audit

FIRST_EXPERIMENTER = "experimenter"
"""The name of the account made at the first start."""

MIN_PASSWORD_LENGTH = 10
MAX_PASSWORD_LENGTH = 200


class WrongNameOrPassword(AppError):
    """The name or the password is not right. Passwords are case-sensitive."""


class PasswordUnacceptable(AppError):
    """The new password cannot be used."""


class ExperimenterNotFound(AppError):
    """There is no experimenter of that name. Start the studio once to create the first one."""


def create_first_experimenter(session: Session) -> str | None:
    """Make the first account and return its one-time password; None when there already is an account."""
    if session.scalar(select(func.count(Experimenter.id))):
        return None
    password = _one_time_password()
    session.add(Experimenter(name=FIRST_EXPERIMENTER, password_hash=_hasher().hash(password)))
    audit.record(session, audit.SYSTEM, "account created", FIRST_EXPERIMENTER)
    return password


def reset_password(session: Session, name: str) -> str:
    """Give the account a new one-time password and end all its logins. Raises ExperimenterNotFound."""
    experimenter = _by_name(session, name)
    if experimenter is None:
        raise ExperimenterNotFound
    password = _one_time_password()
    experimenter.password_hash = _hasher().hash(password)
    experimenter.must_change_password = True
    _end_logins(session, experimenter)
    audit.record(session, audit.SYSTEM, "password reset", name)
    return password


def verify(session: Session, name: str, password: str) -> Experimenter:
    """The experimenter of that name. Raises WrongNameOrPassword, as slowly for unknown names as for known ones."""
    experimenter = _by_name(session, name)
    stored = experimenter.password_hash if experimenter is not None else _HASH_OF_NOTHING
    try:
        _hasher().verify(stored, password)
    except VerificationError as error:
        raise WrongNameOrPassword from error
    if experimenter is None:
        raise WrongNameOrPassword
    return experimenter


def hash_of_new(experimenter: Experimenter, *, current: str, new: str) -> str:
    """The hash to store for a new password. Takes most of a second, so it is made outside of any writing transaction.

    Raises WrongNameOrPassword when the present password is not right, and PasswordUnacceptable.
    """
    try:
        _hasher().verify(experimenter.password_hash, current)
    except VerificationError as error:
        raise WrongNameOrPassword("The present password is not right.") from error
    if not MIN_PASSWORD_LENGTH <= len(new) <= MAX_PASSWORD_LENGTH:
        raise PasswordUnacceptable(f"A password has {MIN_PASSWORD_LENGTH} to {MAX_PASSWORD_LENGTH} characters.")
    if new == current:
        raise PasswordUnacceptable("The new password is the same as the present one. Choose another.")
    return _hasher().hash(new)


def set_password(session: Session, experimenter: Experimenter, password_hash: str) -> None:
    """Replace the password and end every login, the present one included: the caller opens a new one."""
    account = session.get_one(Experimenter, experimenter.id)
    account.password_hash = password_hash
    account.must_change_password = False
    _end_logins(session, account)
    audit.record(session, account.name, "password changed", account.name)


def _by_name(session: Session, name: str) -> Experimenter | None:
    return session.scalar(select(Experimenter).where(Experimenter.name == name))


def _end_logins(session: Session, experimenter: Experimenter) -> None:
    for login in session.scalars(select(BrowserSession).where(BrowserSession.experimenter_id == experimenter.id)):
        session.delete(login)


def _hasher() -> PasswordHasher:
    return PasswordHasher()


def _one_time_password() -> str:
    """Four groups of four: about 80 bits, easy to read off a terminal."""
    alphabet = "abcdefghjkmnpqrstuvwxyz23456789"
    return "-".join("".join(secrets.choice(alphabet) for _ in range(4)) for _ in range(4))


# Verified when the name is unknown, so that the time taken does not tell which names exist. No password fits it.
_HASH_OF_NOTHING = "$argon2id$v=19$m=65536,t=3,p=4$bm9ib2R5bm9ib2R5bm8$VgyHdO5zYxWk7jl5wEKEl4lQOnc3HAYUBWIrLZ0sPK4"
