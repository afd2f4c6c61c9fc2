"""Joining a study by its open address: through a recruitment panel, or without one."""

from datetime import timedelta
from http import HTTPStatus

from fastapi import APIRouter, Request
from fastapi.responses import Response

from app.services import browser_sessions, panel, querying
from app.services.panel import Joined, PanelIdMissing
from app.web import languages
from app.web.deps import PARTICIPANT_COOKIE, StudioDep, Token, WritingSession, set_cookie
from app.web.participant_pages import go, participant_page
from app.web.templating import page
from app.web.wording import wording_for

router = APIRouter()


@router.get("/join/{token}", name="join_study")
def join_study(request: Request, token: Token, session: WritingSession, studio: StudioDep) -> Response:
    """Come in, once per panel id or, without one, once per browser; then on to where one should be."""
    study = panel.find_study(session, token)
    if not study.settings.panel_parameter and _is_in_already(request, session, study.id):
        return go(request, "show_next")
    try:
        joined = panel.join(session, study, request.query_params)
    except PanelIdMissing:
        offered = study.settings.offered_languages
        wording = wording_for(study.settings, languages.of_browser(request, offered))
        context = {**languages.nobodys(request, wording, offered), "parameter": study.settings.panel_parameter}
        return page(request, "participant/panel_id_missing.html", context, HTTPStatus.BAD_REQUEST)
    joined.participant.study = study
    language = languages.settle(request, joined.participant, languages.chosen_here(request))
    response = _first_page(request, studio.settings.base_url, joined)
    lifetime = timedelta(days=studio.settings.session_days)
    cookie = browser_sessions.open_for_participant(session, joined.participant, lifetime)
    querying.seen(joined.participant)
    set_cookie(response, studio.settings, PARTICIPANT_COOKIE, cookie, lifetime)
    languages.remember(response, studio.settings, language)
    response.headers["referrer-policy"] = "no-referrer"
    return response


def _first_page(request: Request, base_url: str, joined: Joined) -> Response:
    """Whoever has no panel to come back through is given the personal link, this one time."""
    if joined.participant.panel_id is not None or joined.token is None:
        return go(request, "show_next")
    link = base_url + str(request.app.url_path_for("open_link", token=joined.token))
    return participant_page(request, "participant/joined.html", joined.participant, {"link": link})


def _is_in_already(request: Request, session: WritingSession, study_id: int) -> bool:
    cookie = request.cookies.get(PARTICIPANT_COOKIE)
    participant = browser_sessions.participant_of(session, cookie) if cookie else None
    return participant is not None and participant.study_id == study_id
