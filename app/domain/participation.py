"""What one person has done besides comparing: stages, consent, forms, their arm, and what happened on the way."""

from datetime import datetime
from typing import Any

from sqlalchemy import ForeignKey, String, Text, UniqueConstraint
from sqlalchemy.orm import Mapped, mapped_column

from app.db import Base, now


class StageRecord(Base):
    """When a participant came into a stage and when they were through with it."""

    __tablename__ = "stage_record"
    __table_args__ = (UniqueConstraint("participant_id", "stage"),)

    id: Mapped[int] = mapped_column(primary_key=True)
    participant_id: Mapped[int] = mapped_column(ForeignKey("participant.id"), index=True)
    stage: Mapped[str] = mapped_column(String(20))
    """One of protocol.Stage."""
    entered_at: Mapped[datetime] = mapped_column(default=now)
    finished_at: Mapped[datetime | None]


class ConsentRecord(Base):
    """What exactly somebody agreed to. Append-only."""

    __tablename__ = "consent_record"

    id: Mapped[int] = mapped_column(primary_key=True)
    participant_id: Mapped[int] = mapped_column(ForeignKey("participant.id"), index=True)
    version: Mapped[str] = mapped_column(String(40))
    language: Mapped[str] = mapped_column(String(8))
    text: Mapped[str] = mapped_column(Text)
    """As it was shown, word for word."""
    agreed_at: Mapped[datetime] = mapped_column(default=now)


class FormAnswer(Base):
    """One answer to one item of a form. Append-only: the newest of an item counts."""

    __tablename__ = "form_answer"

    id: Mapped[int] = mapped_column(primary_key=True)
    participant_id: Mapped[int] = mapped_column(ForeignKey("participant.id"), index=True)
    form: Mapped[str] = mapped_column(String(20))
    """demographics, questionnaire, or the name of a standard questionnaire (app.questionnaires)"""
    letter: Mapped[str | None] = mapped_column(String(1))
    """The robot of the blinded evaluation that it is about; None: about none."""
    item: Mapped[str] = mapped_column(String(40))
    value: Mapped[str | None] = mapped_column(Text)
    """None: left out on purpose."""
    created_at: Mapped[datetime] = mapped_column(default=now)


class ParticipantEvent(Base):
    """Something that happened in somebody's browser: a break, a hidden page, a clip that would not play."""

    __tablename__ = "participant_event"

    id: Mapped[int] = mapped_column(primary_key=True)
    participant_id: Mapped[int] = mapped_column(ForeignKey("participant.id"), index=True)
    at: Mapped[datetime] = mapped_column(default=now)
    kind: Mapped[str] = mapped_column(String(40))
    detail: Mapped[dict[str, Any]]


class Allocation(Base):
    """How somebody came into their arm (participant.arm): the counts then, and the lot. Written once."""

    __tablename__ = "allocation"

    id: Mapped[int] = mapped_column(primary_key=True)
    participant_id: Mapped[int] = mapped_column(ForeignKey("participant.id"), unique=True)
    place: Mapped[int]
    """Among the people of the arm, from 1: decides in which order they meet the methods."""
    lot: Mapped[float]
    """In [0, 1), from the study's secret and the participant's number; picks among the arms that were behind."""
    considered: Mapped[dict[str, Any]]
    """By arm: completed, on_their_way, how many of these were silent, and whether it was open."""
    created_at: Mapped[datetime] = mapped_column(default=now)
