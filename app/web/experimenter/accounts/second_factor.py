"""The second factor: asked for when logging in, set up with a QR code, renewed and turned off."""

from collections.abc import Sequence
from http import HTTPStatus
from typing import Annotated, Any

import segno
from fastapi import APIRouter, Form, Query, Request
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import RedirectResponse, Response
from markupsafe import Markup
from starlette.background import BackgroundTask

from app.domain.people import Experimenter
from app.errors import AppError
from app.services.accounts import accounts, browser_sessions, second_factor
from app.web.experimenter.accounts.login import Password, TooManyAttempts, count_attempt, enter, inside, note_failure
from app.web.http.authorized_route import AuthorizedRoute
from app.web.http.deps import (
    EXPERIMENTER_COOKIE,
    AccountBriefly,
    AwaitedBriefly,
    ReadingSession,
    Studio,
    StudioDep,
)
from app.web.texts.templating import page

router = APIRouter(route_class=AuthorizedRoute)

Code = Annotated[str, Form(max_length=60)]


@router.get("/login/code", name="show_code")
def show_code(request: Request, _account: AwaitedBriefly, next: Annotated[str, Query(max_length=300)] = "") -> Response:
    """The form for the code, for whoever has shown the password."""
    return page(request, "experimenter/login_code.html", {"next": inside(next), "error": None})


@router.post("/login/code", name="enter_code")
async def enter_code(
    request: Request,
    studio: StudioDep,
    account: AwaitedBriefly,
    code: Code,
    next: Annotated[str, Form(max_length=300)] = "",
) -> Response:
    """Exchange the session that waits for the code for a whole one."""
    try:
        shown = await _shown(request, studio, account, code)
    except AppError as error:
        context = {"next": inside(next), "error": error.message}
        response = page(request, "experimenter/login_code.html", context, error.status)
        response.background = BackgroundTask(note_failure, studio, account.name)
        return response
    async with studio.session_queue.writing() as session:
        await run_in_threadpool(browser_sessions.close, session, request.cookies.get(EXPERIMENTER_COOKIE, ""))
    return await enter(request, studio, account, inside(next), f"logged in with {shown}")


@router.get("/second-factor", name="show_second_factor")
def show_second_factor(request: Request, account: AccountBriefly, session: ReadingSession) -> Response:
    """Whether it is on, and what can be done about it."""
    return _page(request, account, left=second_factor.recovery_codes_left(session, account))


@router.post("/second-factor/begin", name="begin_second_factor")
async def begin_second_factor(
    request: Request, studio: StudioDep, account: AccountBriefly, password: Password
) -> Response:
    """Show the secret of a new app to whoever knows the password."""
    try:
        await count_attempt(request, studio, account.name, browser=f"logged in/{account.id}")
        await studio.hashing_for_known.run(accounts.verify, account, password)
    except (accounts.WrongNameOrPassword, TooManyAttempts) as error:
        refused = error if isinstance(error, TooManyAttempts) else _WrongPassword()
        response = _page(request, account, error=refused)
        response.background = BackgroundTask(note_failure, studio, account.name)
        return response
    async with studio.session_queue.writing() as session:
        secret = await run_in_threadpool(second_factor.begin, session, account, _key(studio))
    return _page(request, account, secret=secret)


@router.post("/second-factor/confirm", name="confirm_second_factor")
async def confirm_second_factor(request: Request, studio: StudioDep, account: AccountBriefly, code: Code) -> Response:
    """Turn it on with the first code of the new app, and show the recovery codes, this one time."""
    try:
        await count_attempt(request, studio, account.name, browser=f"logged in/{account.id}")
        async with studio.session_queue.writing() as session:
            codes = await run_in_threadpool(second_factor.confirm, session, account, code, _key(studio))
    except (second_factor.CodeWrong, TooManyAttempts) as error:
        return _page(request, account, secret=second_factor.secret_of(account, _key(studio)), error=error)
    return _page(request, account, codes=codes)


@router.post("/second-factor/codes", name="renew_recovery_codes")
async def renew_recovery_codes(request: Request, studio: StudioDep, account: AccountBriefly, code: Code) -> Response:
    """New recovery codes for whoever has a code of the app, or one of the old ones."""
    try:
        await _shown(request, studio, account, code)
    except AppError as error:
        return _page(request, account, error=error)
    async with studio.session_queue.writing() as session:
        codes = await run_in_threadpool(second_factor.renew_recovery_codes, session, account)
    return _page(request, account, codes=codes)


@router.post("/second-factor/off", name="turn_off_second_factor")
async def turn_off_second_factor(request: Request, studio: StudioDep, account: AccountBriefly, code: Code) -> Response:
    """Off, for whoever has a code: to set it up with another app, for example."""
    try:
        await _shown(request, studio, account, code)
    except AppError as error:
        return _page(request, account, error=error)
    async with studio.session_queue.writing() as session:
        await run_in_threadpool(second_factor.turn_off, session, account, account.name)
    return RedirectResponse(request.app.url_path_for("show_second_factor"), HTTPStatus.SEE_OTHER)


def _key(studio: Studio) -> bytes:
    return second_factor.key_of(studio.settings)


class _WrongPassword(AppError):
    """The password is not right."""

    status = HTTPStatus.UNPROCESSABLE_ENTITY


async def _shown(request: Request, studio: Studio, account: Experimenter, code: str) -> str:
    """What was shown, in words. Raises CodeWrong, TooManyWrongCodes and TooManyAttempts."""
    await count_attempt(request, studio, account.name, browser=f"code/{account.id}")
    async with studio.session_queue.writing() as session:
        shown = await run_in_threadpool(second_factor.passes, session, account, code, _key(studio))
    if shown is None:  # after the commit: a mistake counts
        raise second_factor.CodeWrong
    return shown


def _page(
    request: Request,
    account: Experimenter,
    *,
    secret: str | None = None,
    codes: Sequence[str] = (),
    left: int | None = None,
    error: AppError | None = None,
) -> Response:
    studio: Studio = request.app.state.studio
    address = second_factor.address_for_apps(account, secret) if secret else ""
    context: dict[str, Any] = {
        "experimenter": account,
        "on": second_factor.is_on(account) or bool(codes),
        "required": studio.settings.require_second_factor,
        "secret": secret,
        "picture": _picture(address) if address else None,
        "codes": codes,
        "left": left,
        "error": None if error is None else error.message,
    }
    return page(request, "experimenter/second_factor.html", context, 200 if error is None else error.status)


def _picture(address: str) -> Markup:
    """Black on white in both themes: cameras read nothing else reliably."""
    drawn = segno.make(address, error="m", micro=False).svg_inline(omitsize=True, border=3, light="#fff")
    return Markup(drawn)  # noqa: S704  (drawn by us from an address that we made)
