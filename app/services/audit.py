"""The record of who did what, kept for as long as the study."""

from datetime import timedelta

from sqlalchemy import select
from sqlalchemy.orm import Session

from app.db import now
from app.domain.people import AuditEvent

SYSTEM = "studio"
"""The actor when no person is logged in, such as at the first start."""


READING_NOTED_EVERY = timedelta(hours=1)
"""Whoever reads a table page by page leaves one record, and whoever asks for it all the time one per hour."""


def record(session: Session, actor: str, action: str, subject: str) -> None:
    """Remember one act; it is kept if and only if the act itself is."""
    session.add(AuditEvent(actor=actor[:80], action=action[:80], subject=subject[:200]))


def is_worth_noting(session: Session, actor: str, action: str, subject: str) -> bool:
    """Whether the newest record of the same, if there is one, is an hour old: for what happens again and again."""
    same = select(AuditEvent.at).where(
        AuditEvent.actor == actor[:80], AuditEvent.action == action[:80], AuditEvent.subject == subject[:200]
    )
    newest = session.scalar(same.order_by(AuditEvent.id.desc()).limit(1))
    return newest is None or now() - newest >= READING_NOTED_EVERY
