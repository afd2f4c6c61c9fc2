"""What a participant goes through: stages, forms, and the blinded evaluation. Pieces of a study's settings."""

from enum import StrEnum
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationInfo, field_validator, model_validator

from app.domain.choices import Choice
from app.domain.described import Section, setting
from app.questionnaires import library


class Language(Choice):
    """In which the participant's pages are written; each is called as it calls itself."""

    ENGLISH = "en", "English"
    GERMAN = "de", "Deutsch"


class Stage(StrEnum):
    """The participant's way, in this order; a study may leave some out."""

    CONSENT = "consent"
    DEMOGRAPHICS = "demographics"
    INSTRUCTIONS = "instructions"
    PRACTICE = "practice"
    PAIRS = "pairs"
    SELF_SETTING = "self_setting"
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


class EvaluatedMethod(Choice):
    """What a participant can be asked to rate; names as in the benchmark."""

    REFERENCE = "reference", "Reference", "The policy that nobody personalised."
    PREFFT = "prefft", "PrefFT", "The policy fine-tuned on the learned reward."
    PREFFT_ANCHORED = "prefft_anchored", "PrefFT, anchored", "Fine-tuned, but kept near the reference."
    PBARL = "pbarl", "PbARL", "The personal filter, as set below."
    PBARL_PRINTED = "pbarl_printed", "PbARL as printed", "Exactly as in the paper."
    SOMEBODY_ELSE = (
        "somebody_else",
        "Somebody else\N{RIGHT SINGLE QUOTATION MARK}s",
        "The personal filter of another participant, drawn by lot; of a usual type of user while too few are there.",
    )
    AVERAGE = "average", "Average", "One filter for everybody, of what earlier participants want on average."
    SELF_SET = (
        "self_set",
        "Set by yourself",
        "The ways of moving that the participant chose with sliders, after comparing; no promise about harm is made.",
    )


NEEDS_WEIGHTS = (EvaluatedMethod.PREFFT, EvaluatedMethod.PREFFT_ANCHORED, EvaluatedMethod.PBARL_PRINTED)
"""Methods that look into the policy, and do not only ask it what it does."""
STANDARD_QUESTIONNAIRES = tuple((each.name, each.title, each.about) for each in library.every().values())
"""(name, title, what to know before choosing it), as the form offers them."""
MOST_INSTRUMENTS = 10


def check_instruments(names: tuple[str, ...]) -> tuple[str, ...]:
    """The same, each of which exists and comes once. Raises ValueError."""
    unknown = next((name for name in names if name not in library.every()), None)
    if unknown is not None:
        raise ValueError(f"There is no standard questionnaire called {unknown[:40]}.")
    if len(set(names)) < len(names):
        raise ValueError("Each standard questionnaire can be chosen once only.")
    return names


LETTERS = "ABCDE"
"""Of robots in a blinded evaluation, in the order in which somebody meets them."""
MADE_FOR_YOU = "made_for_you"
"""The question which robot was made for somebody."""
PAPER_METHODS = (EvaluatedMethod.REFERENCE, EvaluatedMethod.PREFFT, EvaluatedMethod.PBARL)
FROM_OTHERS = (EvaluatedMethod.SOMEBODY_ELSE, EvaluatedMethod.AVERAGE)
"""Methods that show somebody what others have taught; who takes part must be told that."""


class EvaluationMode(Choice):
    """Where the robot moves."""

    VIDEO = "video", "On video", "Rendered when the last answer is given."
    PHYSICAL = "physical", "In the room", "An operator runs the robots; the participant rates on the page."


class EvaluationSettings(BaseModel):
    """The blinded comparison of methods: some trials of each under a letter, each rated from 1 to 5."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    methods: tuple[EvaluatedMethod, ...] = setting(
        (EvaluatedMethod.REFERENCE, EvaluatedMethod.PBARL, EvaluatedMethod.SOMEBODY_ELSE),
        Section.EVALUATION,
        "Methods",
        complaint="Choose two methods at least, and five at most.",
        min_length=2,
        max_length=5,
    )
    mode: EvaluationMode = setting(EvaluationMode.VIDEO, Section.EVALUATION, "Where the robot moves")
    trials: int = setting(
        3, Section.EVALUATION, "Trials of each method", "The paper used 3.", unit="trials", ge=1, le=20
    )
    fine_tuning_steps: int = setting(
        100_000,
        Section.EVALUATION,
        "Fine-tuning of PrefFT",
        "More is better and takes longer: 100 000 steps are some minutes.",
        unit="steps",
        ge=1_000,
        le=2_000_000,
    )
    ask_which_is_theirs: bool = setting(
        False,
        Section.EVALUATION,
        "Ask which robot was made for them",
        options=(
            ("no", "Do not ask", "Ratings say how personal each robot seemed."),
            (
                "yes",
                "Ask at the end",
                "A letter is named with the questions at the end; tested against chance. Only where no robot but "
                "PbARL\N{RIGHT SINGLE QUOTATION MARK}s has learned from the person.",
            ),
        ),
    )

    head_to_heads: int = setting(
        0,
        Section.EVALUATION,
        "Head-to-heads of every two methods",
        "After the ratings two robots side by side in one scenario: which one? 0: none. At most one per trial.",
        unit="head-to-heads",
        ge=0,
        le=20,
    )
    head_to_head_ties: bool = setting(
        True,
        Section.EVALUATION,
        "Answers to a head-to-head",
        options=(
            ("no", "Left or right", "Who sees no difference has to choose all the same."),
            ("yes", "Left, right or equal", "Equal counts as half a win for each."),
        ),
    )
    ask_reasons: bool = setting(
        False,
        Section.EVALUATION,
        "Ask for reasons in words",
        options=(
            ("no", "Do not ask", "Answering stays short."),
            ("yes", "Ask every time", "Beside each rating and each head-to-head; it may be left empty."),
        ),
    )

    instruments: tuple[str, ...] = setting(
        (),
        Section.EVALUATION,
        "Standard questionnaires about each robot",
        "After the last trial of each robot, about that robot. Short ones: everybody fills them in for every robot.",
        options=STANDARD_QUESTIONNAIRES,
        max_length=MOST_INSTRUMENTS,
    )

    _check_instruments = field_validator("instruments")(check_instruments)

    @field_validator("head_to_heads")
    @classmethod
    def _filmed(cls, count: int, info: ValidationInfo) -> int:
        """Each shows two films that were rated."""
        if count and info.data.get("mode") is EvaluationMode.PHYSICAL:
            raise ValueError("Two robots are shown side by side on video only. Choose 0 for robots in the room.")
        if count > info.data.get("trials", count):
            raise ValueError(
                f"Each head-to-head shows two trials that were rated: with {info.data['trials']} of each method, "
                f"enter {info.data['trials']} at most, or choose more trials."
            )
        return count

    @model_validator(mode="after")
    def _each_once(self) -> "EvaluationSettings":
        if len(set(self.methods)) != len(self.methods):
            raise ValueError("Each method can be evaluated once only.")
        return self

    @model_validator(mode="after")
    def _one_is_theirs(self) -> "EvaluationSettings":
        of_others = {EvaluatedMethod.REFERENCE, *FROM_OTHERS}
        if self.ask_which_is_theirs and set(self.methods) - of_others != {EvaluatedMethod.PBARL}:
            raise ValueError(
                "Which robot was made for somebody can be asked only where one was: choose PbARL, and beside it only "
                "the reference, somebody else's filter or the average. A robot that people set themselves is theirs "
                "as well."
            )
        return self

    @property
    def closing_questions(self) -> tuple[FormItem, ...]:
        """What is asked of the robots once all are rated, with the questions at the end."""
        if not self.ask_which_is_theirs:
            return ()
        return (FormItem(name=MADE_FOR_YOU, kind="choice", choices=tuple(LETTERS[: len(self.methods)])),)

    @property
    def shows_others(self) -> bool:
        """Whether people are shown what others have taught."""
        return any(method in FROM_OTHERS for method in self.methods)

    @property
    def has_sliders(self) -> bool:
        """Whether people set a robot themselves."""
        return EvaluatedMethod.SELF_SET in self.methods

    @property
    def trial_count(self) -> int:
        """Trials that one participant rates altogether."""
        return len(self.methods) * self.trials

    @property
    def head_to_head_count(self) -> int:
        """Head-to-heads that one participant answers altogether."""
        return len(self.methods) * (len(self.methods) - 1) // 2 * self.head_to_heads


class Advisor(Choice):
    """What becomes of the advice that more labels will hardly pay."""

    SHOW = "show", "Say so on the study's page", "Right for 130 of 133 scripted people. It stops nobody."
    LOG = "log", "Only keep a record", "As a study with a fixed number of answers should."


class PlannedTest(Choice):
    """Tests that a study announces before its data are seen."""

    TWO_SAMPLE_T = (
        "two_sample_t",
        "Two-sample t",
        "As in the paper; ignores that the same people rated all methods, and finds too much.",
    )
    PAIRED_T = "paired_t", "Paired t", "Each person with themselves: right for this design."
    WILCOXON = (
        "wilcoxon",
        "Wilcoxon signed-rank",
        "The same without assuming a normal distribution; finds nothing with fewer than six people.",
    )
    MIXED_MODEL = (
        "mixed_model",
        "Linear mixed model",
        "Level and difference vary between people; the paired t, unless ratings are missing.",
    )
    CUMULATIVE_LINK = (
        "cumulative_link",
        "Cumulative link mixed model",
        "Takes ratings as an order and not as distances; counts people. Plan another beside it: where ratings hardly "
        "overlap it cannot be computed.",
    )
    EQUIVALENCE = (
        "equivalence",
        "Equivalence (two one-sided tests)",
        "Shows that two robots differ by less than what matters, which no other test can.",
    )
    WELCH_T = "welch_t", "Welch t", "Between arms: one number per person, spreads may differ."
    PERMUTATION = "permutation", "Permutation", "Between arms, without assuming a normal distribution."
    CUMULATIVE_LINK_BETWEEN = (
        "cumulative_link_between",
        "Cumulative link model between arms",
        "Takes ratings as an order and not as distances; counts people, and spreads may differ. Plan another beside "
        "it: where ratings hardly overlap it cannot be computed.",
    )
    EQUIVALENCE_BETWEEN = (
        "equivalence_between",
        "Equivalence between arms",
        "Two one-sided Welch tests: shows that two arms differ by less than what matters.",
    )


BETWEEN_ARMS = frozenset(
    {
        PlannedTest.WELCH_T,
        PlannedTest.PERMUTATION,
        PlannedTest.CUMULATIVE_LINK_BETWEEN,
        PlannedTest.EQUIVALENCE_BETWEEN,
    }
)
"""Tests of people who met one method with people who met the other."""


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
