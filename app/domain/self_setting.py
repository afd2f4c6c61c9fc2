"""The robot that a participant sets with sliders: every setting they let go of, and the films that follow it."""

from datetime import datetime
from typing import Any

from sqlalchemy import ForeignKey, String, UniqueConstraint
from sqlalchemy.orm import Mapped, mapped_column

from app.db import Base, now


class SelfSetting(Base):
    """One setting of all sliders. Append-only: the highest revision counts, once the stage is finished."""

    __tablename__ = "self_setting"
    __table_args__ = (UniqueConstraint("participant_id", "revision"),)

    id: Mapped[int] = mapped_column(primary_key=True)
    participant_id: Mapped[int] = mapped_column(ForeignKey("participant.id"), index=True)
    revision: Mapped[int]
    mode: Mapped[dict[str, Any]]
    """The value of every axis by its name, in the axis' own unit."""
    moved: Mapped[str | None] = mapped_column(String(60))
    """The axis whose slider was let go of; None: nothing was moved since the last revision, or no script ran."""
    filmed: Mapped[bool]
    """Whether a film of exactly this setting could be shown when it was saved."""
    client_uuid: Mapped[str] = mapped_column(String(36), unique=True)
    response_time_ms: Mapped[int | None]
    """From the opening of the page, or the last revision, to this one."""
    by_script: Mapped[bool]
    created_at: Mapped[datetime] = mapped_column(default=now)


class PreviewFilm(Base):
    """One execution mode in the preview's scenario, as a video: made ahead for a study, or for one setting."""

    __tablename__ = "preview_film"
    __table_args__ = (UniqueConstraint("study_id", "self_setting_id", "number"),)

    id: Mapped[int] = mapped_column(primary_key=True)
    study_id: Mapped[int] = mapped_column(ForeignKey("study.id"), index=True)
    self_setting_id: Mapped[int | None] = mapped_column(ForeignKey("self_setting.id"), index=True)
    """For which setting it was made, and so for whom; None: made ahead, for everybody in the study."""
    number: Mapped[int]
    """Place among those made ahead; 0 for one that was asked for."""
    mode: Mapped[dict[str, Any]]
    """The value of every axis by its name."""
    video_sha256: Mapped[str] = mapped_column(String(64), index=True)
    poster_sha256: Mapped[str] = mapped_column(String(64), index=True)
    width: Mapped[int]
    height: Mapped[int]
    fps: Mapped[int]
    duration_ms: Mapped[int]
    byte_count: Mapped[int]
    created_at: Mapped[datetime] = mapped_column(default=now)
