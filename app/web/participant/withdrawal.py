"""Leaving for good: what will happen, the confirmation, and the page that is left."""

from http import HTTPStatus

from fastapi import APIRouter, Request
from fastapi.responses import RedirectResponse, Response
from starlette.background import BackgroundTask

from app.services import audit
from app.services.participants import withdrawal
from app.web.http.authorized_route import AuthorizedRoute
from app.web.http.deps import PARTICIPANT_COOKIE, CurrentParticipant, StudioDep, WritingSession
from app.web.participant.pages import participant_page
from app.web.texts import languages
from app.web.texts.templating import page
from app.web.texts.wording import Wording

router = APIRouter(prefix="/p", route_class=AuthorizedRoute)


@router.get("/withdraw", name="show_withdraw")
def show_withdraw(request: Request, participant: CurrentParticipant) -> Response:
    """What withdrawing means."""
    return participant_page(request, "participant/withdraw.html", participant)


@router.post("/withdraw", name="withdraw")
def withdraw(
    request: Request,
    participant: CurrentParticipant,
    session: WritingSession,
    studio: StudioDep,
) -> Response:
    """Erase everything about this person; the bytes that a database keeps of what was erased go right afterwards."""
    language = languages.wording_of(request, participant).language
    withdrawal.withdraw(session, studio.store, participant, audit.PARTICIPANT)
    address = request.app.url_path_for("show_withdrawn")
    response = RedirectResponse(address, HTTPStatus.SEE_OTHER)
    languages.remember(response, studio.settings, language)
    response.background = BackgroundTask(studio.database.forget_erased)  # after the commit
    response.delete_cookie(PARTICIPANT_COOKIE)
    return response


@router.get("/withdrawn", name="show_withdrawn")
def show_withdrawn(request: Request) -> Response:
    """All that is left. Says nothing of anybody, so anybody may see it."""
    context = languages.nobodys(request, Wording(languages.of_browser(request)))
    return page(request, "participant/withdrawn.html", context)
