"""In which language somebody reads: what they chose, else what their browser asks for; kept to the end.

From consent on a participant's language is in their row, so that it is the same on every device. The cookie is for
pages that cannot tell: before consent, after withdrawing, and where something went wrong.
"""

import re
from collections.abc import Sequence
from datetime import timedelta
from http import HTTPStatus
from typing import Annotated, Any

from fastapi import APIRouter, Form, Request
from fastapi.responses import RedirectResponse, Response

from app.domain.protocol import Language
from app.domain.studies import Participant
from app.settings import Settings
from app.web.http.authorized_route import AuthorizedRoute
from app.web.http.deps import LANGUAGE_COOKIE, StudioDep, WritingSession, participant_or_nobody, set_cookie
from app.web.texts.wording import Wording, preferred, wording_for

router = APIRouter(prefix="/p", route_class=AuthorizedRoute)

_OUR_PAGE = re.compile(r"/(?:p|join)/[\w./?=&%~+-]*", re.ASCII)


@router.post("/language", name="choose_language")
def choose_language(
    request: Request,
    session: WritingSession,
    studio: StudioDep,
    language: Annotated[Language, Form()],
    here: Annotated[str, Form(max_length=4000)] = "",
) -> Response:
    """From now on every page in this language, on every device; back to the page one was on."""
    back = here if _OUR_PAGE.fullmatch(here) else request.app.url_path_for("show_next")
    response = RedirectResponse(back, HTTPStatus.SEE_OTHER)
    participant = participant_or_nobody(request, session)
    if participant is None:
        remember(response, studio.settings, language)
    elif language in participant.study.settings.offered_languages:
        participant.language = language
        remember(response, studio.settings, language)
    return response


def wording_of(request: Request, participant: Participant) -> Wording:
    """The texts for this participant: in the language they chose or agreed in; before that in their browser's.

    Looking settles nothing: a program that looks at links in mails has a language, too.
    """
    settings = participant.study.settings
    if participant.language is None and participant.consented_at is None:
        return wording_for(settings, of_browser(request, settings.offered_languages))
    return wording_for(settings, participant.language)  # who began with an earlier version reads in the study's


def of_browser(request: Request, offered: Sequence[Language] = tuple(Language)) -> Language:
    """The language for somebody of whom we know the browser only."""
    return preferred(request.cookies.get(LANGUAGE_COOKIE) or request.headers.get("accept-language", ""), offered)


def remember(response: Response, settings: Settings, language: Language) -> None:
    """Let pages that cannot tell who is asking be in this language, too."""
    set_cookie(response, settings, LANGUAGE_COOKIE, language, timedelta(days=settings.session_days))


def switch(request: Request, offered: Sequence[Language] = tuple(Language)) -> dict[str, Any]:
    """What a page needs to offer its languages: which, and where to come back to."""
    query = f"?{request.url.query}" if request.method == "GET" and request.url.query else ""
    return {"languages": {each: each.label for each in offered}, "here": request.url.path + query}


def nobodys(request: Request, wording: Wording, offered: Sequence[Language] = tuple(Language)) -> dict[str, Any]:
    """What a page needs that is shown to somebody unknown."""
    return {"wording": wording, **switch(request, offered)}
