"""What a participant goes through: stages, forms, and the blinded evaluation. Pieces of a study's settings."""

from enum import StrEnum
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator


class Language(StrEnum):
    """In which the participant's pages are written."""

    ENGLISH = "en"
    GERMAN = "de"


class Stage(StrEnum):
    """The participant's way, in this order; a study may leave some out."""

    CONSENT = "consent"
    DEMOGRAPHICS = "demographics"
    INSTRUCTIONS = "instructions"
    PRACTICE = "practice"
    PAIRS = "pairs"
    EVALUATION = "evaluation"
    QUESTIONNAIRE = "questionnaire"
    DEBRIEF = "debrief"


class FormItem(BaseModel):
    """One question of a form. No answer is ever required by us."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str = Field(pattern=r"^[a-z][a-z0-9_]{0,39}$", description="Names the column in exports.")
    kind: Literal["choice", "number", "text", "likert"]
    question: str = Field(default="", max_length=300, description="Empty: the built-in wording of this name.")
    choices: tuple[str, ...] = Field(default=(), max_length=20, description="Of a choice; stored as they are.")
    low_label: str = Field(default="", max_length=80)
    high_label: str = Field(default="", max_length=80)

    @model_validator(mode="after")
    def _choices_to_choose_from(self) -> "FormItem":
        if (self.kind == "choice") != bool(self.choices):
            raise ValueError(f"{self.name}: a choice needs its choices, and nothing else has any.")
        return self


class EvaluatedMethod(StrEnum):
    """What a participant can be asked to rate; names as in the benchmark."""

    REFERENCE = "reference"
    PREFFT = "prefft"
    PREFFT_ANCHORED = "prefft_anchored"
    PBARL = "pbarl"
    PBARL_PRINTED = "pbarl_printed"


class EvaluationMode(StrEnum):
    """Where the robot moves."""

    VIDEO = "video"
    PHYSICAL = "physical"


class EvaluationSettings(BaseModel):
    """The blinded comparison of methods: some trials of each under a letter, each rated from 1 to 5."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    methods: tuple[EvaluatedMethod, ...] = Field(
        default=(EvaluatedMethod.REFERENCE, EvaluatedMethod.PREFFT, EvaluatedMethod.PBARL), min_length=2, max_length=5
    )
    trials: int = Field(default=3, ge=1, le=20, description="Of each method.")
    mode: EvaluationMode = EvaluationMode.VIDEO
    fine_tuning_steps: int = Field(default=100_000, ge=1_000, le=2_000_000, description="Environment steps of PrefFT.")

    @model_validator(mode="after")
    def _each_once(self) -> "EvaluationSettings":
        if len(set(self.methods)) != len(self.methods):
            raise ValueError("Each method can be evaluated once only.")
        return self

    @property
    def trial_count(self) -> int:
        """Trials that one participant rates altogether."""
        return len(self.methods) * self.trials


class Advisor(StrEnum):
    """What becomes of the advice that more labels will hardly pay."""

    SHOW = "show"
    LOG = "log"


class PlannedTest(StrEnum):
    """Tests that a study announces before its data are seen."""

    TWO_SAMPLE_T = "two_sample_t"
    PAIRED_T = "paired_t"
    WILCOXON = "wilcoxon"
    MIXED_MODEL = "mixed_model"


CONSENT_FACTS = ("duration", "payment", "ethics", "contact")
"""What an ethics board asks of a consent text and only the study knows: settings ``consent_duration`` and so on."""

LIKERT_POINTS = 5

PAPER_DEMOGRAPHICS = (
    FormItem(name="age", kind="number"),
    FormItem(name="gender", kind="text"),
    FormItem(name="robot_experience", kind="likert"),
)
"""What the paper reports of its participants, and the usual question of human-robot studies."""

USUAL_QUESTIONNAIRE = (
    FormItem(name="felt_understood", kind="likert"),
    FormItem(name="felt_safe", kind="likert"),
    FormItem(name="would_use", kind="likert"),
    FormItem(name="comments", kind="text"),
)
