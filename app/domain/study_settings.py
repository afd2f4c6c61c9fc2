"""What an experimenter decides about a study before its first participant."""

from pydantic import BaseModel, ConfigDict, Field, model_validator

from app.domain.choices import ClipQuality, Method, RewardKind, Strategy
from app.domain.protocol import (
    PAPER_DEMOGRAPHICS,
    USUAL_QUESTIONNAIRE,
    Advisor,
    EvaluationSettings,
    FormItem,
    Language,
    PlannedTest,
)


class StudySettings(BaseModel):
    """What an experimenter decides before the first participant. Frozen per study."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    labels_per_participant: int = Field(default=200, ge=10, le=1000)
    retrain_every_labels: int = Field(default=10, ge=1, le=100)
    filter_milestones: tuple[int, ...] = Field(default=(50, 100), description="Label counts; the end is implied.")
    clip_steps: int = Field(
        default=60,
        ge=20,
        le=130,
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
