"""The fields of a study's form: derived from the settings they fill, in the order of the page."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any, get_args

from pydantic import BaseModel

from app.domain.choices import Choice, Strategy
from app.domain.described import Section, Shown, settings_of
from app.domain.designs import Arm, Screen
from app.domain.protocol import EvaluationSettings, FormItem
from app.domain.study_settings import StudySettings


class Kind(StrEnum):
    """How a field is typed; follows from the type of what it fills."""

    TASK = "task"
    COUNT = "count"
    COUNTS = "counts"
    """With commas or spaces between."""
    PERCENT = "percent"
    TEXT = "text"
    PARAGRAPHS = "paragraphs"
    QUESTIONS = "questions"
    """One per line."""
    ARMS = "arms"
    """One per line, with its methods."""
    SCREENS = "screens"
    """One per line: a question, and who may take part."""
    NAMES = "names"
    """With commas between."""
    TEXTS = "texts"
    """One per line, with its name."""
    CHOICE = "choice"
    SEVERAL = "several"
    """Any of some choices."""
    SWITCH = "switch"
    PART = "part"
    """A switch that turns on the settings after it."""


LINES = {Kind.PARAGRAPHS, Kind.QUESTIONS, Kind.TEXTS, Kind.ARMS, Kind.SCREENS}
WIDE = {*LINES, Kind.TASK, Kind.PART}
"""These have the whole width of the page."""
_KINDS: Mapping[Any, Kind] = {
    bool: Kind.SWITCH,
    int: Kind.COUNT,
    float: Kind.PERCENT,
    str: Kind.TEXT,
    dict[str, str]: Kind.TEXTS,
    tuple[int, ...]: Kind.COUNTS,
    tuple[FormItem, ...]: Kind.QUESTIONS,
    tuple[Arm, ...]: Kind.ARMS,
    tuple[Screen, ...]: Kind.SCREENS,
    tuple[str, ...]: Kind.NAMES,
    EvaluationSettings | None: Kind.PART,
}


@dataclass(frozen=True)
class FormField:
    """One field."""

    name: str
    """As its setting; a setting of the evaluation has ``evaluation_`` before its name."""
    kind: Kind
    shown: Shown
    options: Sequence[tuple[str, str, str]] = ()
    """(value, label, hint)"""
    setting: str | None = None
    """Of StudySettings; None for what is no setting of its own."""
    part: str | None = None
    """Of EvaluationSettings, for the fields of the evaluation."""

    @property
    def fixed_with(self) -> str:
        """What locking calls it: parts of the evaluation are fixed together."""
        return self.setting or self.name


_BEFORE: Mapping[str, Sequence[FormField]] = {
    "question": (
        FormField("task", Kind.TASK, Shown(Section.START, "Task")),
        FormField("name", Kind.TEXT, Shown(Section.START, "Name of the study", "Participants do not see it.")),
    ),
    "demographics": (
        FormField(
            "consent_text",
            Kind.PARAGRAPHS,
            Shown(
                Section.CONSENT,
                "Consent text in your own words",
                "Plain text; an empty line makes a paragraph, lines with “- ” a list. { $count } is the number of "
                "pairs, { $code } the person\N{RIGHT SINGLE QUOTATION MARK}s code; { $duration }, { $payment }, "
                "{ $contact } and { $ethics } are what you wrote above, which is listed at the end where your text "
                "does not mention it. Empty: the built-in text.",
            ),
        ),
    ),
    "planned_tests": (
        FormField(
            "seed", Kind.TEXT, Shown(Section.CLIPS, "Seed", "Everything random follows from it. Empty: one is drawn.")
        ),
    ),
}
"""What is no setting of its own, and stands before this setting. The consent text is stored with the other texts."""


def _kind(annotation: Any) -> Kind:
    if annotation in _KINDS:
        return _KINDS[annotation]
    chosen = _choice(annotation)
    if chosen is None:
        raise TypeError(f"The form has no kind of field for {annotation}.")
    return Kind.CHOICE if annotation is chosen else Kind.SEVERAL


def _choice(annotation: Any) -> type[Choice] | None:
    """The enumeration that one or several are chosen from."""
    kinds = (annotation, *get_args(annotation))
    return next((each for each in kinds if isinstance(each, type) and issubclass(each, Choice)), None)


def _fields(model: type[BaseModel], whole: str | None = None) -> Iterator[FormField]:
    for name, annotation, shown in settings_of(model):
        kind, chosen = _kind(annotation), _choice(annotation)
        options = shown.options or [(each.value, each.label, each.hint) for each in chosen or ()]
        if kind is Kind.NAMES and options:
            kind = Kind.SEVERAL
        if whole is not None:
            yield FormField(f"{whole}_{name}", kind, shown, options, setting=whole, part=name)
            continue
        yield from _BEFORE.get(name, ())
        yield FormField(name, kind, shown, options, setting=name)
        if kind is Kind.PART:
            yield from _fields(EvaluationSettings, whole=name)


FIELDS: Sequence[FormField] = tuple(_fields(StudySettings))
BY_NAME: Mapping[str, FormField] = {each.name: each for each in FIELDS}


SIMULATED = frozenset(each.name for each in FIELDS if each.shown.simulated or each.part)
"""What a study of recordings has none of."""
_NOT_OFFERED = SIMULATED | {Strategy.CONTESTED.value}


Run = tuple[bool, list[FormField]]
"""Whether these fields are wide, and else stand side by side."""


def _runs(section: Section, without: Collection[str] = ()) -> list[Run]:
    runs: list[Run] = []
    for each in FIELDS:
        if each.shown.section is not section or each.name in without:
            continue
        wide = each.kind in WIDE
        if not runs or each.shown.new_row or runs[-1][0] is not wide:
            runs.append((wide, []))
        offered = [option for option in each.options if option[0] not in without]
        runs[-1][1].append(replace(each, options=offered))
    return runs


SECTIONS: Sequence[tuple[Section, Sequence[Run]]] = [(section, _runs(section)) for section in Section]
OF_RECORDINGS: Sequence[tuple[Section, Sequence[Run]]] = [
    (section, runs) for section in Section if (runs := _runs(section, without=_NOT_OFFERED))
]
"""The same for a study of recordings."""
