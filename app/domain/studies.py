"""Studies, their settings, and the participants in them."""

import secrets
from datetime import datetime
from enum import StrEnum
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, model_validator
from sqlalchemy import ForeignKey, String, Text, UniqueConstraint, false
from sqlalchemy.orm import Mapped, mapped_column, relationship

from app.db import Base, now
from app.domain.protocol import (
    PAPER_DEMOGRAPHICS,
    USUAL_QUESTIONNAIRE,
    Advisor,
    EvaluationSettings,
    FormItem,
    Language,
    PlannedTest,
)
from installed_tasks import catalogue
from installed_tasks.description import LONGEST_CLIP_STEPS, SHORTEST_CLIP_STEPS

USUAL_CLIP_STEPS = 60
"""of a task that is not installed here"""


def longest_clip_steps(task: str) -> int | None:
    """A whole episode of a task; None for one that is not installed here."""
    installed = catalogue.find(task)
    return installed.description.episode_steps if installed else None


def usual_clip_steps(task: str) -> int:
    """Control steps from the start in which what matters in a task has happened."""
    installed = catalogue.find(task)
    return installed.description.usual_clip_steps if installed else USUAL_CLIP_STEPS


class Method(StrEnum):
    """How the personal filter is trained."""

    STUDIO = "studio"
    PRINTED = "printed"


class RewardKind(StrEnum):
    """Which reward model learns from the labels."""

    STRUCTURED = "structured"
    PREDICTED = "predicted"
    MLP = "mlp"
    PREFERENCE_TRANSFORMER = "preference_transformer"


class ClipQuality(StrEnum):
    """How finely clips are drawn."""

    SHARP = "sharp"
    QUICK = "quick"


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
        default=USUAL_CLIP_STEPS,
        ge=SHORTEST_CLIP_STEPS,
        le=LONGEST_CLIP_STEPS,
        description="Control steps shown, from the start (10 Hz).",
    )
    clip_quality: ClipQuality = ClipQuality.SHARP
    pool_scenarios: int = Field(default=48, ge=1, le=500)
    behaviours_per_scenario: int = Field(default=6, ge=2, le=8)
    strategy: Strategy = Strategy.ENTROPY
    random_share: float = Field(default=0.3, ge=0.1, le=1.0, description="Share of queries always drawn uniformly.")
    reward_kind: RewardKind = RewardKind.STRUCTURED
    pooled_prior: bool = Field(default=False, description="Start from earlier participants' weights; structured only.")
    method: Method = Method.STUDIO
    success_tolerance: float = Field(default=0.035, ge=0.0, le=0.5, description="Success the filter may cost.")
    evaluation_scenarios: int = Field(default=100, ge=10, le=1000)
    question: str = Field(default="Which robot would you rather have?", min_length=1, max_length=200)
    consent_version: str = Field(default="1", min_length=1, max_length=40)
    consent_duration: str = Field(default="", max_length=200, description="How long it takes, in the consent text.")
    consent_payment: str = Field(default="", max_length=200, description="What people are given, in the consent text.")
    consent_ethics: str = Field(default="", max_length=200, description="Who approved it and under which number.")
    consent_contact: str = Field(default="", max_length=200, description="Whom to ask, in the consent text.")
    language: Language = Language.ENGLISH
    languages: tuple[Language, ...] = Field(default=tuple(Language), description="In which the pages may be read.")
    wording: dict[str, str] = Field(default_factory=dict, description="Texts of the pages in the study's own words.")
    demographics: tuple[FormItem, ...] = ()
    practice_pairs: int = Field(default=0, ge=0, le=5, description="Before the first label; never learned from.")
    introduction_pairs: int = Field(default=0, ge=0, le=50, description="First labels, on whole trajectories.")
    repeated_pairs: int = Field(default=0, ge=0, le=100, description="Asked again later; never learned from.")
    catch_pairs: int = Field(default=0, ge=0, le=20, description="With an obvious answer; never learned from.")
    break_every: int = Field(default=50, ge=0, le=500, description="Answers between two break screens; 0: none.")
    answer_after_first_play: bool = Field(default=True, description="Answers open when both clips were seen once.")
    evaluation: EvaluationSettings | None = None
    questionnaire: tuple[FormItem, ...] = ()
    debrief: bool = Field(default=False, description="Show the person's own robot before and after, at the end.")
    completion_code: str = Field(default="", max_length=80)
    return_url: str = Field(default="", max_length=500, pattern=r"^(https?://\S+)?$")
    panel_parameter: str = Field(
        default="PROLIFIC_PID",
        pattern=r"^([A-Za-z][A-Za-z0-9_]{0,39})?$",
        description="Names the person in the address of a recruitment panel; empty: anybody may join without a name.",
    )
    advisor: Advisor = Advisor.SHOW
    planned_tests: tuple[PlannedTest, ...] = (PlannedTest.PAIRED_T,)

    @model_validator(mode="after")
    def _enough_pairs(self) -> "StudySettings":
        pairs = self.pool_scenarios * self.pairs_per_scenario
        short = self.labels_per_participant - self.introduction_count + self.practice_pairs + self.catch_pairs
        if pairs < max(self.labels_per_participant, short):
            also = "" if pairs < self.labels_per_participant else " with practice and catch pairs"
            raise ValueError(
                f"{self.pool_scenarios} scenarios with {self.behaviours_per_scenario} behaviours give "
                f"{pairs} different pairs, fewer than the "
                f"{max(self.labels_per_participant, short)} labels asked for{also}. Add scenarios or behaviours."
            )
        return self

    @property
    def offered_languages(self) -> tuple[Language, ...]:
        """Languages people may choose from: the study's own first, which is always one of them."""
        return (self.language, *(each for each in Language if each in self.languages and each != self.language))

    @property
    def pairs_per_scenario(self) -> int:
        """Different pairs of clips of one scenario."""
        return self.behaviours_per_scenario * (self.behaviours_per_scenario - 1) // 2

    @property
    def introduction_count(self) -> int:
        """Labels on whole trajectories; never more than there are labels."""
        return min(self.introduction_pairs, self.labels_per_participant)

    @property
    def introduction_scenarios(self) -> int:
        """As many scenarios are filmed whole as the introduction needs."""
        return -(-self.introduction_count // self.pairs_per_scenario)

    @property
    def question_count(self) -> int:
        """Pairs a participant answers altogether: labels, repeats and catch pairs; practice not counted."""
        return self.labels_per_participant + self.repeated_pairs + self.catch_pairs

    @property
    def milestones(self) -> tuple[int, ...]:
        """Label counts at which a filter is trained, ascending, the last label included."""
        early = {count for count in self.filter_milestones if 0 < count < self.labels_per_participant}
        return (*sorted(early), self.labels_per_participant)


PAPER_PROTOCOL = StudySettings(
    strategy=Strategy.UNIFORM,
    demographics=PAPER_DEMOGRAPHICS,
    practice_pairs=1,
    introduction_pairs=10,
    evaluation=EvaluationSettings(),
    questionnaire=USUAL_QUESTIONNAIRE,
    debrief=True,
    advisor=Advisor.LOG,
    planned_tests=(PlannedTest.TWO_SAMPLE_T, PlannedTest.PAIRED_T, PlannedTest.MIXED_MODEL),
)
"""The user study of the paper: 10 + 190 labels, three methods, three trials each. The default of everything else."""


def new_key_secret() -> str:
    """What the letters of a study's blinded evaluation are drawn from; nobody can guess it."""
    return secrets.token_hex(32)


class Study(Base):
    """One experiment: a task, its settings, its pool of clips and its participants."""

    __tablename__ = "study"

    id: Mapped[int] = mapped_column(primary_key=True)
    slug: Mapped[str] = mapped_column(String(80), unique=True)
    name: Mapped[str] = mapped_column(String(120))
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


class Awaited(StrEnum):
    """What a waiting page waits for."""

    PAIR = "pair"
    ROBOTS = "robots"
    DEBRIEF = "debrief"


class Participant(Base):
    """One person in one study, known by a code. The link's token is stored only as a hash."""

    __tablename__ = "participant"
    __table_args__ = (
        UniqueConstraint("study_id", "number"),
        UniqueConstraint("study_id", "panel_id", name="uq_participant_panel_id"),
    )

    id: Mapped[int] = mapped_column(primary_key=True)
    study_id: Mapped[int] = mapped_column(ForeignKey("study.id"), index=True)
    number: Mapped[int]
    token_sha256: Mapped[str] = mapped_column(String(64), unique=True)
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
    scripted_as: Mapped[str | None] = mapped_column(String(120))
    """The user a program plays here, such as "cautious"; None: a person."""
    completed_at: Mapped[datetime | None]
    withdrawn_at: Mapped[datetime | None]
    """Everything else about the person is erased then; this row stays as the tombstone."""
    erased_at: Mapped[datetime | None]
    """When the worker had removed the last traces as well: its own notes, late results, freed pages of databases."""

    study: Mapped[Study] = relationship(lazy="raise")

    @property
    def code(self) -> str:
        """The name used on pages and in files, such as P07; those of previews begin at PREVIEW_NUMBERS."""
        return f"P{self.number:02d}"
