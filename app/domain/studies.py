"""Studies, their settings, and the participants in them."""

from datetime import datetime
from enum import StrEnum
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, model_validator
from sqlalchemy import ForeignKey, String, UniqueConstraint
from sqlalchemy.orm import Mapped, mapped_column, relationship

from app.db import Base, now


class TaskName(StrEnum):
    """What the robot does; the worker simulates the tasks of these names."""

    FEEDING = "feeding"
    DRINKING = "drinking"
    SCRATCHING = "scratching"


USUAL_CLIP_STEPS = {TaskName.FEEDING: 60, TaskName.DRINKING: 70, TaskName.SCRATCHING: 60}
"""Control steps (10 Hz) from the start in which what matters has happened: water is poured late."""
LONGEST_CLIP_STEPS = {TaskName.FEEDING: 100, TaskName.DRINKING: 130, TaskName.SCRATCHING: 100}
"""A whole episode."""


class Method(StrEnum):
    """How the personal filter is trained."""

    STUDIO = "studio"
    PRINTED = "printed"


class RewardKind(StrEnum):
    """Which reward model learns from the labels."""

    STRUCTURED = "structured"
    MLP = "mlp"
    PREFERENCE_TRANSFORMER = "preference_transformer"


class Strategy(StrEnum):
    """How the pairs to compare are chosen."""

    UNIFORM = "uniform"
    DISAGREEMENT = "disagreement"
    ENTROPY = "entropy"
    INFORMATION_GAIN = "information_gain"
    CONTESTED = "contested"


class StudySettings(BaseModel):
    """What an experimenter decides before the first participant. Frozen per study."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    labels_per_participant: int = Field(default=200, ge=10, le=1000)
    retrain_every_labels: int = Field(default=10, ge=1, le=100)
    filter_milestones: tuple[int, ...] = Field(default=(50, 100), description="Label counts; the end is implied.")
    clip_steps: int = Field(
        default=USUAL_CLIP_STEPS[TaskName.FEEDING],
        ge=20,
        le=max(LONGEST_CLIP_STEPS.values()),
        description="Control steps shown, from the start (10 Hz).",
    )
    pool_scenarios: int = Field(default=36, ge=1, le=500)
    behaviours_per_scenario: int = Field(default=4, ge=2, le=8)
    strategy: Strategy = Strategy.UNIFORM
    random_share: float = Field(default=0.5, ge=0.1, le=1.0, description="Share of queries always drawn uniformly.")
    reward_kind: RewardKind = RewardKind.STRUCTURED
    pooled_prior: bool = Field(default=False, description="Start from earlier participants' weights; structured only.")
    method: Method = Method.STUDIO
    success_tolerance: float = Field(default=0.035, ge=0.0, le=0.5, description="Success the filter may cost.")
    evaluation_scenarios: int = Field(default=100, ge=10, le=1000)
    question: str = Field(default="Which robot would you rather have?", min_length=1, max_length=200)
    consent_version: str = Field(default="1", min_length=1, max_length=40)

    @model_validator(mode="after")
    def _enough_pairs(self) -> "StudySettings":
        per_scenario = self.behaviours_per_scenario * (self.behaviours_per_scenario - 1) // 2
        if self.pool_scenarios * per_scenario < self.labels_per_participant:
            raise ValueError(
                f"{self.pool_scenarios} scenarios with {self.behaviours_per_scenario} behaviours give "
                f"{self.pool_scenarios * per_scenario} different pairs, fewer than the "
                f"{self.labels_per_participant} labels asked for. Add scenarios or behaviours."
            )
        return self

    @property
    def milestones(self) -> tuple[int, ...]:
        """Label counts at which a filter is trained, ascending, the last label included."""
        early = {count for count in self.filter_milestones if 0 < count < self.labels_per_participant}
        return (*sorted(early), self.labels_per_participant)


class Study(Base):
    """One experiment: a task, its settings, its pool of clips and its participants."""

    __tablename__ = "study"

    id: Mapped[int] = mapped_column(primary_key=True)
    slug: Mapped[str] = mapped_column(String(80), unique=True)
    name: Mapped[str] = mapped_column(String(120))
    task: Mapped[str] = mapped_column(String(40), default=TaskName.FEEDING)
    stored_settings: Mapped[dict[str, Any]]
    seed: Mapped[int]
    created_at: Mapped[datetime] = mapped_column(default=now)

    @property
    def settings(self) -> StudySettings:
        """The settings, validated."""
        return StudySettings.model_validate(self.stored_settings)


class Participant(Base):
    """One person in one study, known by a code. The link's token is stored only as a hash."""

    __tablename__ = "participant"
    __table_args__ = (UniqueConstraint("study_id", "number"),)

    id: Mapped[int] = mapped_column(primary_key=True)
    study_id: Mapped[int] = mapped_column(ForeignKey("study.id"), index=True)
    number: Mapped[int]
    token_sha256: Mapped[str] = mapped_column(String(64), unique=True)
    seed: Mapped[int]
    created_at: Mapped[datetime] = mapped_column(default=now)
    last_seen_at: Mapped[datetime | None]
    consented_at: Mapped[datetime | None]
    consent_version: Mapped[str | None] = mapped_column(String(40))
    instructed_at: Mapped[datetime | None]

    study: Mapped[Study] = relationship(lazy="raise")

    @property
    def code(self) -> str:
        """The name used on pages and in files, such as P07."""
        return f"P{self.number:02d}"
