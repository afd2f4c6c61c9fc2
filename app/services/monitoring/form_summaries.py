"""What people said in the forms: of one person as a sheet, of everybody as numbers that fit the kind of question.

Newest answers only. Questions that were asked once and are in the settings no more are shown with the rest: they were
answered. Nothing here knows of methods, so it says the same before and after unblinding.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import mean, median, stdev

from sqlalchemy import select, true
from sqlalchemy.orm import Session

from app.domain.designs import Ending
from app.domain.participation import FormAnswer
from app.domain.protocol import LIKERT_POINTS, FormItem, Stage
from app.domain.studies import Participant, Study
from app.services.participants import forms

FORMS = (Stage.DEMOGRAPHICS, Stage.QUESTIONNAIRE)


@dataclass(frozen=True)
class Said:
    """What one person said to one question; None: left out on purpose."""

    item: FormItem
    value: str | None


@dataclass(frozen=True)
class Sheet:
    """One form of one person."""

    form: Stage
    answers: Sequence[Said]


@dataclass(frozen=True)
class Numbers:
    """Of a number or a scale; the standard deviation (n - 1) of a single answer is None."""

    mean: float
    sd: float | None
    median: float
    low: float
    high: float


@dataclass(frozen=True)
class Summary:
    """One question over everybody who came to it."""

    item: FormItem
    answered: int
    left_out: int
    counts: Sequence[tuple[str, int]]
    """Of a choice or a scale, in the order of the form; of what was typed freely nothing."""
    numbers: Numbers | None
    texts: Sequence[tuple[str, str]]
    """(code, text) of free answers, by participant."""


@dataclass(frozen=True)
class FormSummary:
    """One form over everybody."""

    form: Stage
    people: int
    """who answered any of its questions"""
    questions: Sequence[Summary]


def sheets_of(session: Session, study: Study, participant: Participant) -> Sequence[Sheet]:
    """What one person said, by form; a form they have not come to is left out."""
    sheets = []
    for form in FORMS:
        given = forms.answers_of(session, participant, form)
        items = _asked(forms.items_of(study.settings, form), given)
        answers = [Said(item, given[item.name]) for item in items if item.name in given]
        if answers:
            sheets.append(Sheet(form, answers))
    return sheets


def summaries_of(session: Session, study: Study, *, screened_out: bool = True) -> Sequence[FormSummary]:
    """What everybody said who has not withdrawn, by form; a form that nobody has come to is left out.

    ``screened_out``: with those who were sent back by what they said at the start.
    """
    kept = true() if screened_out else Participant.ended_as.is_distinct_from(Ending.SCREENED_OUT)
    rows = session.execute(
        select(FormAnswer, Participant)
        .join(Participant, Participant.id == FormAnswer.participant_id)
        .where(Participant.study_id == study.id, Participant.is_preview.is_(False), Participant.withdrawn_at.is_(None))
        .where(kept)
        .order_by(Participant.number, FormAnswer.id)
    )
    newest: dict[str, dict[str, dict[str, str | None]]] = {form: {} for form in FORMS}
    for answer, participant in rows:
        newest.setdefault(answer.form, {}).setdefault(answer.item, {})[participant.code] = answer.value
    summaries = []
    for form in FORMS:
        items = _asked(forms.items_of(study.settings, form), newest[form])
        questions = [_summary(item, newest[form][item.name]) for item in items if item.name in newest[form]]
        people = {code for by_person in newest[form].values() for code in by_person}
        if questions:
            summaries.append(FormSummary(form, len(people), questions))
    return summaries


def _asked(items: Sequence[FormItem], given: Mapping[str, object]) -> Sequence[FormItem]:
    """The questions of the settings, then those that were answered once and are asked no more."""
    known = {item.name for item in items}
    return [*items, *(FormItem(name=name, kind="text") for name in given if name not in known)]


def _summary(item: FormItem, by_person: Mapping[str, str | None]) -> Summary:
    said = {code: value for code, value in by_person.items() if value is not None}
    counted = Counter(said.values())
    fixed = {"choice": item.choices, "likert": [str(point + 1) for point in range(LIKERT_POINTS)]}.get(item.kind, ())
    counts = [(value, counted.pop(value, 0)) for value in fixed]
    numeric = item.kind in ("number", "likert")
    return Summary(
        item=item,
        answered=len(said),
        left_out=len(by_person) - len(said),
        counts=[*counts, *sorted(counted.items())] if fixed else [],
        numbers=_numbers([number for value in said.values() if (number := _number(value)) is not None])
        if numeric
        else None,
        texts=list(said.items()) if item.kind == "text" else [],
    )


def _number(value: str) -> float | None:
    try:
        return float(value)
    except ValueError:  # the question was of another kind once
        return None


def _numbers(values: Sequence[float]) -> Numbers | None:
    if not values:
        return None
    return Numbers(
        mean=mean(values),
        sd=stdev(values) if len(values) > 1 else None,
        median=median(values),
        low=min(values),
        high=max(values),
    )
