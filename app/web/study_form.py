"""The form for a new study: from what was typed to checked settings, with each complaint beside its field."""

from collections.abc import Mapping
from typing import Annotated, Any

from fastapi import Form
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from app.domain.studies import LONGEST_CLIP_STEPS, USUAL_CLIP_STEPS, StudySettings, TaskName

_Text = Annotated[str, Field(max_length=500)]


class StudyForm(BaseModel):
    """What was typed, as text; the field names are those of StudySettings, except for name, task and milestones."""

    model_config = ConfigDict(extra="ignore")

    name: _Text = ""
    task: _Text = ""
    question: _Text = ""
    labels_per_participant: _Text = ""
    retrain_every_labels: _Text = ""
    filter_milestones: _Text = ""
    method: _Text = ""
    reward_kind: _Text = ""
    pooled_prior: _Text = ""
    strategy: _Text = ""
    random_share: _Text = ""
    success_tolerance: _Text = ""
    pool_scenarios: _Text = ""
    behaviours_per_scenario: _Text = ""
    clip_steps: _Text = ""
    evaluation_scenarios: _Text = ""


TypedStudy = Annotated[StudyForm, Form()]

_COUNTS = (
    "labels_per_participant",
    "retrain_every_labels",
    "pool_scenarios",
    "behaviours_per_scenario",
    "clip_steps",
    "evaluation_scenarios",
)
_PERCENTS = ("random_share", "success_tolerance")
_WORDS = ("method", "reward_kind", "strategy", "question")
NAME_LENGTH = 120


class FormInvalid(ValueError):
    """What was typed cannot become a study."""

    def __init__(self, errors: Mapping[str, str]) -> None:
        super().__init__("; ".join(errors.values()))
        self.errors = errors
        """By field; the empty name holds what concerns several fields."""


def form_with_defaults() -> StudyForm:
    """The form as it is first shown."""
    usual = StudySettings()
    return StudyForm(
        task=TaskName.FEEDING,
        **{name: str(getattr(usual, name)) for name in (*_COUNTS, *_WORDS) if name != "clip_steps"},
        **{name: f"{getattr(usual, name) * 100:g}" for name in _PERCENTS},
        pooled_prior="yes" if usual.pooled_prior else "no",
        filter_milestones=", ".join(str(count) for count in usual.filter_milestones),
    )


def settings_of(form: StudyForm) -> tuple[str, TaskName, StudySettings]:
    """The study's name, task and settings; clips without a length get the task's usual one. Raises FormInvalid."""
    errors: dict[str, str] = {}
    task = _task(errors, form.task)
    values: dict[str, Any] = {name: getattr(form, name).strip() for name in _WORDS}
    values["pooled_prior"] = form.pooled_prior == "yes"
    for name in _COUNTS:
        values[name] = _number(errors, name, getattr(form, name), whole=True)
    if not form.clip_steps.strip():
        errors.pop("clip_steps", None)
        values["clip_steps"] = USUAL_CLIP_STEPS[task]
    elif values["clip_steps"] is not None and values["clip_steps"] > LONGEST_CLIP_STEPS[task]:
        errors["clip_steps"] = f"An episode of this task has {LONGEST_CLIP_STEPS[task]} steps. Enter at most as many."
    for name in _PERCENTS:
        share = _number(errors, name, getattr(form, name), whole=False)
        values[name] = None if share is None else share / 100
    parts = form.filter_milestones.replace(",", " ").split()
    values["filter_milestones"] = tuple(_number(errors, "filter_milestones", part, whole=True) for part in parts)
    name = " ".join(form.name.split())
    if not 1 <= len(name) <= NAME_LENGTH:
        errors["name"] = f"Give the study a name of at most {NAME_LENGTH} characters."
    settings = None
    try:
        settings = StudySettings.model_validate(values)
    except ValidationError as found:
        for error in found.errors():
            place = str(error["loc"][0]) if error["loc"] else ""
            errors.setdefault(place, _in_words(place, error["msg"]))
    if errors or settings is None:
        if len(errors) > 1:
            errors.pop("", None)  # a rule about several fields is premature while one of them is wrong
        raise FormInvalid(errors)
    return name, task, settings


def _task(errors: dict[str, str], typed: str) -> TaskName:
    try:
        return TaskName(typed.strip() or TaskName.FEEDING)
    except ValueError:
        errors["task"] = "Choose one of the tasks."
        return TaskName.FEEDING


def _number(errors: dict[str, str], name: str, typed: str, *, whole: bool) -> float | None:
    text = typed.strip().removesuffix("%").strip().replace(",", ".")
    digits = text.replace(".", "", 0 if whole else 1)
    if not (digits.isascii() and digits.isdigit() and len(digits) <= 9):
        errors[name] = "Enter a whole number." if whole else "Enter a number."
        return None
    return int(text) if whole else float(text)


def _in_words(name: str, message: str) -> str:
    bounds = {"greater than or equal to": "at least", "less than or equal to": "at most"}
    for theirs, ours in bounds.items():
        if theirs in message:
            bound = message.rsplit(" ", 1)[-1]
            return f"Enter {ours} {float(bound) * 100:g} %." if name in _PERCENTS else f"Enter {ours} {bound}."
    return message.removeprefix("Value error, ").removeprefix("Input ").capitalize() + (
        "" if message[-1] == "." else "."
    )
