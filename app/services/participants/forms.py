"""Forms: questions that a study asks besides the pairs. Every answer may be left out, corrected, and is kept."""

import re
from collections.abc import Mapping, Sequence
from enum import StrEnum

from sqlalchemy.orm import Session

from app.domain.protocol import LIKERT_POINTS, FormItem, Stage
from app.domain.studies import Participant
from app.domain.study_settings import StudySettings
from app.questionnaires.library import Instrument
from app.services.answers import form_answers

MOST_CHARACTERS = 4000
_NUMBER = re.compile(r"[+\-\N{MINUS SIGN}]?[0-9]{1,12}([.,][0-9]{1,12})?")
"""28, 28.5 and 28,5."""


class AnswerProblem(StrEnum):
    """Why an answer cannot be kept as it is; also names the message that says so."""

    NUMBER = "form-number-problem"
    LONG = "form-long-problem"
    CHOICE = "form-choice-problem"


def items_of(settings: StudySettings, form: Stage) -> Sequence[FormItem]:
    """The questions of a form."""
    return settings.demographics if form is Stage.DEMOGRAPHICS else settings.closing_form


def answers_of(session: Session, participant: Participant, form: Stage) -> dict[str, str | None]:
    """The newest answer to every question that was put; None where it was left out."""
    return form_answers.newest(session, participant, form)


def problems(items: Sequence[FormItem], given: Mapping[str, str]) -> dict[str, AnswerProblem]:
    """What is wrong with answers as they were typed, by question."""
    found = {item.name: _problem(item, given.get(item.name, "").strip()) for item in items}
    return {name: problem for name, problem in found.items() if problem is not None}


def record(
    session: Session, participant: Participant, form: Stage, items: Sequence[FormItem], given: Mapping[str, str]
) -> None:
    """Append what differs from the answers so far; the answers have no problems."""
    values = {item.name: _stored(item, given.get(item.name, "").strip()) for item in items}
    form_answers.append(session, participant, form, values)


def wrong_points(instrument: Instrument, given: Mapping[str, str]) -> dict[str, AnswerProblem]:
    """Items of a standard questionnaire whose answer is none of its points, nor left out."""
    allowed = {"", *instrument.answers.points}
    return {item.name: AnswerProblem.CHOICE for item in instrument.items if given.get(item.name, "") not in allowed}


def record_instrument(
    session: Session, participant: Participant, instrument: Instrument, given: Mapping[str, str], letter: str | None
) -> None:
    """Keep the answers to a whole questionnaire, about the robot of this letter or about none."""
    values = {item.name: given.get(item.name) or None for item in instrument.items}
    form_answers.append(session, participant, instrument.name, values, letter)


def _problem(item: FormItem, text: str) -> AnswerProblem | None:
    if not text:
        return None
    if item.kind == "number":
        return None if _NUMBER.fullmatch(text) else AnswerProblem.NUMBER
    if item.kind == "text":
        return AnswerProblem.LONG if len(text) > MOST_CHARACTERS else None
    possible = item.choices if item.kind == "choice" else [str(point + 1) for point in range(LIKERT_POINTS)]
    return None if text in possible else AnswerProblem.CHOICE


def _stored(item: FormItem, text: str) -> str | None:
    """As it was typed; only the decimal sign becomes a point."""
    if not text:
        return None
    return text.replace(",", ".").replace("\N{MINUS SIGN}", "-") if item.kind == "number" else text
