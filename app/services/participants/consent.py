"""Agreeing to take part: to which text, word for word, in which language and when."""

import hashlib

from sqlalchemy import select
from sqlalchemy.orm import Session

from app.db import now
from app.domain.participation import ConsentRecord
from app.domain.studies import Participant


def fingerprint(text: str) -> str:
    """Travels with the form, so that nobody agrees to another text than the one on their screen."""
    return hashlib.sha256(text.encode()).hexdigest()


def give(session: Session, participant: Participant, text: str, language: str) -> None:
    """Store that this person agreed to this text, of the version the study uses now, and reads in this language."""
    participant.language = language
    version = participant.study.settings.consent_version
    known = newest(session, participant)
    if has_consented(participant) and known is not None and (known.text, known.version) == (text, version):
        return  # a double click
    session.add(ConsentRecord(participant_id=participant.id, version=version, language=language, text=text))
    if not has_consented(participant):  # of a version that was agreed to twice, the first time counts
        participant.consented_at, participant.consent_version = now(), version


def has_consented(participant: Participant) -> bool:
    """Whether the person agreed to the version that the study uses now."""
    return participant.consented_at is not None and (
        participant.consent_version == participant.study.settings.consent_version
    )


def newest(session: Session, participant: Participant) -> ConsentRecord | None:
    """What the person agreed to last."""
    theirs = select(ConsentRecord).where(ConsentRecord.participant_id == participant.id)
    return session.scalar(theirs.order_by(ConsentRecord.id.desc()).limit(1))
