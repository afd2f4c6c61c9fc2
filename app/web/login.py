"""Logging in and out, and choosing a password."""

from datetime import timedelta
from http import HTTPStatus
from typing import Annotated

from fastapi import APIRouter, Depends, Form, Request
from fastapi.responses import RedirectResponse, Response

from app.domain.people import Experimenter
from app.errors import AppError
from app.services import accounts, audit, browser_sessions
from app.web.deps import (
    EXPERIMENTER_COOKIE,
    ReadingSession,
    Studio,
    StudioDep,
    WritingSession,
    experimenter_logged_in,
    set_cookie,
)
from app.web.templating import page

router = APIRouter()

_Password = Annotated[str, Form(max_length=accounts.MAX_PASSWORD_LENGTH)]


class TooManyAttempts(AppError):
    """Too many attempts from your address. Please wait a minute, then try again."""

    status = HTTPStatus.TOO_MANY_REQUESTS


def _logged_in(request: Request, session: ReadingSession) -> Experimenter:
    return experimenter_logged_in(request, session)


LoggedIn = Annotated[Experimenter, Depends(_logged_in, scope="function")]
"""Like CurrentExperimenter, but a one-time password is enough."""


@router.get("/login", name="show_login")
def show_login(request: Request, next: str = "") -> Response:
    """The form."""
    return page(request, "experimenter/login.html", {"next": _inside(next), "name": "", "error": None})


@router.post("/login", name="log_in")
def log_in(
    request: Request,
    studio: StudioDep,
    session: ReadingSession,
    name: Annotated[str, Form(max_length=80)],
    password: _Password,
    next: Annotated[str, Form(max_length=300)] = "",
) -> Response:
    """Check the password without holding up writers, then open a session."""
    try:
        _count_attempt(request, studio)
        experimenter = accounts.verify(session, name, password)
    except (accounts.WrongNameOrPassword, TooManyAttempts) as error:
        context = {"next": _inside(next), "name": name, "error": error.message}
        status = error.status if isinstance(error, TooManyAttempts) else HTTPStatus.UNAUTHORIZED
        return page(request, "experimenter/login.html", context, status)
    return _open(request, studio, experimenter, _inside(next), "logged in")


@router.post("/logout", name="log_out")
def log_out(request: Request, session: WritingSession) -> Response:
    """End this login for good: the cookie is worthless afterwards."""
    browser_sessions.close(session, request.cookies.get(EXPERIMENTER_COOKIE, ""))
    response = RedirectResponse(request.app.url_path_for("show_login"), HTTPStatus.SEE_OTHER)
    response.delete_cookie(EXPERIMENTER_COOKIE)
    return response


@router.get("/password", name="show_password")
def show_password(request: Request, experimenter: LoggedIn) -> Response:
    """The form to choose a password."""
    return page(request, "experimenter/password.html", {"experimenter": experimenter, "error": None})


@router.post("/password", name="change_password")
def change_password(
    request: Request, studio: StudioDep, experimenter: LoggedIn, current: _Password, new: _Password, again: _Password
) -> Response:
    """Change the password; every other login of this account ends."""
    try:
        _count_attempt(request, studio)
        if new != again:
            raise accounts.PasswordUnacceptable("The two new passwords differ. Please type the same one twice.")
        password_hash = accounts.hash_of_new(experimenter, current=current, new=new)
    except (accounts.WrongNameOrPassword, accounts.PasswordUnacceptable, TooManyAttempts) as error:
        status = error.status if isinstance(error, TooManyAttempts) else HTTPStatus.UNPROCESSABLE_ENTITY
        context = {"experimenter": experimenter, "error": error.message}
        return page(request, "experimenter/password.html", context, status)
    with studio.database.writing() as session:
        accounts.set_password(session, experimenter, password_hash)
    return _open(request, studio, experimenter, _inside(""), "logged in with the new password")


def _count_attempt(request: Request, studio: Studio) -> None:
    address = request.client.host if request.client else "unknown"
    if not studio.login_attempts.allow(address):
        raise TooManyAttempts


def _open(request: Request, studio: Studio, experimenter: Experimenter, target: str, act: str) -> Response:
    lifetime = timedelta(hours=studio.settings.login_hours)
    with studio.database.writing() as session:
        cookie = browser_sessions.open_for_experimenter(session, experimenter, lifetime)
        audit.record(session, experimenter.name, act, experimenter.name)
    response = RedirectResponse(target or request.app.url_path_for("show_studies"), HTTPStatus.SEE_OTHER)
    set_cookie(response, studio.settings, EXPERIMENTER_COOKIE, cookie, lifetime)
    return response


def _inside(target: str) -> str:
    """The page to go on to, if it is one of the experimenter's own; a login must not lead to other sites."""
    inside = target.startswith("/studies") and target.isprintable() and target.isascii() and "\\" not in target
    return target if inside else ""
