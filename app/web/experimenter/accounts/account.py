"""One's own account: where one is logged in, and the way to password, second factor and tokens."""

from http import HTTPStatus

from fastapi import APIRouter, Request
from fastapi.responses import RedirectResponse, Response

from app.services.accounts import browser_sessions, second_factor
from app.web.http.authorized_route import AuthorizedRoute
from app.web.http.deps import (
    EXPERIMENTER_COOKIE,
    CurrentExperimenter,
    OwnAccount,
    ReadingSession,
    RowId,
    WritingSession,
)
from app.web.texts.templating import page

router = APIRouter(prefix="/account", route_class=AuthorizedRoute)


@router.get("", name="show_own_account")
def show_own_account(request: Request, experimenter: CurrentExperimenter, session: ReadingSession) -> Response:
    """Password, second factor, tokens, and every browser that is logged in."""
    cookie = request.cookies.get(EXPERIMENTER_COOKIE, "")
    context = {
        "experimenter": experimenter,
        "logins": browser_sessions.of_experimenter(session, experimenter, cookie),
        "second_factor": second_factor.is_on(experimenter),
    }
    return page(request, "experimenter/account.html", context)


@router.post("/logins/{session_id}/end", name="end_login")
def end_login(request: Request, session_id: RowId, experimenter: OwnAccount, session: WritingSession) -> Response:
    """Log out another browser at once."""
    browser_sessions.end(session, experimenter, session_id)
    return RedirectResponse(request.app.url_path_for("show_own_account"), HTTPStatus.SEE_OTHER)


@router.post("/logins/end-others", name="end_other_logins")
def end_other_logins(request: Request, experimenter: OwnAccount, session: WritingSession) -> Response:
    """Log out every browser but this one."""
    browser_sessions.end_others(session, experimenter, request.cookies.get(EXPERIMENTER_COOKIE, ""))
    return RedirectResponse(request.app.url_path_for("show_own_account"), HTTPStatus.SEE_OTHER)
