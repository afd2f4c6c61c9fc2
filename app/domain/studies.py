"""Studies and the participants in them."""

import secrets
from datetime import datetime
from enum import StrEnum
from typing import Any

from sqlalchemy import ForeignKey, String, Text, UniqueConstraint, false
from sqlalchemy.orm import Mapped, mapped_column, relationship

from app.db import Base, now
from app.domain.study_settings import StudySettings
from app.installed_tasks import catalogue
from app.installed_tasks.by_name import control_rate_hz, longest_clip_steps

NAME_LENGTH = 120
SEED_LIMIT = 2**31
"""Seeds of studies are smaller."""


def new_key_secret() -> str:
    """What the letters of a study's blinded evaluation are drawn from; nobody can guess it."""
    return secrets.token_hex(32)


class Study(Base):
    """One experiment: a task, its settings, its pool of clips and its participants."""

    __tablename__ = "study"

    id: Mapped[int] = mapped_column(primary_key=True)
    slug: Mapped[str] = mapped_column(String(80), unique=True)
    name: Mapped[str] = mapped_column(String(NAME_LENGTH))
    task: Mapped[str] = mapped_column(String(40), default=catalogue.usual)
    stored_settings: Mapped[dict[str, Any]]
    seed: Mapped[int]
    created_at: Mapped[datetime] = mapped_column(default=now)
    join_token: Mapped[str | None] = mapped_column(String(64), unique=True)
    """Part of the address by which anybody may join, as recruitment panels need it; None: by invitation only."""
    material: Mapped[dict[str, Any] | None]
    """What imported clips are made of (names of signals, rates); None when the clips are simulated here."""
    locked_at: Mapped[datetime | None]
    lock_hash: Mapped[str | None] = mapped_column(String(64))
    lock_document: Mapped[dict[str, Any] | None]
    """Settings, plan of pairs, stop rule and planned tests as they were locked; lock_hash is the hash of this."""
    unblinded_at: Mapped[datetime | None]
    key_secret: Mapped[str] = mapped_column(String(64), default=new_key_secret)
    """Decides which letter hides which method. Shown to nobody before the study is unblinded."""
    mode_axes: Mapped[dict[str, Any] | None]
    """The ways in which the task's executions differ, as the worker knows them: name -> [low, high], in their order; 0
    is the reference policy's own way. None until the first preview is filmed."""
    put_away_at: Mapped[datetime | None]
    """Since then the study is not in the list, takes nobody in, and the worker does nothing for it."""
    deleted_at: Mapped[datetime | None]
    """Everybody in it is erased then; this row stays until the worker has removed the last traces, see erased_at."""
    erased_at: Mapped[datetime | None]

    @property
    def settings(self) -> StudySettings:
        """The settings, validated."""
        return StudySettings.model_validate(self.stored_settings)

    @property
    def whole_clip_steps(self) -> int | None:
        """Steps of a clip of a whole episode; None for a task that is not installed here."""
        return longest_clip_steps(self.task)

    @property
    def clip_s(self) -> float:
        """How long a clip plays, in seconds."""
        return self.settings.clip_steps / control_rate_hz(self.task)


class Deviation(Base):
    """A change to a locked study, kept with its reason and listed in every export."""

    __tablename__ = "deviation"

    id: Mapped[int] = mapped_column(primary_key=True)
    study_id: Mapped[int] = mapped_column(ForeignKey("study.id"), index=True)
    at: Mapped[datetime] = mapped_column(default=now)
    actor: Mapped[str] = mapped_column(String(80))
    reason: Mapped[str] = mapped_column(Text)
    before: Mapped[dict[str, Any]]
    after: Mapped[dict[str, Any]]


PREVIEW_NUMBERS = 900_000
"""Previews are counted from here, so that they take no participant's number: the numbers balance the evaluation."""


def code_of(number: int) -> str:
    """What the participant of this number is called on pages and in files, such as P07."""
    return f"P{number:02d}"


class Awaited(StrEnum):
    """What a waiting page waits for."""

    PAIR = "pair"
    PREVIEW = "preview"
    ROBOTS = "robots"
    DEBRIEF = "debrief"


class Participant(Base):
    """One person in one study, known by a code. The link's token is stored only as a hash."""

    __tablename__ = "participant"
    __table_args__ = (
        UniqueConstraint("study_id", "number"),
        UniqueConstraint("study_id", "panel_id", name="uq_participant_panel_id"),
        UniqueConstraint("earlier_id", name="uq_participant_earlier_id"),
    )

    id: Mapped[int] = mapped_column(primary_key=True)
    study_id: Mapped[int] = mapped_column(ForeignKey("study.id"), index=True)
    number: Mapped[int]
    token_sha256: Mapped[str] = mapped_column(String(64), unique=True)
    link_revoked_at: Mapped[datetime | None]
    """Since then the link leads to a page that says so, until a new one is made."""
    seed: Mapped[int]
    created_at: Mapped[datetime] = mapped_column(default=now)
    last_seen_at: Mapped[datetime | None]
    waiting_for: Mapped[str | None] = mapped_column(String(20))
    """One of Awaited while the page they looked at last was a waiting page; last_seen_at says whether they still do."""
    waiting_since: Mapped[datetime | None]
    consented_at: Mapped[datetime | None]
    consent_version: Mapped[str | None] = mapped_column(String(40))
    instructed_at: Mapped[datetime | None]
    language: Mapped[str | None] = mapped_column(String(8))
    """The person's own choice; None: the study's."""
    panel_id: Mapped[str | None] = mapped_column(String(120))
    """Who this is at the recruitment panel; the same id comes back to the same participant."""
    panel_parameters: Mapped[dict[str, Any] | None]
    is_preview: Mapped[bool] = mapped_column(default=False, server_default=false())
    """An experimenter looking at the study as a participant would: counted, exported and learned from nowhere."""
    visit: Mapped[int] = mapped_column(default=1, server_default="1")
    """1 for whoever is new, one more with every study that goes on from another one."""
    earlier_id: Mapped[int | None] = mapped_column(ForeignKey("participant.id"))
    """Who this person was at the visit before, in another study: what they answered there is learned from as well."""
    scripted_as: Mapped[str | None] = mapped_column(String(120))
    """The user a program plays here, such as "cautious"; None: a person."""
    completed_at: Mapped[datetime | None]
    arm: Mapped[str | None] = mapped_column(String(40))
    """Of a study between subjects, once they were allocated (designs.Allocation says how)."""
    ended_as: Mapped[str | None] = mapped_column(String(20))
    """One of designs.Ending: thanked and sent back before the end."""
    withdrawn_at: Mapped[datetime | None]
    """Everything else about the person is erased then; this row stays as the tombstone."""
    erased_at: Mapped[datetime | None]
    """When the worker had removed the last traces as well: its own notes, late results, freed pages of databases."""

    study: Mapped[Study] = relationship(lazy="raise")

    @property
    def settings(self) -> StudySettings:
        """The study's, as they hold in this person's arm; the study is loaded."""
        return self.study.settings.in_arm(self.arm)

    @property
    def code(self) -> str:
        """The name used on pages and in files, such as P07; those of previews begin at PREVIEW_NUMBERS."""
        return code_of(self.number)
