"""The blinded evaluation: which letter hides which method, what was shown or run, and how it was rated."""

from datetime import datetime
from enum import StrEnum
from typing import Any

from pydantic import BaseModel, ConfigDict, Field
from sqlalchemy import CheckConstraint, ForeignKey, String, UniqueConstraint
from sqlalchemy.orm import Mapped, mapped_column, relationship

from app.db import Base, now


class Film(Base):
    """One method in one unseen scenario, for one participant, as a video."""

    __tablename__ = "film"
    __table_args__ = (UniqueConstraint("participant_id", "method", "model_id", "scenario"),)

    id: Mapped[int] = mapped_column(primary_key=True)
    participant_id: Mapped[int] = mapped_column(ForeignKey("participant.id"), index=True)
    method: Mapped[str] = mapped_column(String(40))
    """One of protocol.EvaluatedMethod."""
    model_id: Mapped[int | None] = mapped_column(ForeignKey("model.id"), index=True)
    """None for the reference policy, which nobody has trained."""
    scenario: Mapped[int]
    success: Mapped[bool]
    trajectory_sha256: Mapped[str] = mapped_column(String(64))
    video_sha256: Mapped[str] = mapped_column(String(64), index=True)
    poster_sha256: Mapped[str] = mapped_column(String(64), index=True)
    width: Mapped[int]
    height: Mapped[int]
    fps: Mapped[int]
    duration_ms: Mapped[int]
    byte_count: Mapped[int]
    created_at: Mapped[datetime] = mapped_column(default=now)


class Controller(Base):
    """One method as a file that runs on a robot, named by its letter and by nothing else."""

    __tablename__ = "controller"
    __table_args__ = (UniqueConstraint("participant_id", "method"),)

    id: Mapped[int] = mapped_column(primary_key=True)
    participant_id: Mapped[int] = mapped_column(ForeignKey("participant.id"), index=True)
    method: Mapped[str] = mapped_column(String(40))
    model_id: Mapped[int | None] = mapped_column(ForeignKey("model.id"), index=True)
    artefact_sha256: Mapped[str] = mapped_column(String(64))
    byte_count: Mapped[int]
    created_at: Mapped[datetime] = mapped_column(default=now)


class Assignment(Base):
    """Which letter a method has for one participant; drawn by the server, balanced over participants."""

    __tablename__ = "assignment"
    __table_args__ = (
        UniqueConstraint("participant_id", "letter", name="uq_assignment_letter"),
        UniqueConstraint("participant_id", "method", name="uq_assignment_method"),
    )

    id: Mapped[int] = mapped_column(primary_key=True)
    participant_id: Mapped[int] = mapped_column(ForeignKey("participant.id"), index=True)
    letter: Mapped[str] = mapped_column(String(1))
    method: Mapped[str] = mapped_column(String(40))
    created_at: Mapped[datetime] = mapped_column(default=now)


class DonorRule(StrEnum):
    """By which rule it was drawn whose filter somebody is shown as a method that is not theirs."""

    BY_LOT = "by_lot"
    """One of the candidates, none of whom is lent much more often than another."""
    MEAN_OF_PEOPLE = "mean_of_people"
    """All candidates together."""
    TYPE_OF_USER = "type_of_user"
    """Nobody was there yet who had not been lent twice: one of the types of users, by lot in the same way."""
    MEAN_OF_TYPES = "mean_of_types"
    """Too few people were there yet: all types of users together."""
    WITHDREW = "withdrew"
    """Drawn once, but the donor has withdrawn since, and nothing says any more who it was."""


class Donors(BaseModel):
    """Whose filter it is, and whose it could have been: people by their number in the study, types by their name."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    people: tuple[int, ...] = Field(default=(), max_length=100_000)
    types: tuple[str, ...] = Field(default=(), max_length=100)
    candidates: tuple[int, ...] = Field(default=(), max_length=100_000)

    @property
    def share_a_filter(self) -> bool:
        """Whether one is fitted to their wishes; a person's own is there already."""
        return bool(self.types) or len(self.people) > 1

    @property
    def without_candidates(self) -> "Donors":
        """Whose filter it is, and nothing else."""
        return Donors(people=self.people, types=self.types)

    def without(self, number: int) -> "Donors":
        """The same after somebody has withdrawn."""
        people, candidates = (
            tuple(each for each in group if each != number) for group in (self.people, self.candidates)
        )
        return Donors(people=people, types=self.types, candidates=candidates)


class DonorDraw(Base):
    """What one participant is shown of others: drawn once per method, and kept.

    Numbers instead of foreign keys: the row is about whoever is shown the robot.
    """

    __tablename__ = "donor_draw"
    __table_args__ = (UniqueConstraint("participant_id", "method"),)

    id: Mapped[int] = mapped_column(primary_key=True)
    participant_id: Mapped[int] = mapped_column(ForeignKey("participant.id"), index=True)
    method: Mapped[str] = mapped_column(String(40))
    """One of protocol.FROM_OTHERS."""
    rule: Mapped[str] = mapped_column(String(20))
    """One of DonorRule."""
    stored_donors: Mapped[dict[str, Any]]
    created_at: Mapped[datetime] = mapped_column(default=now)

    @property
    def donors(self) -> Donors:
        """Who, validated."""
        return Donors.model_validate(self.stored_donors)


class SharedFilter(Base):
    """A filter fitted to the wishes of several people or types of users, once for everybody in a study who is shown it.

    Not in archives: it is fitted again where it is needed.
    """

    __tablename__ = "shared_filter"

    id: Mapped[int] = mapped_column(primary_key=True)
    study_id: Mapped[int] = mapped_column(ForeignKey("study.id"), index=True)
    stored_donors: Mapped[dict[str, Any]]
    asked_at: Mapped[datetime] = mapped_column(default=now)
    artefact_sha256: Mapped[str | None] = mapped_column(String(64))
    """The controller; None while it is not fitted."""
    metrics: Mapped[dict[str, Any] | None]
    """What is to be said about it, as of a Model; None while it is not fitted."""

    @property
    def donors(self) -> Donors:
        """To whose wishes it is fitted, validated."""
        return Donors.model_validate(self.stored_donors)


class Trial(Base):
    """One execution to be rated. Trials are shown in the order of their ordinals."""

    __tablename__ = "trial"
    __table_args__ = (UniqueConstraint("participant_id", "ordinal"),)

    id: Mapped[int] = mapped_column(primary_key=True)
    participant_id: Mapped[int] = mapped_column(ForeignKey("participant.id"), index=True)
    ordinal: Mapped[int]
    letter: Mapped[str] = mapped_column(String(1))
    repetition: Mapped[int]
    scenario: Mapped[int]
    film_id: Mapped[int | None] = mapped_column(ForeignKey("film.id"), index=True)
    """In video mode, once it is rendered."""
    shown_at: Mapped[datetime | None]
    started_at: Mapped[datetime | None]
    """In physical mode: when the operator started the robot."""
    finished_at: Mapped[datetime | None]
    """In physical mode: when the operator said that it is done."""

    film: Mapped[Film | None] = relationship(lazy="raise")


LONGEST_REASON = 1000
"""Characters of what somebody writes about one trial or one head-to-head."""


class Rating(Base):
    """What was said about a trial, 1 to 5. Append-only: the highest revision counts."""

    __tablename__ = "rating"
    __table_args__ = (
        UniqueConstraint("trial_id", "revision"),
        CheckConstraint("satisfaction BETWEEN 1 AND 5", name="satisfaction_from_1_to_5"),
        CheckConstraint("personalisation BETWEEN 1 AND 5", name="personalisation_from_1_to_5"),
    )

    id: Mapped[int] = mapped_column(primary_key=True)
    trial_id: Mapped[int] = mapped_column(ForeignKey("trial.id"), index=True)
    revision: Mapped[int]
    satisfaction: Mapped[int]
    personalisation: Mapped[int]
    client_uuid: Mapped[str] = mapped_column(String(36), unique=True)
    response_time_ms: Mapped[int | None]
    by_script: Mapped[bool | None]
    """Whether the page's script sent it, and so saw to it that the film had been shown; None: it was not noted yet."""
    reason: Mapped[str | None] = mapped_column(String(LONGEST_REASON))
    """In their own words; None: not asked, or left empty."""
    created_at: Mapped[datetime] = mapped_column(default=now)


class HeadToHeadResponse(StrEnum):
    """Which of two robots somebody would rather have."""

    LEFT = "left"
    RIGHT = "right"
    EQUAL = "equal"


class HeadToHead(Base):
    """Two trials of different methods in one scenario, to be shown side by side once all are rated."""

    __tablename__ = "head_to_head"
    __table_args__ = (UniqueConstraint("participant_id", "ordinal"),)

    id: Mapped[int] = mapped_column(primary_key=True)
    participant_id: Mapped[int] = mapped_column(ForeignKey("participant.id"), index=True)
    ordinal: Mapped[int]
    left_trial_id: Mapped[int] = mapped_column(ForeignKey("trial.id"), index=True)
    right_trial_id: Mapped[int] = mapped_column(ForeignKey("trial.id"), index=True)
    shown_at: Mapped[datetime | None]

    left_trial: Mapped[Trial] = relationship(lazy="raise", foreign_keys=left_trial_id)
    right_trial: Mapped[Trial] = relationship(lazy="raise", foreign_keys=right_trial_id)


class HeadToHeadAnswer(Base):
    """Which of the two somebody would rather have. Append-only: the highest revision counts."""

    __tablename__ = "head_to_head_answer"
    __table_args__ = (UniqueConstraint("head_to_head_id", "revision"),)

    id: Mapped[int] = mapped_column(primary_key=True)
    head_to_head_id: Mapped[int] = mapped_column(ForeignKey("head_to_head.id"), index=True)
    revision: Mapped[int]
    response: Mapped[str] = mapped_column(String(8))
    """One of HeadToHeadResponse."""
    reason: Mapped[str | None] = mapped_column(String(LONGEST_REASON))
    """In their own words; None: not asked, or left empty."""
    client_uuid: Mapped[str] = mapped_column(String(36), unique=True)
    response_time_ms: Mapped[int | None]
    by_script: Mapped[bool]
    """Whether the page's script sent it, and so saw to it that both films had been shown."""
    created_at: Mapped[datetime] = mapped_column(default=now)
