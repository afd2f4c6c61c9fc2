"""Putting a study away, taking it out again, and deleting it for good."""

from http import HTTPStatus
from typing import Annotated

from fastapi import APIRouter, Form, Request
from fastapi.responses import RedirectResponse, Response
from sqlalchemy.orm import Session
from starlette.background import BackgroundTask

from app.domain.people import Experimenter
from app.domain.studies import Study
from app.services.exports import whose_rows
from app.services.studies import retirement, studies
from app.web.http.authorized_route import AuthorizedRoute
from app.web.http.deps import (
    ActingExperimenter,
    CurrentExperimenter,
    ReadingSession,
    Slug,
    StudioDep,
    StudyOwner,
    WritingSession,
)
from app.web.texts.templating import page

router = APIRouter(prefix="/studies/{slug}", route_class=AuthorizedRoute)


@router.get("/away", name="show_put_away")
def show_put_away(request: Request, slug: Slug, experimenter: CurrentExperimenter, session: ReadingSession) -> Response:
    """What putting away does, what deleting does, and the buttons for both."""
    return _page(request, session, studies.find_study(session, slug), experimenter)


@router.post("/away", name="put_study_away")
def put_study_away(request: Request, slug: Slug, experimenter: ActingExperimenter, session: WritingSession) -> Response:
    """Out of the list and out of work."""
    retirement.put_away(session, studies.find_study(session, slug), experimenter.name)
    return RedirectResponse(request.app.url_path_for("show_studies"), HTTPStatus.SEE_OTHER)


@router.post("/back", name="take_study_out")
def take_study_out(request: Request, slug: Slug, experimenter: ActingExperimenter, session: WritingSession) -> Response:
    """Back to work."""
    retirement.take_out(session, studies.find_study(session, slug), experimenter.name)
    return RedirectResponse(request.app.url_path_for("show_study", slug=slug), HTTPStatus.SEE_OTHER)


@router.post("/delete", name="delete_study")
def delete_study(
    request: Request,
    slug: Slug,
    typed: Annotated[str, Form(max_length=200)],
    experimenter: StudyOwner,
    session: WritingSession,
    studio: StudioDep,
) -> Response:
    """Erase the study and everybody in it, when an owner has typed its short name."""
    study = studies.find_study(session, slug)
    try:
        retirement.delete(session, studio.store, study, typed, experimenter.name)
    except retirement.DeletionNotConfirmed as error:
        return _page(request, session, study, experimenter, error.message, error.status)
    response = RedirectResponse(request.app.url_path_for("show_studies"), HTTPStatus.SEE_OTHER)
    response.background = BackgroundTask(studio.database.forget_erased)  # after the commit
    return response


def _page(
    request: Request,
    session: Session,
    study: Study,
    experimenter: Experimenter,
    error: str | None = None,
    status: HTTPStatus = HTTPStatus.OK,
) -> Response:
    context = {
        "study": study,
        "experimenter": experimenter,
        "people": len(whose_rows.everybody(session, study)),
        "may_delete": request.state.may_manage,
        "error": error,
    }
    return page(request, "experimenter/put_away.html", context, status)
