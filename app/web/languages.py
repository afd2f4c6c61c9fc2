"""In which language somebody reads: what they chose, else what their browser asks for; kept to the end.

A participant's language is in their row, so that it is the same on every device. The cookie is for pages that cannot
tell who is asking: before joining, after withdrawing, and where something went wrong.
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
from app.web.deps import LANGUAGE_COOKIE, StudioDep, WritingSession, participant_or_nobody, set_cookie
from app.web.wording import NAMES, Wording, preferred

router = APIRouter(prefix="/p")

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


def settle(request: Request, participant: Participant, asked: str = "") -> Language:
    """Somebody has come in: from now on this is their language, until they choose another.

    ``asked``: what is wanted more than what the browser asks for, such as a choice made before joining.
    """
    if participant.language is None and participant.consented_at is not None:
        participant.language = participant.study.settings.language  # who began with an earlier version read in this
    if participant.language is None:
        wanted = asked or request.headers.get("accept-language", "")
        participant.language = preferred(wanted, participant.study.settings.offered_languages)
    return Language(participant.language)


def of_browser(request: Request, offered: Sequence[Language] = tuple(Language)) -> Language:
    """The language for somebody of whom we know the browser only."""
    return preferred(chosen_here(request) or request.headers.get("accept-language", ""), offered)


def chosen_here(request: Request) -> str:
    """The language last used in this browser; empty when there was none."""
    return request.cookies.get(LANGUAGE_COOKIE, "")


def remember(response: Response, settings: Settings, language: Language) -> None:
    """Let pages that cannot tell who is asking be in this language, too."""
    set_cookie(response, settings, LANGUAGE_COOKIE, language, timedelta(days=settings.session_days))


def switch(request: Request, offered: Sequence[Language] = tuple(Language)) -> dict[str, Any]:
    """What a page needs to offer its languages: which, and where to come back to."""
    query = f"?{request.url.query}" if request.method == "GET" and request.url.query else ""
    return {"languages": {each: NAMES[each] for each in offered}, "here": request.url.path + query}


def nobodys(request: Request, wording: Wording, offered: Sequence[Language] = tuple(Language)) -> dict[str, Any]:
    """What a page needs that is shown to somebody unknown."""
    return {"wording": wording, **switch(request, offered)}
