"""Rollouts that are compared, of a study's pool or made for one person, and the videos made of them."""

from datetime import datetime
from typing import Any

from sqlalchemy import ForeignKey, String, UniqueConstraint
from sqlalchemy.orm import Mapped, mapped_column, relationship

from app.db import Base, now


class Rollout(Base):
    """One simulated episode: a scenario executed in one behaviour."""

    __tablename__ = "rollout"
    __table_args__ = (UniqueConstraint("study_id", "scenario", "behaviour"),)

    id: Mapped[int] = mapped_column(primary_key=True)
    study_id: Mapped[int] = mapped_column(ForeignKey("study.id"), index=True)
    participant_id: Mapped[int | None] = mapped_column(ForeignKey("participant.id"), index=True)
    """For whom alone it was made, after their answers; None: it is of the pool."""
    scenario: Mapped[int]
    behaviour: Mapped[int]
    mode: Mapped[dict[str, Any]]
    trajectory_sha256: Mapped[str] = mapped_column(String(64))
    success: Mapped[bool]
    created_at: Mapped[datetime] = mapped_column(default=now)


class Clip(Base):
    """The video of one segment: steps first_step .. first_step + step_count of a rollout."""

    __tablename__ = "clip"
    __table_args__ = (UniqueConstraint("rollout_id", "first_step", "step_count"),)

    id: Mapped[int] = mapped_column(primary_key=True)
    rollout_id: Mapped[int] = mapped_column(ForeignKey("rollout.id"), index=True)
    first_step: Mapped[int]
    step_count: Mapped[int]
    video_sha256: Mapped[str] = mapped_column(String(64), index=True)
    poster_sha256: Mapped[str] = mapped_column(String(64), index=True)
    width: Mapped[int]
    height: Mapped[int]
    fps: Mapped[int]
    duration_ms: Mapped[int]
    byte_count: Mapped[int]
    created_at: Mapped[datetime] = mapped_column(default=now)

    rollout: Mapped[Rollout] = relationship(lazy="raise")
