"""The audit log: who did what. Every row is chained to the one before it by a hash, inside the transaction of the act.

What is hashed of a row is its number, time, actor, action, study, the hash of the row before, and, instead of the
subject, a salted hash of it. So a subject can be erased with its salt, and the chain still verifies
(app.services.auditing.chain_check). Which subjects were erased is in receipts, which are chained as well.
"""

import hashlib
import json
import secrets
from datetime import UTC, timedelta
from typing import NamedTuple

from sqlalchemy import event, select, text, update
from sqlalchemy.orm import Session, SessionTransaction

from app.db import AUDITING, Database, now
from app.domain.people import AuditEvent
from app.domain.studies import Participant, Study

SYSTEM = "studio"
"""The actor when no person is logged in, such as at the first start."""
PARTICIPANT = "participant"
"""The actor when participants act for themselves; which of them is in the subject, as long as it may be known."""
STRANGER = "somebody unknown"
"""The actor while nobody has shown who they are."""
ERASED = "personal data erased"
"""The action of rows that bring a receipt into the chain."""

READING_NOTED_EVERY = timedelta(hours=1)
"""Whoever reads a table page by page leaves one record, and whoever asks for it all the time one per hour."""

BEGINNING = "0" * 64
"""What the first row has for the hash of the row before it."""
_GONE = "somebody whose data are erased"
_PENDING = "audit_events"


class Head(NamedTuple):
    """The newest row. Whoever noted it can later prove that nothing before it was changed."""

    row: int
    hash: str


def record(
    session: Session,
    actor: str,
    action: str,
    subject: str,
    *,
    study: Study | None = None,
    participant: Participant | None = None,
) -> None:
    """Remember one act; it is kept if and only if the act itself is.

    ``study`` and ``participant``: whom the subject tells of. It is erased when their data are.
    """
    if _PENDING not in session.info:
        session.info[_PENDING] = []
        event.listen(session, "before_commit", _append)
        event.listen(session, "after_soft_rollback", _drop)
    gone = participant is not None and participant.withdrawn_at is not None
    study_id = participant.study_id if participant else study.id if study else None
    new = AuditEvent(
        at=now(),
        actor=actor[:80],
        action=action[:80],
        subject=_GONE if gone else subject[:200],
        study_id=study_id,
        participant_id=None if gone or participant is None else participant.id,
    )
    session.info[_PENDING].append((session.get_nested_transaction(), new))


def note_reading(
    database: Database,
    session: Session,
    actor: str,
    action: str,
    subject: str,
    *,
    study: Study | None = None,
    participant: Participant | None = None,
) -> None:
    """Remember that somebody looked at something personal, once an hour, before it is given away.

    ``session`` only reads. Seldom enough that the writing need not wait for its turn in the event loop.
    """
    if participant is not None and participant.withdrawn_at is not None:
        subject = _GONE  # as it is recorded, or every look would be the first
    if is_worth_noting(session, actor, action, subject):
        with database.writing() as writing:
            record(writing, actor, action, subject, study=study, participant=participant)


def is_worth_noting(session: Session, actor: str, action: str, subject: str) -> bool:
    """Whether the newest record of the same, if there is one, is an hour old: for what happens again and again."""
    same = select(AuditEvent.at).where(
        AuditEvent.actor == actor[:80], AuditEvent.action == action[:80], AuditEvent.subject == subject[:200]
    )
    newest = session.scalar(same.order_by(AuditEvent.id.desc()).limit(1))
    return newest is None or now() - newest >= READING_NOTED_EVERY


def head(session: Session) -> Head:
    """The newest row of the chain."""
    newest = session.execute(select(AuditEvent.id, AuditEvent.row_hash).order_by(AuditEvent.id.desc()).limit(1)).first()
    return Head(*newest) if newest else Head(0, BEGINNING)


def forget(session: Session, *, study_id: int | None = None, participant_id: int | None = None) -> list[int]:
    """Erase every subject that tells of the participant, or of anything in the study. Returns the rows' numbers."""
    if participant_id is not None:
        theirs = AuditEvent.participant_id == participant_id
    else:
        theirs = AuditEvent.study_id == study_id
    rows = select(AuditEvent.id).where(theirs, AuditEvent.subject.is_not(None)).order_by(AuditEvent.id)
    found = list(session.scalars(rows))
    nothing = {"subject": None, "subject_salt": None, "participant_id": None}
    session.execute(update(AuditEvent).where(theirs).values(nothing))
    for _, new in session.info.get(_PENDING, []):  # not in the chain yet
        if participant_id == new.participant_id if participant_id is not None else study_id == new.study_id:
            new.subject, new.participant_id = _GONE, None
    return found


def hash_of_subject(salt: str, subject: str, participant_id: int | None) -> str:
    """What the chain holds instead of the subject."""
    return _sha256([salt, subject, participant_id])


def hash_of_row(row: AuditEvent) -> str:
    """What the next row is chained to."""
    moment = row.at.astimezone(UTC).isoformat(timespec="microseconds")
    return _sha256([row.id, moment, row.actor, row.action, row.study_id, row.subject_hash, row.previous_hash])


def _sha256(canonical: list[str | int | None]) -> str:
    return hashlib.sha256(json.dumps(canonical, separators=(",", ":")).encode()).hexdigest()


def _append(session: Session) -> None:
    """Chain what was recorded, as the last thing the transaction does: the lock is held for as short as can be.

    Whoever writes is alone anyway, except participants who write rows of their own on PostgreSQL: should they be
    recorded one day, they wait for each other here, and hold nothing that they have yet to ask for.
    """
    if session.in_nested_transaction() or not session.info[_PENDING]:
        return
    waiting, session.info[_PENDING] = session.info[_PENDING], []
    session.flush()
    if session.get_bind().dialect.name == "postgresql":
        session.execute(text("SELECT pg_advisory_xact_lock(:key)"), {"key": AUDITING})
    last = head(session)
    for _, new in waiting:
        new.id, new.previous_hash, new.subject_salt = last.row + 1, last.hash, secrets.token_hex(16)
        new.subject_hash = hash_of_subject(new.subject_salt, new.subject or "", new.participant_id)
        new.row_hash = hash_of_row(new)
        session.add(new)
        last = Head(new.id, new.row_hash)


def _drop(session: Session, undone: SessionTransaction) -> None:
    """What was recorded inside a savepoint is undone with it."""
    session.info[_PENDING] = [each for each in session.info[_PENDING] if undone not in _around(each[0])]


def _around(transaction: SessionTransaction | None) -> list[SessionTransaction]:
    found = []
    while transaction is not None:
        found.append(transaction)
        transaction = transaction.parent
    return found
