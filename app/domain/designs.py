"""Designs between subjects, and who is sent away before the end. Pieces of a study's settings."""

from collections.abc import Sequence

from pydantic import BaseModel, ConfigDict, Field, model_validator

from app.domain.choices import Choice
from app.domain.protocol import EvaluatedMethod, EvaluationSettings, FormItem

ARM_NAME = r"^[a-z][a-z0-9_]{0,39}$"
MOST_ARMS = 8


class Arm(BaseModel):
    """One arm of a study between subjects: which of the evaluated methods its people meet."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str = Field(pattern=ARM_NAME, description="In exports; participants never see it.")
    methods: tuple[EvaluatedMethod, ...] = Field(min_length=1, max_length=5)

    @model_validator(mode="after")
    def _each_once(self) -> "Arm":
        if len(set(self.methods)) != len(self.methods):
            raise ValueError(f"{self.name}: each method can be met once only.")
        return self


class Screen(BaseModel):
    """Who may take part, by one question at the start. A question that is left out screens nobody out."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str = Field(pattern=ARM_NAME, description="Of the question at the start.")
    low: float | None = Field(default=None, description="Of a number or a scale: the smallest that may take part.")
    high: float | None = Field(default=None, description="And the largest.")
    answers: tuple[str, ...] = Field(default=(), max_length=20, description="Of a choice: those that may take part.")

    @model_validator(mode="after")
    def _one_rule(self) -> "Screen":
        ends = (self.low is not None) + (self.high is not None)
        if ends not in (0, 2) or bool(ends) == bool(self.answers):
            raise ValueError(f"{self.name}: give the smallest and the largest number, or the answers of a choice.")
        if self.low is not None and self.high is not None and self.low > self.high:
            raise ValueError(f"{self.name}: the smallest number comes first.")
        return self

    def admits(self, answer: str | None) -> bool:
        """Whether somebody with this answer may take part."""
        if answer is None:
            return True
        if self.answers:
            return answer in self.answers
        return self.low is not None and self.high is not None and self.low <= float(answer) <= self.high


class Ending(Choice):
    """Why somebody was thanked and sent back before the end. Their answers are kept."""

    SCREENED_OUT = "screened_out", "screened out"
    FULL = "full", "no arm was open"
    INATTENTIVE = "inattentive", "missed too many catch pairs"


def why_no_arms(arms: Sequence[Arm], stopped: Sequence[str], evaluation: EvaluationSettings | None) -> str | None:
    """What is wrong with the arms of a study, in words; None where nothing is, or where there are none."""
    names = [each.name for each in arms]
    if set(stopped) - set(names):
        return f"There is no arm {', '.join(sorted(set(stopped) - set(names)))} to stop."
    if not arms:
        return None
    if evaluation is None:
        return "Arms differ in the methods that their people rate. Turn on the evaluation."
    if evaluation.ask_which_is_theirs:
        return "Which robot was made for somebody can be asked only where everybody meets all of them."
    if len(names) < 2 or len(set(names)) != len(names):
        return "Name two arms at least, each differently; or none."
    odd = {method for each in arms for method in each.methods} ^ set(evaluation.methods)
    if odd:
        return f"Together the arms meet all methods of the evaluation and no others, unlike {', '.join(sorted(odd))}."
    return None


def why_no_screening(screening: Sequence[Screen], demographics: Sequence[FormItem]) -> str | None:
    """What is wrong with the rules of who may take part, in words."""
    kinds = {each.name: each.kind for each in demographics}
    for each in screening:
        kind = kinds.get(each.name)
        if kind not in ("number", "likert", "choice") or (kind == "choice") != bool(each.answers):
            return (
                f"{each.name}: people are screened by a question at the start that has this name, a number or a scale "
                "by “18 to 75”, a choice by its answers."
            )
    return None
