"""Experimenters, browser sessions of everybody, and the record of who did what."""

from datetime import datetime
from enum import StrEnum

from sqlalchemy import CheckConstraint, ForeignKey, String
from sqlalchemy.orm import Mapped, mapped_column

from app.db import Base, now


class Role(StrEnum):
    """What an experimenter may do; each may do what the next one may."""

    OWNER = "owner"
    """Accounts, deleting whole studies, and everything below."""
    EXPERIMENTER = "experimenter"
    """Studies: make, lock, invite, unblind, export."""
    READER = "reader"
    """Look, and nothing else."""


class Experimenter(Base):
    """A researcher with an account."""

    __tablename__ = "experimenter"

    id: Mapped[int] = mapped_column(primary_key=True)
    name: Mapped[str] = mapped_column(String(80), unique=True)
    password_hash: Mapped[str] = mapped_column(String(200))
    must_change_password: Mapped[bool] = mapped_column(default=True)
    role: Mapped[str] = mapped_column(String(20), default=Role.OWNER, server_default=Role.OWNER)
    created_at: Mapped[datetime] = mapped_column(default=now)
    disabled_at: Mapped[datetime | None]
    """No login and no token of this account is good any more."""


class ApiToken(Base):
    """A key to the API with the rights of its experimenter. Shown once; only the hash is stored."""

    __tablename__ = "api_token"

    id: Mapped[int] = mapped_column(primary_key=True)
    experimenter_id: Mapped[int] = mapped_column(ForeignKey("experimenter.id"), index=True)
    name: Mapped[str] = mapped_column(String(80))
    token_sha256: Mapped[str] = mapped_column(String(64), unique=True)
    created_at: Mapped[datetime] = mapped_column(default=now)
    last_used_at: Mapped[datetime | None]
    revoked_at: Mapped[datetime | None]


class BrowserSession(Base):
    """What a cookie stands for: one participant or one experimenter. Only the hash of the cookie is stored."""

    __tablename__ = "browser_session"
    __table_args__ = (CheckConstraint("(participant_id IS NULL) <> (experimenter_id IS NULL)", name="one_person"),)

    id: Mapped[int] = mapped_column(primary_key=True)
    cookie_sha256: Mapped[str] = mapped_column(String(64), unique=True)
    participant_id: Mapped[int | None] = mapped_column(ForeignKey("participant.id"), index=True)
    experimenter_id: Mapped[int | None] = mapped_column(ForeignKey("experimenter.id"), index=True)
    created_at: Mapped[datetime] = mapped_column(default=now)
    expires_at: Mapped[datetime]


class AuditEvent(Base):
    """One act worth remembering; append-only."""

    __tablename__ = "audit_event"

    id: Mapped[int] = mapped_column(primary_key=True)
    at: Mapped[datetime] = mapped_column(default=now)
    actor: Mapped[str] = mapped_column(String(80))
    action: Mapped[str] = mapped_column(String(80))
    subject: Mapped[str] = mapped_column(String(200))
