"""The browser of answers: every pair with both clips, what was said of it, and leaving an answer out with a reason."""

from http import HTTPStatus
from typing import Annotated, Any, Literal
from urllib.parse import urlencode

from fastapi import APIRouter, Depends, Form, Query, Request
from fastapi.responses import RedirectResponse, Response
from sqlalchemy.orm import Session

from app.domain.people import Experimenter
from app.domain.preferences import Purpose
from app.domain.preferences import Response as Said
from app.domain.studies import Participant, Study
from app.services import audit
from app.services.answers import answers, exclusions
from app.services.answers.answers import Mark, Wanted
from app.services.exports import whose_rows
from app.services.participants import enrolment
from app.services.studies import studies
from app.web.http.authorized_route import AuthorizedRoute
from app.web.http.deps import (
    ActingExperimenter,
    CurrentExperimenter,
    ReadingSession,
    RowId,
    Slug,
    Studio,
    StudioDep,
    WritingSession,
)
from app.web.texts.templating import page

router = APIRouter(prefix="/studies/{slug}/answers", route_class=AuthorizedRoute)

NOTHING: Literal[""] = ""
Reason = Annotated[str, Form(max_length=exclusions.LONGEST_REASON)]


def _wanted(
    participant: Annotated[str, Query(pattern=r"^(P[0-9]{2,8})?$")] = "",
    purpose: Purpose | Literal[""] = NOTHING,
    response: Said | Literal[""] = NOTHING,
    mark: Mark | Literal[""] = NOTHING,
    page: Annotated[int, Query(ge=1, le=100_000)] = 1,
) -> Wanted:
    """What the form above the answers asks for; what is empty does not matter."""
    return Wanted(participant or None, purpose or None, response or None, mark or None, page)


WantedAnswers = Annotated[Wanted, Depends(_wanted)]


@router.get("", name="show_answers")
def show_answers(
    request: Request,
    slug: Slug,
    wanted: WantedAnswers,
    experimenter: CurrentExperimenter,
    session: ReadingSession,
    studio: StudioDep,
) -> Response:
    """The answers that are wanted, page by page."""
    study = studies.find_study(session, slug)
    people = whose_rows.everybody(session, study)
    person = next((each for each in people if each.code == wanted.code), None)
    _note_looking(studio, session, experimenter, study, person)
    context = {
        "study": study,
        "settings": study.settings,
        "experimenter": experimenter,
        "found": answers.find(session, study, wanted),
        "wanted": wanted,
        "people": [each.code for each in people if each.withdrawn_at is None],
        "purposes": list(Purpose),
        "responses": list(Said),
        "marks": list(Mark),
        "query_string": query_string,
        "scripted": enrolment.count_scripted(session, study),
    }
    return page(request, "experimenter/answers.html", context)


@router.get("/{query_id}", name="show_answer")
def show_answer(
    request: Request,
    slug: Slug,
    query_id: RowId,
    wanted: WantedAnswers,
    experimenter: CurrentExperimenter,
    session: ReadingSession,
    studio: StudioDep,
) -> Response:
    """One answer: both clips to play, how they were watched, everything that was ever said of the pair."""
    study = studies.find_study(session, slug)
    looked = answers.look(session, study, query_id, wanted)
    _note_looking(studio, session, experimenter, study, looked.given.participant)
    context = {
        "study": study,
        "settings": study.settings,
        "experimenter": experimenter,
        "looked": looked,
        "wanted": wanted,
        "query_string": query_string,
        "longest_reason": exclusions.LONGEST_REASON,
    }
    return page(request, "experimenter/answer.html", context)


@router.post("/{query_id}/exclude", name="exclude_answer")
def exclude_answer(
    request: Request,
    slug: Slug,
    query_id: RowId,
    reason: Reason,
    wanted: WantedAnswers,
    experimenter: ActingExperimenter,
    session: WritingSession,
) -> Response:
    """Leave the answer out of learning and statistics."""
    exclusions.exclude(session, studies.find_study(session, slug), query_id, reason, experimenter.name)
    return _back(request, slug, query_id, wanted)


@router.post("/{query_id}/include", name="include_answer")
def include_answer(
    request: Request,
    slug: Slug,
    query_id: RowId,
    wanted: WantedAnswers,
    experimenter: ActingExperimenter,
    session: WritingSession,
) -> Response:
    """Take the answer in again."""
    exclusions.include(session, studies.find_study(session, slug), query_id, experimenter.name)
    return _back(request, slug, query_id, wanted)


def _note_looking(
    studio: Studio, session: Session, experimenter: Experimenter, study: Study, person: Participant | None
) -> None:
    subject = study.slug if person is None else f"{study.slug}/{person.code}"
    audit.note_reading(
        studio.database, session, experimenter.name, "answers viewed", subject, study=study, participant=person
    )


def query_string(wanted: Wanted, page: int = 1) -> str:
    """The part of an address that asks for these answers, with its question mark; nothing for all of them."""
    asked: dict[str, Any] = {
        "participant": wanted.code,
        "purpose": wanted.purpose,
        "response": wanted.response,
        "mark": wanted.mark,
        "page": page if page > 1 else None,
    }
    written = urlencode({name: value for name, value in asked.items() if value is not None})
    return f"?{written}" if written else ""


def _back(request: Request, slug: str, query_id: int, wanted: Wanted) -> Response:
    address = request.app.url_path_for("show_answer", slug=slug, query_id=query_id)
    return RedirectResponse(f"{address}{query_string(wanted, wanted.page)}", HTTPStatus.SEE_OTHER)
