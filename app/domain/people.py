"""Experimenters, members of studies, browser sessions of everybody, the audit log, and receipts of what was erased."""

from datetime import datetime
from enum import StrEnum
from typing import Any

from sqlalchemy import CheckConstraint, ForeignKey, Index, String, Text, UniqueConstraint, false
from sqlalchemy.orm import Mapped, mapped_column

from app.db import Base, now


class Role(StrEnum):
    """What an experimenter may do; each may do what the next one may."""

    ADMINISTRATOR = "administrator"
    """Accounts, and everything in every study."""
    EXPERIMENTER = "experimenter"
    """Make studies; in those of others, what their role as a member is."""
    READER = "reader"
    """Look at the studies they are a member of, and nothing else."""


class StudyRole(StrEnum):
    """What a member of a study may do in it; each may do what the next one may."""

    OWNER = "owner"
    """Members, deleting the study, and everything below."""
    EDITOR = "editor"
    """Settings, participants, locking, unblinding, exports."""
    VIEWER = "viewer"
    """Look, and nothing else."""


class Experimenter(Base):
    """A researcher with an account."""

    __tablename__ = "experimenter"

    id: Mapped[int] = mapped_column(primary_key=True)
    name: Mapped[str] = mapped_column(String(80), unique=True)
    password_hash: Mapped[str] = mapped_column(String(200))
    must_change_password: Mapped[bool] = mapped_column(default=True)
    role: Mapped[str] = mapped_column(String(20), default=Role.ADMINISTRATOR, server_default=Role.ADMINISTRATOR)
    created_at: Mapped[datetime] = mapped_column(default=now)
    disabled_at: Mapped[datetime | None]
    """No login and no token of this account is good any more."""
    oidc_subject: Mapped[str | None] = mapped_column(String(500), unique=True)
    """Issuer and subject of the identity that logs in to this account; None: its password does."""
    totp_secret: Mapped[str | None] = mapped_column(String(64))
    """Shared with an authenticator app. It cannot be a hash, as codes are computed from it, so it is encrypted."""
    second_factor_since: Mapped[datetime | None]
    """When the first code was right: since then a login needs one. None with a secret: it is still being set up."""
    totp_used_step: Mapped[int | None]
    """The 30 s of the newest code that was used: neither it nor an older one is good again."""
    wrong_codes: Mapped[int] = mapped_column(default=0, server_default="0")
    """Since the last right one."""
    code_wrong_at: Mapped[datetime | None]


class StudyMember(Base):
    """An experimenter who may work in a study, or look at it. Administrators may without being one."""

    __tablename__ = "study_member"
    __table_args__ = (UniqueConstraint("study_id", "experimenter_id"),)

    id: Mapped[int] = mapped_column(primary_key=True)
    study_id: Mapped[int] = mapped_column(ForeignKey("study.id"))
    experimenter_id: Mapped[int] = mapped_column(ForeignKey("experimenter.id"), index=True)
    role: Mapped[str] = mapped_column(String(20))
    added_at: Mapped[datetime] = mapped_column(default=now)


class RecoveryCode(Base):
    """Instead of a code of the authenticator app, once. Shown once; only the hash is stored."""

    __tablename__ = "recovery_code"

    id: Mapped[int] = mapped_column(primary_key=True)
    experimenter_id: Mapped[int] = mapped_column(ForeignKey("experimenter.id"), index=True)
    code_sha256: Mapped[str] = mapped_column(String(64))
    used_at: Mapped[datetime | None]


class TokenScope(StrEnum):
    """What a token may at most do."""

    READ = "read"
    WRITE = "write"
    """Everything that its account may."""


class ApiToken(Base):
    """A key to the API, with the rights of its experimenter or fewer. Shown once; only the hash is stored."""

    __tablename__ = "api_token"

    id: Mapped[int] = mapped_column(primary_key=True)
    experimenter_id: Mapped[int] = mapped_column(ForeignKey("experimenter.id"), index=True)
    name: Mapped[str] = mapped_column(String(80))
    token_sha256: Mapped[str] = mapped_column(String(64), unique=True)
    scope: Mapped[str] = mapped_column(String(10), default=TokenScope.WRITE, server_default=TokenScope.WRITE)
    study_id: Mapped[int | None] = mapped_column(ForeignKey("study.id"), index=True)
    """The only study it opens; None: all of the account's."""
    expires_at: Mapped[datetime | None]
    """None: of before tokens expired."""
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
    browser: Mapped[str | None] = mapped_column(String(80))
    """Of an experimenter, in words such as "Firefox on Linux", so that they recognise where they are logged in."""
    second_factor_due: Mapped[bool] = mapped_column(default=False, server_default=false())
    """The password was right, and that is all so far: such a session opens the form for the code and nothing else."""


class NewLinks(Base):
    """Personal links between the form that made them and the page that shows them, for some minutes.

    Sealed with a key that is in the address of that page and nowhere else, so the database alone knows no link.
    """

    __tablename__ = "new_links"

    id: Mapped[int] = mapped_column(primary_key=True)
    key_sha256: Mapped[str] = mapped_column(String(64), unique=True)
    experimenter_id: Mapped[int] = mapped_column(ForeignKey("experimenter.id"))
    sealed: Mapped[str] = mapped_column(Text)
    expires_at: Mapped[datetime]


class LoginAttempt(Base):
    """One attempt to get in that was let through, for a minute: several web servers share their limits."""

    __tablename__ = "login_attempt"

    id: Mapped[int] = mapped_column(primary_key=True)
    at: Mapped[datetime] = mapped_column(default=now)
    kind: Mapped[str] = mapped_column(String(20))
    address_sha256: Mapped[str] = mapped_column(String(64))
    account_sha256: Mapped[str] = mapped_column(String(64))
    browser_sha256: Mapped[str | None] = mapped_column(String(64))


class AuditEvent(Base):
    """One act worth remembering; append-only, and chained: app.services.audit says how."""

    __tablename__ = "audit_event"
    __table_args__ = (
        Index("ix_audit_event_actor_action_subject", "actor", "action", "subject"),
        Index("ix_audit_event_action", "action"),
    )

    id: Mapped[int] = mapped_column(primary_key=True)
    """One more than the newest row's; part of what is hashed, so two writers cannot both follow the same row."""
    at: Mapped[datetime] = mapped_column(default=now)
    actor: Mapped[str] = mapped_column(String(80))
    action: Mapped[str] = mapped_column(String(80))
    subject: Mapped[str | None] = mapped_column(String(200))
    """None: it told of somebody whose data are erased."""
    study_id: Mapped[int | None] = mapped_column(index=True)
    participant_id: Mapped[int | None] = mapped_column(index=True)
    """Whom the subject tells of. No foreign keys: rows outlive what they tell of."""
    subject_salt: Mapped[str | None] = mapped_column(String(32))
    """Erased with the subject: without it nobody can find the subject by trying likely ones against its hash."""
    subject_hash: Mapped[str] = mapped_column(String(64))
    previous_hash: Mapped[str] = mapped_column(String(64))
    row_hash: Mapped[str] = mapped_column(String(64))


class ErasureReceipt(Base):
    """One step of erasing a person or a study: what went, by kind and number. Nothing in it identifies anybody."""

    __tablename__ = "erasure_receipt"

    id: Mapped[int] = mapped_column(primary_key=True)
    at: Mapped[datetime] = mapped_column(default=now)
    study_id: Mapped[int] = mapped_column(index=True)
    participant_id: Mapped[int | None]
    """Leads to the tombstone, and is not in what is handed out. None: the whole study, with everybody in it."""
    contents: Mapped[dict[str, Any]]
