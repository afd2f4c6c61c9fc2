"""Experimenters: their passwords, kept as argon2 hashes, and how they are changed."""

import secrets
from collections.abc import Sequence
from dataclasses import dataclass
from http import HTTPStatus

from argon2 import PasswordHasher
from argon2.exceptions import VerificationError
from sqlalchemy import func, select
from sqlalchemy.orm import Session

from app.db import now
from app.domain.people import BrowserSession, Experimenter, Role
from app.errors import AppError
from app.services import audit
from app.services.accounts import second_factor

FIRST_EXPERIMENTER = "experimenter"
"""The name of the account made at the first start."""

LONGEST_NAME = 80
MIN_PASSWORD_LENGTH = 10
MAX_PASSWORD_LENGTH = 200
_OUR_WORDS = ("pbarl", "studio", "experimenter", "robot", "preference", "study")
_LEAST_SCORE = 3
"""zxcvbn's: more than a hundred million guesses."""
_LONGEST_JUDGED = 72
"""What is longer is long enough, and takes zxcvbn long."""


class WrongNameOrPassword(AppError):
    """The name or the password is not right. Passwords are case-sensitive."""


class PasswordUnacceptable(AppError):
    """The new password cannot be used."""


class ExperimenterNotFound(AppError):
    """There is no such account. Start the studio once to create the first one."""

    status = HTTPStatus.NOT_FOUND


class NameUnacceptable(AppError):
    """The name cannot be used for an account."""


class AdministratorNeeded(AppError):
    """Nobody would be left to manage accounts. Make somebody else an administrator first."""

    status = HTTPStatus.CONFLICT


@dataclass(frozen=True)
class OneTimePassword:
    """A password that must be changed at the first login, and its hash; the text is shown once and not kept."""

    text: str
    hash: str


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
    experimenter = by_name(session, name)
    if experimenter is None:
        raise ExperimenterNotFound
    one_time = new_one_time_password()
    use_one_time_password(session, experimenter, one_time, audit.SYSTEM)
    second_factor.turn_off(session, experimenter, audit.SYSTEM)  # the phone may be what is lost
    return one_time.text


def new_one_time_password() -> OneTimePassword:
    """Takes most of a second, so it is made outside of any writing transaction."""
    text = _one_time_password()
    return OneTimePassword(text, _hasher().hash(text))


def everybody(session: Session) -> Sequence[Experimenter]:
    """Every account by name."""
    return session.scalars(select(Experimenter).order_by(Experimenter.name)).all()


def find(session: Session, experimenter_id: int) -> Experimenter:
    """The account. Raises ExperimenterNotFound."""
    experimenter = session.get(Experimenter, experimenter_id)
    if experimenter is None:
        raise ExperimenterNotFound
    return experimenter


def by_name(session: Session, name: str) -> Experimenter | None:
    """The account of exactly this name."""
    return session.scalar(select(Experimenter).where(Experimenter.name == name))


def add(session: Session, name: str, role: Role, password: OneTimePassword, actor: str) -> Experimenter:
    """A new account. Raises NameUnacceptable."""
    name = " ".join(name.split())
    if not 1 <= len(name) <= LONGEST_NAME or not name.isprintable():
        raise NameUnacceptable(f"Give the account a name of at most {LONGEST_NAME} characters.")
    if by_name(session, name) is not None:
        raise NameUnacceptable("There is an account of this name already.")
    experimenter = Experimenter(name=name, role=role, password_hash=password.hash)
    session.add(experimenter)
    session.flush()
    audit.record(session, actor, "account created", f"{name} ({role})")
    return experimenter


def use_one_time_password(session: Session, experimenter: Experimenter, password: OneTimePassword, actor: str) -> None:
    """Replace the password by one that must be changed at the next login, and end all logins.

    An account that was connected to the identity provider is so no more.
    """
    experimenter.password_hash = password.hash
    experimenter.must_change_password = True
    experimenter.oidc_subject = None
    end_logins(session, experimenter)
    audit.record(session, actor, "password reset", experimenter.name)


def change_role(session: Session, experimenter: Experimenter, role: Role, actor: str) -> None:
    """Give the account another role. Raises AdministratorNeeded when nobody would be left to manage accounts."""
    if role is not Role.ADMINISTRATOR:
        _leave_an_administrator(session, experimenter)
    if experimenter.role != role:
        experimenter.role = role
        audit.record(session, actor, "role changed", f"{experimenter.name} ({role})")


def disable(session: Session, experimenter: Experimenter, actor: str) -> None:
    """Shut the account out at once: logins and tokens. Raises AdministratorNeeded when nobody could undo it."""
    _leave_an_administrator(session, experimenter)
    if experimenter.disabled_at is None:
        experimenter.disabled_at = now()
        end_logins(session, experimenter)
        audit.record(session, actor, "account disabled", experimenter.name)


def enable(session: Session, experimenter: Experimenter, actor: str) -> None:
    """Let a disabled account in again."""
    if experimenter.disabled_at is not None:
        experimenter.disabled_at = None
        audit.record(session, actor, "account enabled", experimenter.name)


def verify(experimenter: Experimenter | None, password: str) -> Experimenter:
    """The experimenter, if this is their password. Takes most of a second: hold no session meanwhile.

    Raises WrongNameOrPassword, as slowly for an unknown name (None) as for a known one.
    """
    stored = experimenter.password_hash if experimenter is not None else _HASH_OF_NOTHING
    try:
        _hasher().verify(stored, password)
    except VerificationError as error:
        raise WrongNameOrPassword from error
    if experimenter is None or experimenter.disabled_at is not None:
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
    if _is_easily_guessed(new, experimenter.name):
        raise PasswordUnacceptable("This password is among the first that are guessed. A few unrelated words are good.")
    return _hasher().hash(new)


def set_password(session: Session, experimenter: Experimenter, password_hash: str) -> Experimenter:
    """Replace the password and end every login, the present one included: the caller opens a new one."""
    account = session.get_one(Experimenter, experimenter.id)
    account.password_hash = password_hash
    account.must_change_password = False
    end_logins(session, account)
    audit.record(session, account.name, "password changed", account.name)
    return account


def _leave_an_administrator(session: Session, experimenter: Experimenter) -> None:
    others = select(func.count(Experimenter.id)).where(
        Experimenter.role == Role.ADMINISTRATOR, Experimenter.disabled_at.is_(None), Experimenter.id != experimenter.id
    )
    if experimenter.role == Role.ADMINISTRATOR and not session.scalar(others):
        raise AdministratorNeeded


def _is_easily_guessed(password: str, name: str) -> bool:
    """Whether it is one of the common passwords, or little more than one, or than the name of account or studio."""
    from zxcvbn import zxcvbn  # its lists take a tenth of a second to load

    guessed: int = zxcvbn(password[:_LONGEST_JUDGED], [name, *name.split(), *_OUR_WORDS])["score"]
    return guessed < _LEAST_SCORE


def end_logins(session: Session, experimenter: Experimenter) -> None:
    """In every browser."""
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
