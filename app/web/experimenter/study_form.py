"""The form of a study: from what was typed to checked settings, with each complaint beside its field, and back."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated, Any, TypeVar

from fastapi import Form
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from app.domain.protocol import FormItem
from app.domain.studies import LONGEST_CLIP_STEPS, USUAL_CLIP_STEPS, TaskName
from app.domain.study_settings import PAPER_PROTOCOL, StudySettings
from app.web.experimenter import form_lines
from app.web.texts.own_texts import CONSENT
from app.web.texts.wording import broken_texts

_Value = TypeVar("_Value")
_Text = Annotated[str, Field(max_length=500)]
_Lines = Annotated[str, Field(max_length=40_000)]
_Several = Annotated[list[str], Field(max_length=20)]


class StudyForm(BaseModel):
    """What was typed, as text; fields are named as in StudySettings, those of its evaluation with ``evaluation_``.

    They stand in the order of the page, where the first wrong one is looked for.
    """

    model_config = ConfigDict(extra="ignore")

    task: _Text = ""
    name: _Text = ""
    question: _Text = ""
    labels_per_participant: _Text = ""
    language: _Text = ""
    languages: _Several = []
    consent_duration: _Text = ""
    consent_payment: _Text = ""
    consent_contact: _Text = ""
    consent_ethics: _Text = ""
    consent_version: _Text = ""
    consent_text: _Lines = ""
    demographics: _Lines = ""
    questionnaire: _Lines = ""
    wording: _Lines = ""
    practice_pairs: _Text = ""
    introduction_pairs: _Text = ""
    repeated_pairs: _Text = ""
    catch_pairs: _Text = ""
    break_every: _Text = ""
    answer_after_first_play: _Text = ""
    evaluation: _Text = ""
    evaluation_methods: _Several = []
    evaluation_mode: _Text = ""
    evaluation_trials: _Text = ""
    evaluation_fine_tuning_steps: _Text = ""
    debrief: _Text = ""
    panel_parameter: _Text = ""
    completion_code: _Text = ""
    return_url: _Text = ""
    retrain_every_labels: _Text = ""
    filter_milestones: _Text = ""
    success_tolerance: _Text = ""
    evaluation_scenarios: _Text = ""
    method: _Text = ""
    reward_kind: _Text = ""
    strategy: _Text = ""
    random_share: _Text = ""
    pooled_prior: _Text = ""
    advisor: _Text = ""
    pool_scenarios: _Text = ""
    behaviours_per_scenario: _Text = ""
    clip_steps: _Text = ""
    clip_quality: _Text = ""
    seed: _Text = ""
    planned_tests: _Several = []
    reason: _Lines = ""
    """Why a locked study is changed."""
    preset: _Text = ""
    """Where the form has started from."""
    switch_to: _Text = ""
    """The preset to start from instead; what was typed stays."""
    like: _Text = ""
    """The short name of the study that is duplicated."""
    same_name: _Text = ""
    """Whether another study may have this name."""


TypedStudy = Annotated[StudyForm, Form()]

_COUNTS = (
    "labels_per_participant",
    "retrain_every_labels",
    "pool_scenarios",
    "behaviours_per_scenario",
    "clip_steps",
    "evaluation_scenarios",
    "practice_pairs",
    "introduction_pairs",
    "repeated_pairs",
    "catch_pairs",
    "break_every",
)
_PERCENTS = ("random_share", "success_tolerance")
_WORDS = (
    "method",
    "reward_kind",
    "strategy",
    "question",
    "language",
    "consent_version",
    "consent_duration",
    "consent_payment",
    "consent_ethics",
    "consent_contact",
    "completion_code",
    "return_url",
    "panel_parameter",
    "advisor",
    "clip_quality",
)
_SWITCHES = ("pooled_prior", "answer_after_first_play", "debrief")
_ITEMS = ("demographics", "questionnaire")
_EXPLAINED = {
    "return_url": "Enter an address that begins with http:// or https://, or leave it empty.",
    "panel_parameter": "Use letters, digits and underscores, such as PROLIFIC_PID.",
    "evaluation_methods": "Choose two methods at least.",
    "method": "Choose “studio” or “printed”.",
}
NAME_LENGTH = 120
_SEED_LIMIT = 2**31


class Preset(StrEnum):
    """What the form can start from."""

    LEARNING = "learning"
    PAPER = "paper"


PRESETS: Mapping[Preset, StudySettings] = {Preset.LEARNING: StudySettings(), Preset.PAPER: PAPER_PROTOCOL}


class FormInvalid(ValueError):
    """What was typed cannot become a study."""

    def __init__(self, errors: Mapping[str, str]) -> None:
        super().__init__("; ".join(errors.values()))
        self.errors = errors
        """By field; the empty name holds what concerns several fields."""


@dataclass(frozen=True)
class Typed:
    """A study as it was typed, checked."""

    name: str
    task: TaskName
    seed: int | None
    """None: one is to be drawn."""
    settings: StudySettings


def form_with_defaults(preset: Preset = Preset.LEARNING) -> StudyForm:
    """The form as it is first shown; the length of clips is left to the task."""
    return form_of("", TaskName.FEEDING, None, PRESETS[preset]).model_copy(update={"clip_steps": ""})


def with_preset(form: StudyForm, preset: Preset) -> StudyForm:
    """The form started from another preset: what is as the earlier preset has it changes, what was typed stays."""
    known = {each.value: each for each in Preset}
    before = form_with_defaults(known.get(form.preset, Preset.LEARNING))
    untouched = {name for name in StudyForm.model_fields if _plain(form, name) == _plain(before, name)}
    fresh = form_with_defaults(preset).model_dump(include=untouched)
    return form.model_copy(update=fresh | {"preset": preset.value, "switch_to": ""})


def _plain(form: StudyForm, name: str) -> object:
    """What a field says, whichever way a browser sends it: switches that are off are not sent at all."""
    value = getattr(form, name)
    if name in (*_SWITCHES, "evaluation"):
        return value == "yes"
    return value.replace("\r\n", "\n").strip() if isinstance(value, str) else value


def form_of(name: str, task: str, seed: int | None, settings: StudySettings) -> StudyForm:
    """The form that describes these settings; what it says of an evaluation without one is what is usual."""
    usual = settings.evaluation or PAPER_PROTOCOL.evaluation
    if usual is None:
        raise ValueError("The paper's protocol evaluates.")
    values: dict[str, Any] = {each: str(getattr(settings, each)) for each in (*_COUNTS, *_WORDS)}
    values |= {each: f"{getattr(settings, each) * 100:g}" for each in _PERCENTS}
    values |= {each: _switch(getattr(settings, each)) for each in _SWITCHES}
    values |= {each: form_lines.lines_of(getattr(settings, each)) for each in _ITEMS}
    own = dict(settings.wording)
    return StudyForm(
        name=name,
        task=task,
        seed="" if seed is None else str(seed),
        **values,
        filter_milestones=", ".join(str(count) for count in settings.filter_milestones),
        consent_text=own.pop(CONSENT, ""),
        wording=form_lines.lines_of_texts(own),
        evaluation=_switch(settings.evaluation is not None),
        evaluation_methods=[method.value for method in usual.methods],
        evaluation_trials=str(usual.trials),
        evaluation_mode=usual.mode.value,
        evaluation_fine_tuning_steps=str(usual.fine_tuning_steps),
        planned_tests=[test.value for test in settings.planned_tests],
        languages=[each.value for each in settings.offered_languages],
    )


def typed_study(form: StudyForm) -> Typed:
    """What was typed, checked; clips without a length get the task's usual one. Raises FormInvalid."""
    errors: dict[str, str] = {}
    task = _task(errors, form.task)
    values: dict[str, Any] = {name: getattr(form, name).strip() for name in _WORDS}
    values |= {name: getattr(form, name) == "yes" for name in _SWITCHES}
    values |= _numbers(errors, form, task)
    no_items: tuple[FormItem, ...] = ()
    values |= {name: _read(errors, name, form_lines.items_of, getattr(form, name), no_items) for name in _ITEMS}
    values["wording"] = _wording(errors, form)
    values["evaluation"] = _evaluation(errors, form) if form.evaluation == "yes" else None
    values["planned_tests"] = tuple(form.planned_tests)
    values["languages"] = tuple(form.languages)
    name = " ".join(form.name.split())
    if not 1 <= len(name) <= NAME_LENGTH:
        errors["name"] = f"Give the study a name of at most {NAME_LENGTH} characters."
    seed = None if not form.seed.strip() else _number(errors, "seed", form.seed, whole=True)
    if seed is not None and seed >= _SEED_LIMIT:
        errors["seed"] = f"Enter a number below {_SEED_LIMIT}."
    settings = _settings(errors, values)
    if errors or settings is None:
        if len(errors) > 1:
            errors.pop("", None)  # a rule about several fields is premature while one of them is wrong
        raise FormInvalid(errors)
    return Typed(name, task, None if seed is None else int(seed), settings)


def _settings(errors: dict[str, str], values: Mapping[str, Any]) -> StudySettings | None:
    try:
        return StudySettings.model_validate(values)
    except ValidationError as found:
        for error in found.errors():
            place = _field(error["loc"])
            errors.setdefault(place, _EXPLAINED.get(place) or _in_words(place, error["msg"]))
    return None


def _field(location: Sequence[int | str]) -> str:
    """The field that a complaint belongs to."""
    if not location:
        return ""
    if location[0] == "evaluation":
        return f"evaluation_{location[1]}" if len(location) > 1 else "evaluation_methods"
    return str(location[0])


def _numbers(errors: dict[str, str], form: StudyForm, task: TaskName) -> dict[str, Any]:
    values: dict[str, Any] = {}
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
    return values


def _evaluation(errors: dict[str, str], form: StudyForm) -> dict[str, Any]:
    counts = {
        name: _number(errors, f"evaluation_{name}", getattr(form, f"evaluation_{name}"), whole=True)
        for name in ("trials", "fine_tuning_steps")
    }
    return {"methods": tuple(form.evaluation_methods), "mode": form.evaluation_mode, **counts}


def _wording(errors: dict[str, str], form: StudyForm) -> dict[str, str]:
    nothing: dict[str, str] = {}
    own = _read(errors, "wording", form_lines.texts_of, form.wording, nothing)
    broken = broken_texts(own)
    if broken:
        errors["wording"] = " ".join(f"{key}: {why}." for key, why in broken.items())
    consent = form.consent_text.replace("\r\n", "\n").strip()
    if not consent:
        return own
    if CONSENT in own:
        errors["wording"] = f"{CONSENT} has its own field above."
    broken = broken_texts({CONSENT: consent})
    if broken:
        errors["consent_text"] = f"This text cannot be shown: {broken[CONSENT]}."
    return own | {CONSENT: consent}


def _read(errors: dict[str, str], name: str, reader: Callable[[str], _Value], typed: str, otherwise: _Value) -> _Value:
    try:
        return reader(typed)
    except form_lines.LineBroken as error:
        errors[name] = str(error)
        return otherwise


def _switch(on: bool) -> str:
    return "yes" if on else "no"


def _task(errors: dict[str, str], typed: str) -> TaskName:
    try:
        return TaskName(typed.strip() or TaskName.FEEDING)
    except ValueError:
        errors["task"] = "Choose one of the tasks."
        return TaskName.FEEDING


def _number(errors: dict[str, str], name: str, typed: str, *, whole: bool) -> float | None:
    text = typed.strip().removesuffix("%").strip().replace(",", ".")
    digits = text.replace(".", "", 0 if whole else 1)
    if not (digits.isascii() and digits.isdigit() and len(digits) <= 10):
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
