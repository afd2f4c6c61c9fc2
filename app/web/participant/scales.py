"""Standard questionnaires: a page each, at the end of a study or about one robot of its evaluation."""

from collections.abc import Mapping
from dataclasses import dataclass
from http import HTTPStatus
from typing import Annotated, Any

from fastapi import APIRouter, Path, Request
from fastapi.responses import RedirectResponse, Response
from sqlalchemy.orm import Session

from app.domain.protocol import Language, Stage
from app.domain.studies import Participant
from app.domain.study_settings import StudySettings
from app.questionnaires import library
from app.questionnaires.library import Instrument, Item
from app.services.answers import form_answers
from app.services.evaluation import evaluation_plan, ratings
from app.services.participants import forms, stages
from app.services.participants.forms import AnswerProblem
from app.web.http.authorized_route import AuthorizedRoute
from app.web.http.deps import NotYet, StudioDep, Typed, WritingSession
from app.web.participant.evaluation import AtEvaluation, next_path
from app.web.participant.pages import back_from, go, has_reached, participant_page
from app.web.texts.languages import wording_of
from app.web.texts.wording import Wording

router = APIRouter(prefix="/p", route_class=AuthorizedRoute)

AtQuestionnaire = Annotated[Participant, has_reached(Stage.QUESTIONNAIRE)]
Name = Annotated[str, Path(pattern=r"^[a-z][a-z0-9_]{0,19}$")]
Letter = Annotated[str, Path(pattern=r"^[A-E]$")]
ON_PURPOSE = "on_purpose"
"""Sent with a page that has said what is missing, and then goes on without it."""
MANY = 12
"""More points than this stand in several rows on a phone."""


@dataclass(frozen=True)
class Asked:
    """One item as the page needs it."""

    name: str
    question: str
    points: list[tuple[str, str]]
    """What is stored, and what is shown: the point, or its name."""
    low: str
    high: str
    is_named: bool
    """False: it is called by its two ends, which stand above the points anyway."""
    value: str
    problem: str | None


@router.get("/questionnaire/{instrument}", name="show_scale")
def show_scale(request: Request, instrument: Name, participant: AtQuestionnaire, session: WritingSession) -> Response:
    """One of the standard questionnaires at the end; once more, where something was left out."""
    asked = _asked_at_the_end(participant.study.settings, instrument)
    return _page(request, participant, asked, None, _given(session, participant, asked, None), {})


@router.post("/questionnaire/{instrument}", name="save_scale")
def save_scale(
    request: Request, instrument: Name, participant: AtQuestionnaire, session: WritingSession, typed: Typed
) -> Response:
    """Keep the answers; the next questionnaire, or the study's own questions."""
    settings = participant.study.settings
    asked = _asked_at_the_end(settings, instrument)
    wrong = forms.wrong_points(asked, typed)
    if wrong:
        return _page(request, participant, asked, None, typed, wrong)
    forms.record_instrument(session, participant, asked, typed, None)
    if _may_be_oversight(asked, typed):
        return _once_more(request)
    following = settings.instruments[settings.instruments.index(instrument) + 1 :]
    if following:
        return _to_scale(request, following[0])
    if settings.closing_form:
        return go(request, "show_questionnaire")
    return finished(request, session, participant)


@router.get("/evaluation/robots/{letter}/{instrument}", name="show_robot_scale")
def show_robot_scale(
    request: Request, letter: Letter, instrument: Name, participant: AtEvaluation, session: WritingSession
) -> Response:
    """One of the standard questionnaires about one robot."""
    asked = _asked_about_robot(session, participant, letter, instrument)
    return _page(request, participant, asked, letter, _given(session, participant, asked, letter), {})


@router.post("/evaluation/robots/{letter}/{instrument}", name="save_robot_scale")
def save_robot_scale(
    request: Request,
    letter: Letter,
    instrument: Name,
    participant: AtEvaluation,
    session: WritingSession,
    studio: StudioDep,
    typed: Typed,
) -> Response:
    """Keep the answers; the next questionnaire about this robot, or the next robot."""
    asked = _asked_about_robot(session, participant, letter, instrument)
    if participant.completed_at is not None:
        raise ratings.CorrectionTooLate
    wrong = forms.wrong_points(asked, typed)
    if wrong:
        return _page(request, participant, asked, letter, typed, wrong)
    forms.record_instrument(session, participant, asked, typed, letter)
    if _may_be_oversight(asked, typed):
        return _once_more(request)
    turn = evaluation_plan.next_turn(session, studio.store, participant)
    return RedirectResponse(next_path(request, turn), HTTPStatus.SEE_OTHER)


def open_scale(request: Request, session: Session, participant: Participant) -> Response | None:
    """To the first questionnaire at the end that has not been sent; None when all have."""
    found = form_answers.first_open(session, participant, participant.study.settings.instruments)
    return None if found is None else _to_scale(request, found.name)


def finished(request: Request, session: Session, participant: Participant) -> Response:
    """The stage is through once every questionnaire has been sent; else back to the one that has not."""
    missing = open_scale(request, session, participant)
    if missing is None:
        stages.finish(session, participant, Stage.QUESTIONNAIRE)
    return missing or go(request, "show_next")


def last_scale_path(request: Request, settings: StudySettings) -> str | None:
    """The page before the study's own questions; None where there are no standard ones."""
    return _path(request, settings.instruments[-1]) if settings.instruments else None


def _path(request: Request, instrument: str) -> str:
    return str(request.app.url_path_for("show_scale", instrument=instrument))


def _to_scale(request: Request, instrument: str) -> RedirectResponse:
    return RedirectResponse(_path(request, instrument), HTTPStatus.SEE_OTHER)


def _may_be_oversight(instrument: Instrument, typed: Mapping[str, str]) -> bool:
    """Whether to ask once more: validated questionnaires lose their score with an item that was overlooked."""
    return ON_PURPOSE not in typed and any(not typed.get(item.name) for item in instrument.items)


def _once_more(request: Request) -> RedirectResponse:
    """The same page, which says what is missing. What was sent is stored already."""
    return RedirectResponse(f"{request.url.path}?{ON_PURPOSE}", HTTPStatus.SEE_OTHER)


def _asked_at_the_end(settings: StudySettings, instrument: str) -> Instrument:
    if instrument not in settings.instruments:
        raise NotYet
    return library.every()[instrument]


def _asked_about_robot(session: Session, participant: Participant, letter: str, instrument: str) -> Instrument:
    """A robot can be described once all its trials are rated."""
    settings = evaluation_plan.settings_of(participant.study)
    theirs = [each for each in evaluation_plan.trials_of(session, participant.id) if each.letter == letter]
    rated = evaluation_plan.ratings_of(session, participant.id)
    if settings is None or instrument not in settings.instruments or not theirs:
        raise NotYet
    if any(each.id not in rated for each in theirs):
        raise NotYet
    return library.every()[instrument]


def _given(session: Session, participant: Participant, instrument: Instrument, letter: str | None) -> Mapping[str, str]:
    known = form_answers.newest(session, participant, instrument.name, letter)
    return {name: value or "" for name, value in known.items()}


def _page(
    request: Request,
    participant: Participant,
    instrument: Instrument,
    letter: str | None,
    values: Mapping[str, str],
    wrong: Mapping[str, AnswerProblem],
) -> Response:
    settings = participant.study.settings
    wording = wording_of(request, participant)
    words = _words(settings, instrument, wording)
    names = settings.instruments
    place = names.index(instrument.name) + 1 if letter is None else 0
    back = _path(request, names[place - 2]) if place > 1 else back_from(request, settings, Stage.QUESTIONNAIRE)
    context: dict[str, Any] = {
        "letter": letter,
        "action": request.url.path,
        "instruction": words["instruction"],
        "fields": [_item(item, instrument, words, values, wrong.get(item.name), wording) for item in instrument.items],
        "on_purpose": ON_PURPOSE if ON_PURPOSE in request.query_params else None,
        "left_out": sum(not values.get(item.name) for item in instrument.items),
        "labelled": bool(instrument.answers.labels.en),
        "many": len(instrument.answers.points) > MANY,
        "first_wrong": next(iter(wrong), None),
        "problem_count": len(wrong),
        "place": place,
        "places": len(names) + bool(settings.closing_form),
        "back_path": back if letter is None else None,
    }
    status = HTTPStatus.UNPROCESSABLE_ENTITY if wrong else HTTPStatus.OK
    return participant_page(request, "participant/scale.html", participant, context, status)


def _words(settings: StudySettings, instrument: Instrument, wording: Wording) -> Mapping[str, str]:
    """The words of every part: the study's own where it has some for this language, else as published."""
    language = Language(wording.language)
    return {
        part: wording(library.text_name(instrument.name, part))
        if settings.own_words(instrument.name, part, language)
        else published
        for part, published in instrument.published(language.value).items()
    }


def _item(
    item: Item,
    instrument: Instrument,
    words: Mapping[str, str],
    values: Mapping[str, str],
    problem: AnswerProblem | None,
    wording: Wording,
) -> Asked:
    low, high = (words.get(f"{item.name}-{end}") or words[end] for end in ("low", "high"))
    points = instrument.answers.points
    labels = getattr(instrument.answers.labels, wording.language.value) or points
    return Asked(
        name=item.name,
        question=words.get(item.name) or f"{low} \N{EN DASH} {high}",
        points=list(zip(points, labels, strict=True)),
        low=low,
        high=high,
        is_named=item.name in words,
        value=values.get(item.name, ""),
        problem=wording(problem) if problem else None,
    )
