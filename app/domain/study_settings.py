"""What an experimenter decides about a study before its first participant: every setting, with its words, once.

The form, the schema of the API and what locking fixes follow from these fields, which stand in the order of the page.
"""

from pydantic import BaseModel, ConfigDict, field_validator, model_validator

from app.domain.choices import ClipQuality, Method, RewardKind, Strategy
from app.domain.described import Section, Use, setting
from app.domain.designs import MOST_ARMS, Arm, Screen, why_no_arms, why_no_screening
from app.domain.protocol import (
    BETWEEN_ARMS,
    MOST_INSTRUMENTS,
    PAPER_DEMOGRAPHICS,
    PAPER_METHODS,
    STANDARD_QUESTIONNAIRES,
    USUAL_QUESTIONNAIRE,
    Advisor,
    EvaluationSettings,
    FormItem,
    Language,
    PlannedTest,
    check_instruments,
)
from app.installed_tasks.by_name import USUAL_CLIP_STEPS
from app.installed_tasks.description import LONGEST_CLIP_STEPS, SHORTEST_CLIP_STEPS
from app.installed_tasks.refinements import none_or_enough
from app.questionnaires import library


def _without_words(instrument: str, language: Language, missing: tuple[str, ...], usual: Language) -> str:
    """Why a questionnaire cannot be asked in a language, and what to do."""
    known = library.every()[instrument]
    prefix = "" if language == usual else f"{language.value}:"
    lines = ", ".join(f"{prefix}{library.text_name(instrument, part)}" for part in missing)
    leave_out = "" if language == usual else f"leave {language.label} out of the languages people may choose, or "
    return (
        f"{known.title} lacks words in {language.label}. Choose another questionnaire, {leave_out}"
        f"enter your own under “Other texts in your own words”, one line each, as name = text. Missing: {lines}."
    )


class StudySettings(BaseModel):
    """What an experimenter decides before the first participant. Frozen per study."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    question: str = setting(
        "Which robot would you rather have?",
        Section.START,
        "Question above every pair",
        "What the participants answer. The usual one is translated by itself.",
        min_length=1,
        max_length=200,
    )
    labels_per_participant: int = setting(
        100,
        Section.START,
        "Answers per participant",
        "The paper used 200. Of 180 scripted people 3 gain much by a second hundred, and 18 by going on from 50.",
        unit="pairs",
        fixed_by=Use.PAIRS,
        ge=10,
        le=1000,
    )
    language: Language = setting(Language.ENGLISH, Section.START, "Language of the study")
    languages: tuple[Language, ...] = setting(tuple(Language), Section.START, "Languages people may choose")
    consent_duration: str = setting(
        "", Section.CONSENT, "How long taking part takes", "Such as: about 45 minutes, breaks included.", max_length=200
    )
    consent_payment: str = setting(
        "",
        Section.CONSENT,
        "What people are given for it",
        "Such as: 12 € per hour. Or say that there is no payment.",
        max_length=200,
    )
    consent_contact: str = setting(
        "",
        Section.CONSENT,
        "Whom people can ask",
        "A name with an e-mail address or a telephone number.",
        max_length=200,
    )
    consent_ethics: str = setting(
        "", Section.CONSENT, "Ethics approval", "Who approved the study, and under which number.", max_length=200
    )
    consent_version: str = setting(
        "1",
        Section.CONSENT,
        "Version of the consent text",
        "Stored with every agreement. A new version is put to everybody again.",
        min_length=1,
        max_length=40,
    )
    demographics: tuple[FormItem, ...] = setting(
        (),
        Section.CONSENT,
        "Questions at the start",
        "One per line: name | kind | question. Kinds: number, text, choice, likert. After a choice its choices: "
        "hand | choice | Which hand do you use? | left; right; both. After a likert scale its ends: tech | likert | "
        "I like new technology. | not at all | very much. age, gender and robot_experience need no question. "
        "No answer is ever required.",
    )
    questionnaire: tuple[FormItem, ...] = setting(
        (),
        Section.CONSENT,
        "Questions at the end",
        "Written in the same way. felt_understood, felt_safe, would_use and comments need no question.",
    )
    instruments: tuple[str, ...] = setting(
        (),
        Section.CONSENT,
        "Standard questionnaires at the end",
        "Before the questions at the end, a page each, worded and scored as published. A language that is not named "
        "here needs your own words below: scale-sus-easy = text, with de: before it for German only.",
        options=STANDARD_QUESTIONNAIRES,
        max_length=MOST_INSTRUMENTS,
    )
    wording: dict[str, str] = setting(
        {},
        Section.CONSENT,
        "Other texts in your own words",
        "One per line: name = text. A text goes on in lines that begin with spaces. “de:” before a name means "
        "German only; translations of your own texts have a page of their own.",
    )
    practice_pairs: int = setting(
        0,
        Section.PAIRS,
        "Practice pairs",
        "Before the first answer that counts. 1 in the paper protocol.",
        unit="pairs",
        fixed_by=Use.PAIRS,
        ge=0,
        le=5,
    )
    introduction_pairs: int = setting(
        0,
        Section.PAIRS,
        "Of the answers, on whole trajectories",
        "They come first. The paper used 10.",
        unit="pairs",
        fixed_by=Use.PAIRS,
        ge=0,
        le=50,
    )
    repeated_pairs: int = setting(
        0,
        Section.PAIRS,
        "Pairs asked twice",
        "On top of the answers, half of them with the sides exchanged. They measure how far people agree with "
        "themselves; 20 say something.",
        unit="pairs",
        fixed_by=Use.PAIRS,
        ge=0,
        le=100,
    )
    catch_pairs: int = setting(
        0,
        Section.PAIRS,
        "Catch pairs",
        "On top of the answers: a clean success beside a clear failure.",
        unit="pairs",
        fixed_by=Use.PAIRS,
        ge=0,
        le=20,
        simulated=True,
    )
    break_every: int = setting(50, Section.PAIRS, "Offer a break every", "0: never.", unit="answers", ge=0, le=500)
    answer_after_first_play: bool = setting(
        True, Section.PAIRS, "Answers open after the first play", "Nobody can answer before both clips were seen once."
    )
    asks_what_mattered: bool = setting(
        False,
        Section.PAIRS,
        "Ask what made the difference",
        options=(
            ("no", "No", "One tap answers a pair."),
            (
                "yes",
                "Yes",
                "A second tap, which people may pass over, names a quality such as speed or force. The model hears the "
                "answer once more, about that quality alone; scripted users' robots got no better by it "
                "(docs/results/mattered.md). Structured models of simulated clips only.",
            ),
        ),
        simulated=True,
    )
    asks_for_hints: bool = setting(
        False,
        Section.PAIRS,
        "Ask for hints",
        options=(
            ("no", "No", "Answers to pairs say it all."),
            (
                "yes",
                "Yes",
                "After the introduction people may tick up to two hints, such as \u201cslower near me\u201d, and "
                "change them later. Each is heard as one more answer; scripted users' robots got no better by it "
                "(docs/results/hints.md). Structured models of simulated clips only.",
            ),
        ),
        simulated=True,
    )
    evaluation: EvaluationSettings | None = setting(
        None,
        Section.EVALUATION,
        "Evaluate methods at the end",
        "Balanced random order, unseen scenarios. Nobody knows which letter is which until you unblind the study.",
        fixed_by=Use.EVALUATION,
        simulated=True,
    )
    debrief: bool = setting(
        False,
        Section.EVALUATION,
        "Show people their own robot at the end",
        "Before and after, side by side, and what it learned.",
        simulated=True,
    )
    arms: tuple[Arm, ...] = setting(
        (),
        Section.DESIGN,
        "Arms, for a study between subjects",
        "One per line, with the methods that its people meet: own | pbarl. Then: usual | reference. Names are for you; "
        "participants never see them. Empty: everybody meets every method.",
        fixed_by=Use.ARMS,
        max_length=MOST_ARMS,
        simulated=True,
    )
    stopped_arms: tuple[str, ...] = setting(
        (),
        Section.DESIGN,
        "Arms that take nobody in any more",
        "Names, with commas.",
        max_length=MOST_ARMS,
        simulated=True,
    )
    arm_quota: int = setting(
        0,
        Section.DESIGN,
        "People who complete each arm",
        "Then the arm is closed; whoever drops out is replaced. 0: as many as come.",
        unit="people",
        ge=0,
        le=100_000,
        simulated=True,
    )
    arm_away_minutes: int = setting(
        60,
        Section.DESIGN,
        "Counted as dropped out after",
        "Without a sign. Whoever comes back goes on, and is counted again.",
        unit="minutes",
        ge=5,
        le=43_200,
        simulated=True,
    )
    screening: tuple[Screen, ...] = setting(
        (),
        Section.DESIGN,
        "Who may take part",
        "By questions at the start, one per line: age | 18 to 75. Of a choice: hand | left; right. Others are thanked "
        "and sent back. No answer: they may.",
    )
    end_after_misses: int = setting(
        0,
        Section.DESIGN,
        "Missed catch pairs that end it",
        "At so many wrong answers somebody is thanked and sent back. 0: never.",
        unit="pairs",
        ge=0,
        le=20,
        simulated=True,
    )
    goes_on_from: str = setting(
        "",
        Section.DESIGN,
        "Return visit: goes on from the study",
        "Its short name, the end of its address. Whoever has finished it comes back by the same link, and the model "
        "goes on from all that they have answered. Same task. Empty: nobody comes back.",
        complaint="Enter the short name of a study, such as first-visit, or leave it empty.",
        fixed_by=Use.PAIRS,
        pattern=r"^[a-z0-9-]{0,80}$",
        simulated=True,
    )
    days_between_visits: int = setting(
        7,
        Section.DESIGN,
        "Days since the visit before",
        "Nobody comes back sooner. 0: at once.",
        unit="days",
        ge=0,
        le=365,
        simulated=True,
    )
    panel_parameter: str = setting(
        "PROLIFIC_PID",
        Section.PANEL,
        "Parameter that names the person",
        "PROLIFIC_PID at Prolific. The same id comes back to the same participant. "
        "Empty: anybody may join without a name.",
        complaint="Use letters, digits and underscores, such as PROLIFIC_PID.",
        pattern=r"^([A-Za-z][A-Za-z0-9_]{0,39})?$",
    )
    completion_code: str = setting("", Section.PANEL, "Completion code", "Shown at the end.", max_length=80)
    screen_out_code: str = setting(
        "", Section.PANEL, "Code of who may not take part", "Also where no arm is open.", max_length=80
    )
    attention_code: str = setting("", Section.PANEL, "Code of who missed catch pairs", max_length=80, simulated=True)
    return_url: str = setting(
        "",
        Section.PANEL,
        "Address to return to",
        "May contain {code}, {panel_id} and any parameter of the panel in braces.",
        complaint="Enter an address that begins with http:// or https://, or leave it empty.",
        max_length=500,
        pattern=r"^(https?://\S+)?$",
    )
    retrain_every_labels: int = setting(
        10,
        Section.LEARNING,
        "Train the reward model every",
        "Then the next pairs are chosen.",
        unit="answers",
        ge=1,
        le=100,
    )
    filter_milestones: tuple[int, ...] = setting(
        (50,),
        Section.LEARNING,
        "Also train a filter after",
        "Numbers of answers, with commas. One is always trained at the end, and sought longer than these; its "
        "refinement comes before earlier ones.",
        unit="answers",
        simulated=True,
    )
    refinement_steps: int = setting(
        0,
        Section.LEARNING,
        "Refine the last filter for",
        "By reinforcement learning, most of it while people answer; the rest takes a minute or two, in which the "
        "participant waits. Little is gained by it where a task has policies that were refined beforehand "
        "(docs/results/rivals.md). 0: not at all.",
        unit="steps",
        ge=0,
        le=1_000_000,
        simulated=True,
    )
    success_tolerance: float = setting(
        0.035,
        Section.LEARNING,
        "Success the filter may cost",
        "Compared with the reference policy on unseen scenarios.",
        unit="%",
        ge=0.0,
        le=0.5,
        simulated=True,
    )
    harm_share: float = setting(
        0.05,
        Section.LEARNING,
        "Scenarios in which a filter may be worse",
        "Than the reference policy in the same scenario, by the limits that follow. Half the share takes twice as "
        "long to show; a filter of which it cannot be shown is weakened.",
        unit="%",
        ge=0.01,
        le=0.5,
        simulated=True,
    )
    harm_confidence: float = setting(
        0.95, Section.LEARNING, "Confidence of that promise", unit="%", ge=0.8, le=0.99, simulated=True
    )
    harm_force_n: int = setting(
        5,
        Section.LEARNING,
        "Worse: more force on the person",
        "Of the largest of an episode. To fail where the reference policy succeeds is always worse.",
        unit="N",
        ge=0,
        le=50,
        simulated=True,
    )
    harm_spilled: float = setting(
        0.25, Section.LEARNING, "Worse: more of the portion spilled", unit="%", ge=0.0, le=1.0, simulated=True
    )
    evaluation_scenarios: int = setting(
        100,
        Section.LEARNING,
        "Scenarios that measure a filter",
        "Never seen in training.",
        ge=10,
        le=1000,
        simulated=True,
    )
    method: Method = setting(
        Method.STUDIO,
        Section.LEARNING,
        "Method",
        complaint="Choose “studio” or “printed”.",
        new_row=True,
        simulated=True,
    )
    reward_kind: RewardKind = setting(RewardKind.STRUCTURED, Section.LEARNING, "Reward model", simulated=True)
    strategy: Strategy = setting(Strategy.ENTROPY, Section.LEARNING, "How pairs are chosen")
    random_share: float = setting(
        0.3,
        Section.LEARNING,
        "Pairs always drawn at random",
        "Matters unless all pairs are. The accuracy is measured on these.",
        unit="%",
        ge=0.1,
        le=1.0,
    )
    following_share: float = setting(
        0.0,
        Section.LEARNING,
        "Pairs that follow the person",
        "From the tenth answer on: their robot as it would be now, beside a variation of it, filmed for them while "
        "they answer. With scripted people it did not save answers. 0: none.",
        unit="%",
        ge=0.0,
        le=0.9,
        simulated=True,
    )
    pooled_prior: bool = setting(
        False,
        Section.LEARNING,
        "Where the model starts",
        options=(
            ("no", "From what is known of the task", "In our tasks from scripted people, elsewhere from nothing."),
            (
                "yes",
                "Also from earlier participants",
                "Whoever is not like them is soon not taken for one of them. Structured models only.",
            ),
        ),
        simulated=True,
    )
    advisor: Advisor = setting(Advisor.SHOW, Section.LEARNING, "When more answers hardly pay", simulated=True)
    pool_scenarios: int = setting(
        48, Section.CLIPS, "Situations", "Each with its own start and seating position.", ge=1, le=500, simulated=True
    )
    behaviours_per_scenario: int = setting(
        6,
        Section.CLIPS,
        "Ways of doing each",
        "Pairs show two of them.",
        fixed_by=Use.CLIPS,
        ge=2,
        le=8,
        simulated=True,
    )
    clip_steps: int = setting(
        USUAL_CLIP_STEPS,
        Section.CLIPS,
        "Length of a clip",
        "10 steps are one second, in a task of your own as its lab.toml says; empty: what suits the task.",
        unit="steps",
        fixed_by=Use.CLIPS,
        ge=SHORTEST_CLIP_STEPS,
        le=LONGEST_CLIP_STEPS,
        simulated=True,
    )
    clip_quality: ClipQuality = setting(ClipQuality.SHARP, Section.CLIPS, "Quality", fixed_by=Use.CLIPS, simulated=True)
    planned_tests: tuple[PlannedTest, ...] = setting(
        (PlannedTest.PAIRED_T,), Section.TESTS, "Tests on the ratings", simulated=True
    )
    equivalence_bound: float = setting(
        0.5,
        Section.TESTS,
        "Smallest difference that matters",
        "Of mean ratings from 1 to 5. The equivalence test asks whether two robots differ by less.",
        unit="points",
        ge=0.1,
        le=2.0,
        simulated=True,
    )

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

    @model_validator(mode="after")
    def _can_follow(self) -> "StudySettings":
        if self.following_share + self.random_share > 1.0 + 1e-9:
            raise ValueError(
                "Pairs that follow the person and pairs drawn at random are more than all. Lower one share."
            )
        if self.following_share and not self.reward_kind.is_linear_in_signals:
            raise ValueError("Pairs follow the person with structured reward models only. Choose one, or enter 0 %.")
        return self

    @model_validator(mode="after")
    def _can_refine(self) -> "StudySettings":
        if self.refinement_steps and self.method is not Method.STUDIO:
            raise ValueError("Only the studio's own filters are refined. Choose its method, or enter 0 steps.")
        return self

    @model_validator(mode="after")
    def _can_hear_what_mattered(self) -> "StudySettings":
        if self.asks_what_mattered and not self.reward_kind.is_linear_in_signals:
            raise ValueError("What made the difference is learned from by structured reward models only. Choose one.")
        return self

    @model_validator(mode="after")
    def _can_hear_hints(self) -> "StudySettings":
        if self.asks_for_hints and not self.reward_kind.is_linear_in_signals:
            raise ValueError("Hints are learned from by structured reward models only. Choose one.")
        return self

    @model_validator(mode="after")
    def _asked_once(self) -> "StudySettings":
        names = [each.name for each in self.closing_form]
        twice = next((name for name in names if names.count(name) > 1), None)
        if self.evaluation and twice in [each.name for each in self.evaluation.closing_questions]:
            raise ValueError(f"{twice} is asked by the evaluation already. Leave it out of the questions at the end.")
        return self

    _check_refinement_steps = field_validator("refinement_steps")(none_or_enough)
    _check_instruments = field_validator("instruments")(check_instruments)

    @model_validator(mode="after")
    def _worded(self) -> "StudySettings":
        """Nobody is shown half a questionnaire in another language."""
        for name in self.all_instruments:
            for language in self.offered_languages:
                missing = self.missing_words(name, language)
                if missing:
                    raise ValueError(_without_words(name, language, missing, self.language))
        return self

    @property
    def all_instruments(self) -> tuple[str, ...]:
        """Standard questionnaires that are filled in, at the end or about each robot, each once."""
        return tuple(dict.fromkeys((*self.instruments, *(self.evaluation.instruments if self.evaluation else ()))))

    def own_words(self, instrument: str, part: str, language: Language) -> str | None:
        """What the study says itself for a part of a questionnaire, in this language; None: what is published.

        A text without a language holds in the study's own.
        """
        name = library.text_name(instrument, part)
        own = self.wording.get(name) if language == self.language else None
        return self.wording.get(f"{language.value}:{name}", own) or None

    def missing_words(self, instrument: str, language: Language) -> tuple[str, ...]:
        """Parts of a questionnaire that nobody has put into this language."""
        published = library.every()[instrument].published(language.value)
        return tuple(
            part for part, text in published.items() if not text and not self.own_words(instrument, part, language)
        )

    @model_validator(mode="after")
    def _arms_and_screening(self) -> "StudySettings":
        wrong = why_no_arms(self.arms, self.stopped_arms, self.evaluation) or why_no_screening(
            self.screening, self.demographics
        )
        if wrong is None and self.end_after_misses > self.catch_pairs:
            wrong = f"Nobody can miss {self.end_after_misses} of {self.catch_pairs} catch pairs."
        if wrong is None and not self.arms:
            names = [test.label for test in self.planned_tests if test in BETWEEN_ARMS]
            wrong = f"There are no arms to compare by {names[0]}: choose tests within people." if names else None
        if wrong is not None:
            raise ValueError(wrong)
        return self

    def in_arm(self, name: str | None) -> "StudySettings":
        """The settings as they hold for the people of an arm: their evaluation has the arm's methods alone."""
        arm = next((each for each in self.arms if each.name == name), None)
        if arm is None or self.evaluation is None:
            return self
        theirs = self.evaluation.model_copy(update={"methods": arm.methods})
        return self.model_copy(update={"evaluation": theirs})

    @property
    def closing_form(self) -> tuple[FormItem, ...]:
        """All questions at the end: those about the robots come first."""
        return (*(self.evaluation.closing_questions if self.evaluation else ()), *self.questionnaire)

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
    labels_per_participant=200,
    filter_milestones=(50, 100),
    strategy=Strategy.UNIFORM,
    demographics=PAPER_DEMOGRAPHICS,
    practice_pairs=1,
    introduction_pairs=10,
    evaluation=EvaluationSettings(methods=PAPER_METHODS),
    questionnaire=USUAL_QUESTIONNAIRE,
    debrief=True,
    advisor=Advisor.LOG,
    planned_tests=(PlannedTest.TWO_SAMPLE_T, PlannedTest.PAIRED_T, PlannedTest.MIXED_MODEL),
)
"""The user study of the paper: 10 + 190 labels, three methods, three trials each. The default of everything else."""
