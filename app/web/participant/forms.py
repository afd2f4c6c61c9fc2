"""Demographics and questionnaire: questions that may be left out, and corrected later."""

from collections.abc import Mapping
from dataclasses import dataclass
from http import HTTPStatus
from typing import Annotated

from fastapi import APIRouter, Request
from fastapi.responses import RedirectResponse, Response

from app.domain.protocol import LIKERT_POINTS, FormItem, Stage
from app.domain.studies import Participant
from app.services.participants import forms, stages
from app.services.participants.forms import MOST_CHARACTERS, AnswerProblem
from app.web.http.authorized_route import AuthorizedRoute
from app.web.http.deps import Typed, WritingSession
from app.web.participant import scales
from app.web.participant.pages import back_from, go, has_reached, participant_page
from app.web.texts.form_questions import choice_of, label_of, question_of
from app.web.texts.languages import wording_of
from app.web.texts.wording import Wording

router = APIRouter(prefix="/p", route_class=AuthorizedRoute)


AtDemographics = Annotated[Participant, has_reached(Stage.DEMOGRAPHICS)]
AtQuestionnaire = Annotated[Participant, has_reached(Stage.QUESTIONNAIRE)]


@dataclass(frozen=True)
class Question:
    """One question as the page needs it."""

    name: str
    kind: str
    question: str
    choices: list[tuple[str, str]]
    """What is stored, and what is shown."""
    low_label: str
    high_label: str
    value: str
    problem: str | None


@router.get("/demographics", name="show_demographics")
def show_demographics(request: Request, participant: AtDemographics, session: WritingSession) -> Response:
    """Questions about the person."""
    return _form(request, participant, Stage.DEMOGRAPHICS, _answered(session, participant, Stage.DEMOGRAPHICS), {})


@router.post("/demographics", name="save_demographics")
def save_demographics(request: Request, participant: AtDemographics, session: WritingSession, typed: Typed) -> Response:
    """Keep what was said."""
    return _save(request, session, participant, Stage.DEMOGRAPHICS, typed)


@router.get("/questionnaire", name="show_questionnaire")
def show_questionnaire(request: Request, participant: AtQuestionnaire, session: WritingSession) -> Response:
    """Questions about how it was; standard questionnaires come before the study's own."""
    before = scales.open_scale(request, session, participant)
    if before is None and not participant.study.settings.closing_form:
        before = RedirectResponse(scales.last_scale_path(request, participant.study.settings) or "/p/next", 303)
    if before is not None:
        return before
    return _form(request, participant, Stage.QUESTIONNAIRE, _answered(session, participant, Stage.QUESTIONNAIRE), {})


@router.post("/questionnaire", name="save_questionnaire")
def save_questionnaire(
    request: Request, participant: AtQuestionnaire, session: WritingSession, typed: Typed
) -> Response:
    """Keep what was said."""
    return _save(request, session, participant, Stage.QUESTIONNAIRE, typed)


def _answered(session: WritingSession, participant: Participant, form: Stage) -> Mapping[str, str]:
    return {name: value or "" for name, value in forms.answers_of(session, participant, form).items()}


def _save(
    request: Request, session: WritingSession, participant: Participant, form: Stage, typed: Mapping[str, str]
) -> Response:
    items = forms.items_of(participant.study.settings, form)
    wrong = forms.problems(items, typed)
    if wrong:
        return _form(request, participant, form, typed, wrong)
    forms.record(session, participant, form, items, typed)
    if form is Stage.QUESTIONNAIRE:
        return scales.finished(request, session, participant)
    stages.finish(session, participant, form)
    return go(request, "show_next")


def _form(
    request: Request,
    participant: Participant,
    form: Stage,
    values: Mapping[str, str],
    wrong: Mapping[str, AnswerProblem],
) -> Response:
    settings = participant.study.settings
    wording = wording_of(request, participant)
    before = scales.last_scale_path(request, settings) if form is Stage.QUESTIONNAIRE else None
    fields = [_field(wording, item, values, wrong.get(item.name)) for item in forms.items_of(settings, form)]
    context = {
        "form": form.value,
        "action": request.url.path,
        "fields": fields,
        "points": [(str(point), str(point)) for point in range(1, LIKERT_POINTS + 1)],
        "first_wrong": next(iter(wrong), None),
        "problem_count": len(wrong),
        "most_characters": MOST_CHARACTERS,
        "back_path": before or back_from(request, settings, form),
    }
    status = HTTPStatus.UNPROCESSABLE_ENTITY if wrong else HTTPStatus.OK
    return participant_page(request, "participant/form.html", participant, context, status)


def _field(wording: Wording, item: FormItem, values: Mapping[str, str], problem: AnswerProblem | None) -> Question:
    return Question(
        name=item.name,
        kind=item.kind,
        question=question_of(wording, item),
        choices=[(choice, choice_of(wording, item, place)) for place, choice in enumerate(item.choices, 1)],
        low_label=label_of(wording, item, "low", item.low_label),
        high_label=label_of(wording, item, "high", item.high_label),
        value=values.get(item.name, ""),
        problem=wording(problem, count=MOST_CHARACTERS) if problem else None,
    )
