"""Joining a study by its open address: through a recruitment panel, or without one.

Opening the address only shows a page: mail and chat programs open every link to look at it, and are nobody.
"""

from datetime import timedelta
from http import HTTPStatus
from typing import Any

from fastapi import APIRouter, Request
from fastapi.responses import Response
from sqlalchemy.orm import Session

from app.domain.studies import Study
from app.services.accounts import browser_sessions
from app.services.answers import next_query
from app.services.participants import recruitment_panel
from app.services.participants.recruitment_panel import Joined, PanelIdMissing
from app.web.http.authorized_route import AuthorizedRoute
from app.web.http.deps import PARTICIPANT_COOKIE, ReadingSession, StudioDep, Token, WritingSession, set_cookie
from app.web.participant.pages import go, participant_page
from app.web.texts import languages
from app.web.texts.templating import page
from app.web.texts.wording import wording_for

router = APIRouter(route_class=AuthorizedRoute)


@router.get("/join/{token}", name="join_study")
def show_joining_page(request: Request, token: Token, session: ReadingSession) -> Response:
    """The button that lets one in; whoever is in already, in this browser, goes on without it."""
    study = recruitment_panel.find_study(session, token)
    try:
        panel_id = recruitment_panel.panel_id_in(study, request.query_params)
    except PanelIdMissing:
        return _id_missing(request, study)
    if _is_in_already(request, session, study, panel_id):
        return go(request, "show_next")
    # The address as it came: the panel's parameters are read again when the button is pressed.
    context = {**_for_nobody(request, study), "action": f"{request.url.path}?{request.url.query}"}
    return page(request, "participant/join.html", context)


@router.post("/join/{token}", name="join_study_now")
def join_study(request: Request, token: Token, session: WritingSession, studio: StudioDep) -> Response:
    """Come in, once per panel id or, without one, once per browser; then on to where one should be."""
    study = recruitment_panel.find_study(session, token)
    if not study.settings.panel_parameter and _is_in_already(request, session, study, None):
        return go(request, "show_next")
    try:
        joined = recruitment_panel.join(session, study, request.query_params)
    except PanelIdMissing:
        return _id_missing(request, study)
    joined.participant.study = study
    language = languages.wording_of(request, joined.participant).language
    response = _first_page(request, studio.settings.base_url, joined)
    lifetime = timedelta(days=studio.settings.session_days)
    cookie = browser_sessions.open_for_participant(session, joined.participant, lifetime)
    next_query.seen(joined.participant)
    set_cookie(response, studio.settings, PARTICIPANT_COOKIE, cookie, lifetime)
    languages.remember(response, studio.settings, language)
    response.headers["referrer-policy"] = "no-referrer"
    return response


def _id_missing(request: Request, study: Study) -> Response:
    context = {**_for_nobody(request, study), "parameter": study.settings.panel_parameter}
    return page(request, "participant/panel_id_missing.html", context, HTTPStatus.BAD_REQUEST)


def _for_nobody(request: Request, study: Study) -> dict[str, Any]:
    """What a page needs for somebody who is not in the study yet: its words in their browser's language."""
    offered = study.settings.offered_languages
    return languages.nobodys(request, wording_for(study.settings, languages.of_browser(request, offered)), offered)


def _first_page(request: Request, base_url: str, joined: Joined) -> Response:
    """Whoever has no panel to come back through is given the personal link, this one time."""
    if joined.participant.panel_id is not None or joined.token is None:
        return go(request, "show_next")
    link = base_url + str(request.app.url_path_for("open_link", token=joined.token))
    return participant_page(request, "participant/joined.html", joined.participant, {"link": link})


def _is_in_already(request: Request, session: Session, study: Study, panel_id: str | None) -> bool:
    """Whether this browser's participant is in the study; of people who share a browser, the one the panel names."""
    cookie = request.cookies.get(PARTICIPANT_COOKIE)
    participant = browser_sessions.participant_of(session, cookie) if cookie else None
    if participant is None or participant.study_id != study.id:
        return False
    return panel_id is None or participant.panel_id == panel_id
