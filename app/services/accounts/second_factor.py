"""The second factor of a login: codes of an authenticator app (TOTP, RFC 6238), and recovery codes for when it is lost.

The secret is encrypted in the database (ChaCha20-Poly1305, bound to its account) with a key that follows from the
signing key, which is a file: a database or a copy of it alone tells no codes. Recovery codes need no key.

A code is good once, for its 30 s and those before and after. Whoever knows a password and guesses codes is slowed down
until a day holds some two dozen guesses at a million codes; recovery codes are too long to be guessed.
"""

import base64
import hashlib
import hmac
import secrets
from collections.abc import Sequence
from datetime import timedelta
from http import HTTPStatus

import pyotp
from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives.ciphers.aead import ChaCha20Poly1305
from sqlalchemy import delete, func, select
from sqlalchemy.orm import Session

from app import signing
from app.db import now
from app.domain.people import Experimenter, RecoveryCode
from app.errors import AppError
from app.services import audit
from app.settings import Settings

ISSUER = "PbARL Studio"
STEP_S = 30
RECOVERY_CODES = 10
FREE_MISTAKES = 5
_NONCE_BYTES = 12
_SEALED_LENGTH = 64
"""Characters: 12 bytes of nonce, 20 of secret and 16 that authenticate them, in base64. Plain ones have 32."""
LONGEST_PAUSE = timedelta(hours=1)


class CodeWrong(AppError):
    """This code is not right, or was used before. Wait for the next one in your app, and check its clock."""

    status = HTTPStatus.UNPROCESSABLE_ENTITY


class TooManyWrongCodes(AppError):
    """Too many wrong codes. Use a recovery code, or wait: a minute, and twice as long after every further mistake."""

    status = HTTPStatus.TOO_MANY_REQUESTS


class SecretSealed(AppError):
    """Codes of the app cannot be checked, because the studio's signing key is another than when they were set up. Use a
    recovery code. Without one, ask whoever runs the studio to put the key's file (signing.key) back, or to run: python
    -m app reset-second-factor with the name of your account."""

    status = HTTPStatus.SERVICE_UNAVAILABLE


class AlreadyOn(AppError):
    """The second factor is on already. Turn it off first, with a code of the present app."""

    status = HTTPStatus.CONFLICT


class NotBegun(AppError):
    """There is nothing to confirm. Begin to set up the second factor again."""

    status = HTTPStatus.CONFLICT


def is_on(experimenter: Experimenter) -> bool:
    """Whether a login needs a code."""
    return experimenter.second_factor_since is not None


def key_of(settings: Settings) -> bytes:
    """What secrets are encrypted with."""
    return signing.load(settings).derived(b"second factors")


def begin(session: Session, experimenter: Experimenter, key: bytes) -> str:
    """A new secret for an app, in force once a code of it was right. Raises AlreadyOn."""
    account = session.get_one(Experimenter, experimenter.id)
    if is_on(account):
        raise AlreadyOn
    secret = pyotp.random_base32()
    account.totp_secret = _sealed(account, secret, key)
    return secret


def secret_of(account: Experimenter, key: bytes) -> str | None:
    """What the app shares with the studio; None when nothing was set up. Raises SecretSealed."""
    stored = account.totp_secret
    if stored is None or len(stored) != _SEALED_LENGTH:
        return stored  # of an earlier version, and not sealed yet
    whole = base64.urlsafe_b64decode(stored)
    try:
        opened = ChaCha20Poly1305(key).decrypt(whole[:_NONCE_BYTES], whole[_NONCE_BYTES:], _bound_to(account))
    except InvalidTag as error:
        raise SecretSealed from error
    return base64.b32encode(opened).decode()


def seal_secrets(session: Session, settings: Settings) -> int:
    """Encrypt the secrets that an earlier version has stored as they are; how many there were."""
    plain = select(Experimenter).where(func.length(Experimenter.totp_secret) < _SEALED_LENGTH)
    found = session.scalars(plain).all()
    for account in found:
        account.totp_secret = _sealed(account, account.totp_secret or "", key_of(settings))
    return len(found)


def _sealed(account: Experimenter, secret: str, key: bytes) -> str:
    nonce = secrets.token_bytes(_NONCE_BYTES)
    sealed = ChaCha20Poly1305(key).encrypt(nonce, base64.b32decode(secret), _bound_to(account))
    return base64.urlsafe_b64encode(nonce + sealed).decode()


def _bound_to(account: Experimenter) -> bytes:
    """Moved to another account, a secret opens nothing."""
    return str(account.id).encode()


def address_for_apps(experimenter: Experimenter, secret: str) -> str:
    """What the QR code says."""
    return pyotp.TOTP(secret).provisioning_uri(name=experimenter.name, issuer_name=ISSUER)


def confirm(session: Session, experimenter: Experimenter, code: str, key: bytes) -> Sequence[str]:
    """Turn it on with the first code; returns the recovery codes, here and nowhere else.

    Raises NotBegun, AlreadyOn, CodeWrong and SecretSealed.
    """
    account = session.get_one(Experimenter, experimenter.id)
    if is_on(account):
        raise AlreadyOn
    if account.totp_secret is None:
        raise NotBegun
    step = _step_of(account, code, key)
    if step is None:
        raise CodeWrong
    account.second_factor_since, account.totp_used_step = now(), step
    audit.record(session, account.name, "second factor turned on", account.name)
    return _new_recovery_codes(session, account)


def passes(session: Session, experimenter: Experimenter, typed: str, key: bytes) -> str | None:
    """What was typed, in words, if it is good; it is good no more afterwards.

    Raises TooManyWrongCodes and SecretSealed.

    A wrong one is counted, so the caller commits in either case.
    """
    account = session.get_one(Experimenter, experimenter.id)
    recovery = _recovery_code(session, account, typed)
    if recovery is not None:
        recovery.used_at = now()
        account.wrong_codes = 0
        return "a recovery code"
    if account.code_wrong_at is not None and now() < account.code_wrong_at + _pause(account.wrong_codes):
        raise TooManyWrongCodes
    step = _step_of(account, typed, key)
    if step is None:
        account.wrong_codes, account.code_wrong_at = account.wrong_codes + 1, now()
        return None
    account.totp_used_step, account.wrong_codes = step, 0
    return "a code"


def renew_recovery_codes(session: Session, experimenter: Experimenter) -> Sequence[str]:
    """New recovery codes; the old ones are worthless."""
    account = session.get_one(Experimenter, experimenter.id)
    audit.record(session, account.name, "recovery codes renewed", account.name)
    return _new_recovery_codes(session, account)


def turn_off(session: Session, experimenter: Experimenter, actor: str) -> None:
    """The password alone is enough again."""
    account = session.get_one(Experimenter, experimenter.id)
    if account.totp_secret is not None and is_on(account):
        audit.record(session, actor, "second factor turned off", account.name)
    account.totp_secret = account.second_factor_since = account.totp_used_step = None
    account.wrong_codes, account.code_wrong_at = 0, None
    session.execute(delete(RecoveryCode).where(RecoveryCode.experimenter_id == account.id))


def recovery_codes_left(session: Session, experimenter: Experimenter) -> int:
    """How many can still be used."""
    left = select(func.count(RecoveryCode.id)).where(
        RecoveryCode.experimenter_id == experimenter.id, RecoveryCode.used_at.is_(None)
    )
    return session.scalar(left) or 0


def present_step() -> int:
    """The number of the 30 s that it is now."""
    return int(now().timestamp()) // STEP_S


def _step_of(account: Experimenter, typed: str, key: bytes) -> int | None:
    """The newest step whose code this is, if that was not used yet."""
    code = "".join(typed.split())
    secret = secret_of(account, key)
    if secret is None or len(code) != 6 or not (code.isascii() and code.isdigit()):
        return None
    present = present_step()
    app = pyotp.TOTP(secret)
    fitting = [step for step in (present - 1, present, present + 1) if hmac.compare_digest(app.at(step * STEP_S), code)]
    return next((step for step in reversed(fitting) if step > (account.totp_used_step or 0)), None)


def _pause(mistakes: int) -> timedelta:
    """Nothing for the first few, then a minute, and twice as long after every further one."""
    if mistakes < FREE_MISTAKES:
        return timedelta(0)
    return min(timedelta(minutes=2 ** min(mistakes - FREE_MISTAKES, 10)), LONGEST_PAUSE)


def _new_recovery_codes(session: Session, account: Experimenter) -> Sequence[str]:
    session.execute(delete(RecoveryCode).where(RecoveryCode.experimenter_id == account.id))
    codes = [_recovery_text() for _ in range(RECOVERY_CODES)]
    session.add_all(RecoveryCode(experimenter_id=account.id, code_sha256=_hash(code)) for code in codes)
    return codes


def _recovery_text() -> str:
    """120 bits in six groups: too many to be guessed, so a plain hash of it may be kept."""
    text = secrets.token_hex(15)
    return "-".join(text[at : at + 5] for at in range(0, len(text), 5))


def _recovery_code(session: Session, account: Experimenter, typed: str) -> RecoveryCode | None:
    return session.scalar(
        select(RecoveryCode).where(
            RecoveryCode.experimenter_id == account.id,
            RecoveryCode.code_sha256 == _hash(typed),
            RecoveryCode.used_at.is_(None),
        )
    )


def _hash(code: str) -> str:
    plain = "".join(each for each in code.lower() if each.isalnum())
    return hashlib.sha256(plain.encode()).hexdigest()
