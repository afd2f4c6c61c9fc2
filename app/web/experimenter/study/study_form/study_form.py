"""The form of a study: from what was typed to checked settings, with each complaint beside its field, and back."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

from fastapi import Form
from pydantic import ConfigDict, Field, ValidationError, create_model

from app.domain.designs import Arm, Screen
from app.domain.protocol import FormItem
from app.domain.studies import NAME_LENGTH, SEED_LIMIT
from app.domain.study_settings import PAPER_PROTOCOL, StudySettings
from app.installed_tasks import catalogue
from app.installed_tasks.by_name import usual_clip_steps
from app.services.studies import task_limits
from app.web.experimenter.study.study_form import form_lines
from app.web.experimenter.study.study_form.form_fields import BY_NAME, FIELDS, LINES, FormField, Kind
from app.web.texts.own_texts import CONSENT
from app.web.texts.wording import broken_texts

_Value = TypeVar("_Value")
_Text = Annotated[str, Field(max_length=500)]
_Lines = Annotated[str, Field(max_length=40_000)]
_Several = Annotated[list[str], Field(max_length=20)]


def _typed_as(kind: Kind) -> tuple[Any, Any]:
    """Type and default of a field, as pydantic wants them."""
    if kind is Kind.SEVERAL:
        return (_Several, [])
    return (_Lines if kind in LINES else _Text, "")


_definitions: Any = {each.name: _typed_as(each.kind) for each in FIELDS}
_Fields = create_model("_Fields", **_definitions)


class StudyForm(_Fields):
    """What was typed, as text: the fields of FIELDS, and what the page sends besides."""

    model_config = ConfigDict(extra="ignore")

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

    if TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            """The other fields."""


TypedStudy = Annotated[StudyForm, Form()]


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
    task: str
    seed: int | None
    """None: one is to be drawn."""
    settings: StudySettings


def form_with_defaults(preset: Preset = Preset.LEARNING) -> StudyForm:
    """The form as it is first shown; the length of clips, which differs from task to task, is left to the task."""
    return form_of("", catalogue.usual(), None, PRESETS[preset]).model_copy(update={"clip_steps": ""})


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
    if name in BY_NAME and BY_NAME[name].kind in (Kind.SWITCH, Kind.PART):
        return value == "yes"
    return value.replace("\r\n", "\n").strip() if isinstance(value, str) else value


def form_of(name: str, task: str, seed: int | None, settings: StudySettings) -> StudyForm:
    """The form that describes these settings; what it says of an evaluation without one is what is usual."""
    own = dict(settings.wording)
    values: dict[str, Any] = {
        "name": name,
        "task": task,
        "seed": "" if seed is None else str(seed),
        "consent_text": own.pop(CONSENT, ""),
    }
    described = settings.model_copy(update={"wording": own, "languages": settings.offered_languages})
    usual = settings.evaluation or PAPER_PROTOCOL.evaluation
    for each in FIELDS:
        if each.part is not None:
            values[each.name] = _as_typed(each.kind, getattr(usual, each.part))
        elif each.setting is not None:
            values[each.name] = _as_typed(each.kind, getattr(described, each.setting))
    return StudyForm(**values)


def _as_typed(kind: Kind, value: Any) -> str | list[str]:
    match kind:
        case Kind.SWITCH | Kind.PART:
            return "yes" if value else "no"
        case Kind.PERCENT:
            return f"{value * 100:g}"
        case Kind.COUNTS:
            return ", ".join(str(count) for count in value)
        case Kind.SEVERAL:
            return [str(each) for each in value]
        case Kind.QUESTIONS:
            return form_lines.lines_of(value)
        case Kind.ARMS:
            return form_lines.lines_of_arms(value)
        case Kind.SCREENS:
            return form_lines.lines_of_screens(value)
        case Kind.NAMES:
            return ", ".join(value)
        case Kind.TEXTS:
            return form_lines.lines_of_texts(value)
    return str(value)


def typed_study(form: StudyForm, own_task: str | None = None, *, recorded: bool = False) -> Typed:
    """What was typed, checked; clips whose length was left empty are as long as usual. Raises FormInvalid.

    ``own_task``: the task of a study which is changed or copied; it may stay although it is not installed here.
    ``recorded``: the study shows recordings.
    """
    errors: dict[str, str] = {}
    task = own_task if recorded and own_task else _task(errors, form.task, own_task)
    values = {each.setting: _value(errors, each, form) for each in FIELDS if each.setting and each.part is None}
    if not form.clip_steps.strip():
        errors.pop("clip_steps", None)
        values["clip_steps"] = usual_clip_steps(task)
    values["wording"] = _wording(errors, form)
    if form.evaluation == "yes":
        values["evaluation"] = {each.part: _value(errors, each, form) for each in FIELDS if each.part}
    name = " ".join(form.name.split())
    if not 1 <= len(name) <= NAME_LENGTH:
        errors["name"] = f"Give the study a name of at most {NAME_LENGTH} characters."
    seed = None if not form.seed.strip() else _number(errors, "seed", form.seed, whole=True)
    if seed is not None and seed >= SEED_LIMIT:
        errors["seed"] = f"Enter a number below {SEED_LIMIT}."
    settings = _settings(errors, values)
    if settings is not None:
        errors |= task_limits.complaints(task, settings, recorded=recorded)
    if errors or settings is None:
        if len(errors) > 1:
            errors.pop("", None)  # a rule about several fields is premature while one of them is wrong
        raise FormInvalid(errors)
    return Typed(name, task, None if seed is None else int(seed), settings)


def _value(errors: dict[str, str], field: FormField, form: StudyForm) -> Any:
    """What was typed into a field, as its setting is stored; None, and an error, where that cannot be told."""
    typed = getattr(form, field.name)
    no_items: tuple[FormItem, ...] = ()
    no_arms: tuple[Arm, ...] = ()
    no_screens: tuple[Screen, ...] = ()
    match field.kind:
        case Kind.SWITCH:
            return typed == "yes"
        case Kind.COUNT:
            return _number(errors, field.name, typed, whole=True)
        case Kind.PERCENT:
            percent = _number(errors, field.name, typed, whole=False)
            return None if percent is None else percent / 100
        case Kind.COUNTS:
            parts = typed.replace(",", " ").split()
            return tuple(_number(errors, field.name, part, whole=True) for part in parts)
        case Kind.SEVERAL:
            return tuple(typed)
        case Kind.QUESTIONS:
            return _read(errors, field.name, form_lines.items_of, typed, no_items)
        case Kind.ARMS:
            return _read(errors, field.name, form_lines.arms_of, typed, no_arms)
        case Kind.SCREENS:
            return _read(errors, field.name, form_lines.screens_of, typed, no_screens)
        case Kind.NAMES:
            return tuple(name.strip() for name in typed.split(",") if name.strip())
        case Kind.TEXT | Kind.CHOICE:
            return typed.strip()
    return None


def _settings(errors: dict[str, str], values: Mapping[str, Any]) -> StudySettings | None:
    try:
        return StudySettings.model_validate(values)
    except ValidationError as found:
        for error in found.errors():
            place = _field(error["loc"])
            field = BY_NAME.get(place)
            said_by_us = error["type"] == "value_error"
            usual = field.shown.complaint if field and not said_by_us else None
            errors.setdefault(place, usual or _in_words(field, error["msg"]))
    return None


def _field(location: Sequence[int | str]) -> str:
    """The field that a complaint belongs to."""
    if not location:
        return ""
    if location[0] == "evaluation":
        return f"evaluation_{location[1]}" if len(location) > 1 else "evaluation_methods"
    return str(location[0])


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


def _task(errors: dict[str, str], typed: str, own: str | None) -> str:
    task = typed.strip() or catalogue.usual()
    if task in (*catalogue.names(), own):
        return task
    errors["task"] = "Choose one of the tasks."
    return catalogue.usual()


def _number(errors: dict[str, str], name: str, typed: str, *, whole: bool) -> float | None:
    text = typed.strip().removesuffix("%").strip().replace(",", ".")
    digits = text.replace(".", "", 0 if whole else 1)
    if not (digits.isascii() and digits.isdigit() and len(digits) <= 10):
        errors[name] = "Enter a whole number." if whole else "Enter a number."
        return None
    return int(text) if whole else float(text)


def _in_words(field: FormField | None, message: str) -> str:
    bounds = {"greater than or equal to": "at least", "less than or equal to": "at most"}
    for theirs, ours in bounds.items():
        if theirs in message:
            bound = message.rsplit(" ", 1)[-1]
            in_percent = field is not None and field.kind is Kind.PERCENT
            return f"Enter {ours} {float(bound) * 100:g} %." if in_percent else f"Enter {ours} {bound}."
    plain = message.removeprefix("Value error, ").removeprefix("Input ")
    return plain[:1].upper() + plain[1:] + ("" if plain.endswith(".") else ".")
