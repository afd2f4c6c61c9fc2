"""The record of who did what, kept for as long as the study."""

from sqlalchemy.orm import Session

from app.domain.people import AuditEvent

SYSTEM = "studio"
"""The actor when no person is logged in, such as at the first start."""


def record(session: Session, actor: str, action: str, subject: str) -> None:
    """Remember one act; it is kept if and only if the act itself is."""
    session.add(AuditEvent(actor=actor[:80], action=action[:80], subject=subject[:200]))
