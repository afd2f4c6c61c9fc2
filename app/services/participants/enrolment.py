"""How a person comes into a study: the personal link."""

import hashlib
import secrets
from http import HTTPStatus

from sqlalchemy import delete, func, select
from sqlalchemy.orm import Session, joinedload

from app.db import now
from app.domain.people import BrowserSession
from app.domain.studies import PREVIEW_NUMBERS, Participant, Study
from app.errors import AppError
from app.services import audit


class LinkNotValid(AppError):
    """This link is not valid. It may have been replaced by a newer one; please ask the person who sent it to you."""

    status = HTTPStatus.NOT_FOUND


class LinkRevoked(AppError):
    """This link has been switched off. Your answers so far are kept; to go on, please ask for a new link."""

    status = HTTPStatus.GONE


class ParticipantNotFound(AppError):
    """There is no such participant in this study."""

    status = HTTPStatus.NOT_FOUND


def add_participant(
    session: Session, study: Study, actor: str = audit.SYSTEM, scripted_as: str | None = None
) -> tuple[Participant, str]:
    """Add a person to the study. The token of the personal link is returned here and nowhere else: its hash is kept.

    ``scripted_as``: the user whom a program is to play.
    """
    participant, token = _add(session, study, actor, preview=False)
    participant.scripted_as = scripted_as
    return participant, token


def add_returning(session: Session, study: Study, earlier: Participant) -> Participant:
    """Add somebody to a later visit of theirs, under the number that they had, if it is free; their link leads on."""
    participant, _ = _add(session, study, audit.PARTICIPANT, preview=False, wished=earlier.number)
    participant.earlier_id, participant.visit = earlier.id, earlier.visit + 1
    participant.language, participant.scripted_as = earlier.language, earlier.scripted_as
    participant.panel_id, participant.panel_parameters = earlier.panel_id, earlier.panel_parameters
    session.flush()
    return participant


def count_scripted(session: Session, study: Study) -> int:
    """How many participants a program plays."""
    present = select(func.count(Participant.id)).where(
        Participant.study_id == study.id, Participant.withdrawn_at.is_(None)
    )
    return session.scalar(present.where(Participant.scripted_as.is_not(None))) or 0


def add_preview(session: Session, study: Study, actor: str) -> tuple[Participant, str]:
    """Somebody who looks at the study as a participant would; marked as such and counted nowhere."""
    return _add(session, study, actor, preview=True)


def _add(
    session: Session, study: Study, actor: str, *, preview: bool, wished: int | None = None
) -> tuple[Participant, str]:
    session.scalar(select(Study.id).where(Study.id == study.id).with_for_update())  # numbers are given one at a time
    like_this = Participant.study_id == study.id, Participant.is_preview.is_(preview)
    newest = session.scalar(select(func.max(Participant.number)).where(*like_this))
    number, token = (newest or (PREVIEW_NUMBERS if preview else 0)) + 1, _new_token()
    if wished and session.scalar(select(Participant.id).where(*like_this, Participant.number == wished)) is None:
        number = wished
    participant = Participant(
        study_id=study.id,
        number=number,
        token_sha256=_hash(token),
        seed=participant_seed(study.seed, number),
        is_preview=preview,
    )
    session.add(participant)
    session.flush()
    act = "preview opened" if preview else "participant added"
    audit.record(session, actor, act, f"{study.slug}/{participant.code}", participant=participant)
    return participant, token


def renew_link(session: Session, study: Study, participant: Participant, actor: str) -> str:
    """Give the participant a new link; the old one, and every browser that used it, is shut out."""
    token = _new_token()
    participant.token_sha256, participant.link_revoked_at = _hash(token), None
    session.execute(delete(BrowserSession).where(BrowserSession.participant_id == participant.id))
    audit.record(session, actor, "link renewed", f"{study.slug}/{participant.code}", participant=participant)
    return token


def revoke_link(session: Session, study: Study, participant: Participant, actor: str) -> None:
    """Shut out the participant's link, and every browser that used it, until there is a new link."""
    participant.link_revoked_at = participant.link_revoked_at or now()
    session.execute(delete(BrowserSession).where(BrowserSession.participant_id == participant.id))
    audit.record(session, actor, "link revoked", f"{study.slug}/{participant.code}", participant=participant)


def find_by_token(session: Session, token: str) -> Participant:
    """The participant whose personal link this is, study loaded. Raises LinkNotValid and LinkRevoked."""
    participant = session.scalar(
        select(Participant).where(Participant.token_sha256 == _hash(token)).options(joinedload(Participant.study))
    )
    if participant is None:
        raise LinkNotValid
    if participant.link_revoked_at is not None:
        raise LinkRevoked
    return participant


def find_by_code(session: Session, study: Study, code: str) -> Participant:
    """The participant P07 of this study. Raises ParticipantNotFound."""
    digits = code.removeprefix("P")
    number = int(digits) if digits.isascii() and digits.isdigit() and len(digits) < 9 else None
    participant = session.scalar(
        select(Participant).where(Participant.study_id == study.id, Participant.number == number)
    )
    if participant is None or participant.code != code:
        raise ParticipantNotFound
    return participant


def _new_token() -> str:
    return secrets.token_urlsafe(32)


def _hash(token: str) -> str:
    return hashlib.sha256(token.encode()).hexdigest()


def participant_seed(study_seed: int, number: int) -> int:
    """Follows from the study's seed, so that a study can be repeated exactly."""
    return int.from_bytes(hashlib.sha256(f"{study_seed}/participant/{number}".encode()).digest()[:4]) >> 1
