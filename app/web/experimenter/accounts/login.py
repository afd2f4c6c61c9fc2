"""Logging in and out, and choosing a password."""

from datetime import timedelta
from http import HTTPStatus
from typing import Annotated
from urllib.parse import urlencode

from fastapi import APIRouter, Form, Request
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import RedirectResponse, Response
from sqlalchemy.orm import Session
from starlette.background import BackgroundTask

from app.domain.people import Experimenter
from app.errors import AppError
from app.services import audit
from app.services.accounts import accounts, browser_sessions, hourly_counts, known_browsers, second_factor
from app.web.http.authorized_route import AuthorizedRoute
from app.web.http.deps import (
    EXPERIMENTER_COOKIE,
    KNOWN_BROWSER_COOKIE,
    LoggedInBriefly,
    Studio,
    StudioDep,
    WritingSession,
    set_cookie,
)
from app.web.texts.templating import page

router = APIRouter(route_class=AuthorizedRoute)

TIME_FOR_CODE = timedelta(minutes=10)
Password = Annotated[str, Form(max_length=accounts.MAX_PASSWORD_LENGTH)]


class TooManyAttempts(AppError):
    """Too many attempts. Please wait a minute, then try again."""

    status = HTTPStatus.TOO_MANY_REQUESTS


@router.get("/login", name="show_login")
def show_login(request: Request, studio: StudioDep, next: str = "") -> Response:
    """The form, and the way to the identity provider if there is one."""
    provider = studio.provider is not None
    context = {"next": inside(next), "name": "", "error": None, "provider": provider}
    return page(request, "experimenter/login.html", context)


@router.post("/login", name="log_in")
async def log_in(
    request: Request,
    studio: StudioDep,
    name: Annotated[str, Form(max_length=80)],
    password: Password,
    next: Annotated[str, Form(max_length=300)] = "",
) -> Response:
    """Check the password while holding neither a turn nor a thread that others need, then open a session.

    With a second factor it is a session that opens the form for the code and nothing else.
    """
    try:
        experimenter = await _verified(request, studio, name, password)
        if second_factor.is_on(experimenter):
            return await ask_for_code(request, studio, experimenter, inside(next))
        return await enter(request, studio, experimenter, inside(next), "logged in")
    except (accounts.WrongNameOrPassword, TooManyAttempts) as error:
        provider = studio.provider is not None
        context = {"next": inside(next), "name": name, "error": error.message, "provider": provider}
        status = error.status if isinstance(error, TooManyAttempts) else HTTPStatus.UNAUTHORIZED
        response = page(request, "experimenter/login.html", context, status)
        # After the response, so that the time taken does not tell which names exist.
        response.background = BackgroundTask(note_failure, studio, name)
        return response


@router.post("/logout", name="log_out")
def log_out(request: Request, session: WritingSession) -> Response:
    """End this login for good: the cookie is worthless afterwards."""
    cookie = request.cookies.get(EXPERIMENTER_COOKIE, "")
    experimenter = browser_sessions.experimenter_of(session, cookie)
    if experimenter is not None:
        audit.record(session, experimenter.name, "logged out", experimenter.name)
    browser_sessions.close(session, cookie)
    response = RedirectResponse(request.app.url_path_for("show_login"), HTTPStatus.SEE_OTHER)
    response.delete_cookie(EXPERIMENTER_COOKIE)
    return response


@router.get("/password", name="show_password")
def show_password(request: Request, experimenter: LoggedInBriefly) -> Response:
    """The form to choose a password."""
    return page(request, "experimenter/password.html", {"experimenter": experimenter, "error": None})


@router.post("/password", name="change_password")
async def change_password(
    request: Request,
    studio: StudioDep,
    experimenter: LoggedInBriefly,
    current: Password,
    new: Password,
    again: Password,
) -> Response:
    """Change the password; every other login of this account ends."""
    try:
        await count_attempt(request, studio, experimenter.name, browser=f"logged in/{experimenter.id}")
        if new != again:
            raise accounts.PasswordUnacceptable("The two new passwords differ. Please type the same one twice.")
        password_hash = await studio.hashing_for_known.run(accounts.hash_of_new, experimenter, current=current, new=new)
    except (accounts.WrongNameOrPassword, accounts.PasswordUnacceptable, TooManyAttempts) as error:
        status = error.status if isinstance(error, TooManyAttempts) else HTTPStatus.UNPROCESSABLE_ENTITY
        context = {"experimenter": experimenter, "error": error.message}
        response = page(request, "experimenter/password.html", context, status)
        if not isinstance(error, accounts.PasswordUnacceptable):  # whoever sits here may not be who has logged in
            response.background = BackgroundTask(note_failure, studio, experimenter.name)
        return response
    async with studio.session_queue.writing() as session:
        changed = await run_in_threadpool(accounts.set_password, session, experimenter, password_hash)
    return await enter(request, studio, changed, inside(""), "logged in with the new password")


async def _verified(request: Request, studio: Studio, name: str, password: str) -> Experimenter:
    """Raises WrongNameOrPassword and TooManyAttempts."""
    async with studio.session_queue.reading() as session:
        account = await run_in_threadpool(accounts.by_name, session, name)
    browser = known_browsers.name_in(request.cookies.get(KNOWN_BROWSER_COOKIE, ""), account)
    await count_attempt(request, studio, name, browser)
    hashing = studio.hashing if browser is None else studio.hashing_for_known
    return await hashing.run(accounts.verify, account, password)


async def note_failure(studio: Studio, name: str) -> None:
    """For the audit log; never what was typed, unless an account has that name."""
    async with studio.session_queue.reading() as session:
        account = await run_in_threadpool(accounts.by_name, session, name)
    known = hourly_counts.UNKNOWN_NAME if account is None else account.name
    count = studio.failed_logins.count(known)
    if count is not None:
        async with studio.session_queue.writing() as session:
            subject = hourly_counts.in_words(known, count)
            await run_in_threadpool(audit.record, session, audit.STRANGER, "login failed", subject)


async def count_attempt(request: Request, studio: Studio, account: str, browser: str | None) -> None:
    """Raises TooManyAttempts."""
    address = request.client.host if request.client else "unknown"
    if not await run_in_threadpool(studio.login_attempts.allow, address, account, browser):
        raise TooManyAttempts


async def ask_for_code(request: Request, studio: Studio, experimenter: Experimenter, target: str) -> Response:
    """Open a session that waits for the code.

    Raises WrongNameOrPassword when the password was replaced while it was being checked.
    """
    async with studio.session_queue.writing() as session:
        cookie = await run_in_threadpool(_open_session_for_code, session, experimenter)
    address = request.app.url_path_for("show_code")
    response = RedirectResponse(f"{address}?{urlencode({'next': target})}" if target else address, HTTPStatus.SEE_OTHER)
    set_cookie(response, studio.settings, EXPERIMENTER_COOKIE, cookie, TIME_FOR_CODE)
    return response


async def enter(request: Request, studio: Studio, experimenter: Experimenter, target: str, act: str) -> Response:
    """Open a session for somebody who has shown all that is asked of them, and lead on.

    Raises WrongNameOrPassword when the password was replaced while it was being checked.
    """
    lifetime = min(studio.settings.login_idle, studio.settings.login_whole)
    user_agent = request.headers.get("user-agent", "")
    async with studio.session_queue.writing() as session:
        cookie = await run_in_threadpool(_open_session, session, experimenter, lifetime, act, user_agent)
    response = RedirectResponse(target or request.app.url_path_for("show_studies"), HTTPStatus.SEE_OTHER)
    set_cookie(response, studio.settings, EXPERIMENTER_COOKIE, cookie, studio.settings.login_whole)
    mark = known_browsers.new_mark(experimenter)
    set_cookie(response, studio.settings, KNOWN_BROWSER_COOKIE, mark, known_browsers.LIFETIME)
    return response


def _stored(session: Session, experimenter: Experimenter) -> Experimenter:
    stored = session.get(Experimenter, experimenter.id)
    if stored is None or stored.password_hash != experimenter.password_hash:
        raise accounts.WrongNameOrPassword
    return stored


def _open_session_for_code(session: Session, experimenter: Experimenter) -> str:
    stored = _stored(session, experimenter)
    return browser_sessions.open_for_experimenter(session, stored, TIME_FOR_CODE, second_factor_due=True)


def _open_session(session: Session, experimenter: Experimenter, lifetime: timedelta, act: str, user_agent: str) -> str:
    stored = _stored(session, experimenter)
    cookie = browser_sessions.open_for_experimenter(session, stored, lifetime, user_agent=user_agent)
    audit.record(session, stored.name, act, stored.name)
    return cookie


def inside(target: str) -> str:
    """The page to go on to, if it is one of the experimenter's own; a login must not lead to other sites."""
    inside = target.startswith("/studies") and target.isprintable() and target.isascii() and "\\" not in target
    return target if inside else ""
