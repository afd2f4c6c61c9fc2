"""Every error as a page a person can do something with, or as a problem (RFC 9457) for scripts."""

import re
from collections.abc import Mapping
from http import HTTPStatus

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, RedirectResponse, Response
from sqlalchemy.exc import DatabaseError, OperationalError
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect

from app.db import complaints
from app.errors import AppError, Refused, in_words
from app.web.http import refusals, request_log
from app.web.http.deps import (
    EXPERIMENTER_COOKIE,
    PARTICIPANT_COOKIE,
    LoginNeeded,
    NotSaved,
    NotYet,
    PasswordChangeDue,
    SecondFactorNeeded,
)
from app.web.http.security import HEADERS
from app.web.texts import languages
from app.web.texts.templating import page
from app.web.texts.wording import Wording

_FOR_PROGRAMS = "/api/v1/"
"""Addresses with a line break do not reach the application that is mounted there."""
_TITLES = {
    HTTPStatus.UNAUTHORIZED: "Please log in",
    HTTPStatus.FORBIDDEN: "That is not allowed",
    HTTPStatus.NOT_FOUND: "Page not found",
    HTTPStatus.CONFLICT: "That is no longer possible",
    HTTPStatus.GONE: "This study is closed",
    HTTPStatus.TOO_MANY_REQUESTS: "A moment, please",
    HTTPStatus.SERVICE_UNAVAILABLE: "A moment, please",
    HTTPStatus.INTERNAL_SERVER_ERROR: "Something went wrong",
}
_MESSAGES = {
    HTTPStatus.NOT_FOUND: "There is no page at this address.",
    HTTPStatus.METHOD_NOT_ALLOWED: "This address cannot be used in that way.",
    HTTPStatus.REQUEST_ENTITY_TOO_LARGE: "That was more than we accept at once.",
}


def wants_json(request: Request) -> bool:
    """Whether the answer goes to a script rather than to a person."""
    accepted = request.headers.get("accept", "")
    return "json" in accepted and "text/html" not in accepted


def error_page(request: Request, error: AppError) -> Response:
    """The page or problem for an error of ours."""
    return _answer(request, error.status, error.message, key=type(error).__name__)


def add_error_pages(app: FastAPI) -> None:
    """Give every kind of failure its page."""

    @app.exception_handler(AppError)
    def ours(request: Request, error: AppError) -> Response:
        return error_page(request, error)

    @app.exception_handler(Refused)
    def refused(request: Request, error: Refused) -> Response:
        refusals.note(request)
        return error_page(request, error)

    @app.exception_handler(LoginNeeded)
    def login_needed(request: Request, error: LoginNeeded) -> Response:
        if request.method != "GET":
            error = NotSaved() if EXPERIMENTER_COOKIE in request.cookies else error
        if wants_json(request) or request.method != "GET":
            return error_page(request, error)
        target = request.app.url_path_for("show_login")
        return RedirectResponse(f"{target}?next={request.url.path}", HTTPStatus.SEE_OTHER)

    @app.exception_handler(NotYet)
    def not_yet(request: Request, error: NotYet) -> Response:
        if wants_json(request):
            return error_page(request, error)
        return RedirectResponse(request.app.url_path_for("show_next"), HTTPStatus.SEE_OTHER)

    @app.exception_handler(PasswordChangeDue)
    def password_change_due(request: Request, error: PasswordChangeDue) -> Response:
        if wants_json(request):
            return error_page(request, error)
        return RedirectResponse(request.app.url_path_for("show_password"), HTTPStatus.SEE_OTHER)

    @app.exception_handler(SecondFactorNeeded)
    def second_factor_needed(request: Request, error: SecondFactorNeeded) -> Response:
        if wants_json(request):
            return error_page(request, error)
        return RedirectResponse(request.app.url_path_for("show_second_factor"), HTTPStatus.SEE_OTHER)

    @app.exception_handler(HTTPException)
    def of_the_framework(request: Request, error: HTTPException) -> Response:
        status = HTTPStatus(error.status_code)
        message = _MESSAGES.get(status, "This request could not be understood.")
        key = "PageNotFound" if status is HTTPStatus.NOT_FOUND else "NotUnderstood"
        return _answer(request, status, message, error.headers, key)

    @app.exception_handler(RequestValidationError)
    def not_valid(request: Request, error: RequestValidationError) -> Response:
        places = {str(each["loc"][0]) for each in error.errors() if each["loc"]}
        if "path" in places:
            return _answer(request, HTTPStatus.NOT_FOUND, _MESSAGES[HTTPStatus.NOT_FOUND], key="PageNotFound")
        fields = sorted({str(each["loc"][-1]) for each in error.errors() if each["loc"]})
        message = f"Something in this form is missing or not valid: {', '.join(fields)}. Please go back and check it."
        return _answer(request, HTTPStatus.UNPROCESSABLE_ENTITY, message, key="NotUnderstood")

    @app.exception_handler(ClientDisconnect)
    def broken_off(_request: Request, _error: ClientDisconnect) -> Response:
        return Response(status_code=HTTPStatus.BAD_REQUEST)  # nobody is there to read it, and nothing is wrong here

    @app.exception_handler(OperationalError)
    def database_busy(request: Request, error: OperationalError) -> Response:
        complaints.error("the database did not answer: %s", error.orig)
        message = "The database is busy or not ready. Nothing was saved; please try again in a moment."
        return _answer(request, HTTPStatus.SERVICE_UNAVAILABLE, message, {"retry-after": "2"}, "DatabaseBusy")

    @app.exception_handler(DatabaseError)
    def database_damaged(request: Request, error: DatabaseError) -> Response:
        if in_words(error) is None:
            raise error
        complaints.error("the database cannot be used: %s", error.orig)
        message = "The database cannot be used at the moment. Nothing was saved; please tell the experimenter."
        return _answer(request, HTTPStatus.SERVICE_UNAVAILABLE, message, {"retry-after": "60"}, "DatabaseBusy")

    @app.exception_handler(Exception)
    def unforeseen(request: Request, _error: Exception) -> Response:
        # The server logs the traceback; this tells the person that nothing they did was lost silently.
        message = "This is our fault, and it is in the log. Nothing was saved by this step; please try again."
        # made outside of what adds these headers to every other answer
        headers = {**HEADERS, request_log.HEADER: request.scope.get(request_log.HEADER, "")}
        return _answer(request, HTTPStatus.INTERNAL_SERVER_ERROR, message, headers, "Unforeseen")


def _answer(
    request: Request, status: HTTPStatus, message: str, headers: Mapping[str, str] | None = None, key: str = ""
) -> Response:
    """``key``: the name of what happened, under which participants are told in their own language."""
    title = _TITLES.get(status, "That did not work")
    wording = _wording(request)
    if wording is not None:
        title, message = _for_participants(wording, status, message, key)
    answer: Response
    if wants_json(request) or request.url.path.startswith(_FOR_PROGRAMS):
        problem = {"title": title, "status": status, "detail": message}
        answer = JSONResponse(problem, status, media_type="application/problem+json")
    else:
        known = (EXPERIMENTER_COOKIE if wording is None else PARTICIPANT_COOKIE) in request.cookies
        onward = request.app.url_path_for("show_studies" if wording is None else "show_next")
        context = {"title": title, "message": message, "status": int(status), "wording": wording}
        if wording is not None:
            context |= languages.switch(request)
            if request.method != "GET":
                context["here"] = request.app.url_path_for("show_next")
        leads_on = known and status not in (HTTPStatus.UNAUTHORIZED, HTTPStatus.GONE)
        context |= {"onward_path": onward if leads_on else None}
        answer = page(request, "error.html", context, status)
    answer.headers.update(headers or {})
    return answer


def _wording(request: Request) -> Wording | None:
    """On the participants' pages: in the language last used in this browser, else the one it asks for."""
    if not request.url.path.startswith(("/p/", "/join/")):
        return None
    return Wording(languages.of_browser(request))


def _for_participants(wording: Wording, status: HTTPStatus, message: str, key: str) -> tuple[str, str]:
    name = "error-" + "-".join(word.lower() for word in re.findall("[A-Z][a-z]*", key))
    titles = (name.replace("error-", "error-title-", 1), f"error-title-{status.value}", "error-title-other")
    return (
        wording(next(each for each in titles if each in wording)),
        wording(name) if name in wording else message,
    )
