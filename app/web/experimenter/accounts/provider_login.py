"""Logging in at the identity provider of the installation: there, and back."""

from datetime import timedelta
from http import HTTPStatus
from typing import Annotated

from fastapi import APIRouter, Query, Request
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import RedirectResponse, Response

from app.domain.people import Role
from app.errors import AppError
from app.services.accounts import accounts, openid, provider_accounts, second_factor
from app.services.accounts.openid import Attempt, Provider
from app.web.experimenter.accounts.login import TooManyAttempts, ask_for_code, count_attempt, enter, inside
from app.web.http.authorized_route import AuthorizedRoute
from app.web.http.deps import Studio, StudioDep, set_cookie
from app.web.texts.templating import page

router = APIRouter(prefix="/login/provider", route_class=AuthorizedRoute)

ATTEMPT_COOKIE = "studio_login_attempt"
TIME_TO_LOG_IN = timedelta(minutes=10)
EVERYBODY = "logins at the identity provider"
_Text = Annotated[str, Query(max_length=4000)]


class NoProvider(AppError):
    """This studio has no identity provider. Log in with name and password."""

    status = HTTPStatus.NOT_FOUND


@router.get("", name="begin_provider_login")
def begin_provider_login(
    request: Request, studio: StudioDep, next: Annotated[str, Query(max_length=300)] = ""
) -> Response:
    """Send the browser to the provider."""
    attempt = Attempt.new()
    try:
        address = _provider(studio).address_of_login(attempt, _back_here(request, studio))
    except openid.ProviderUnusable as error:
        return _refused(request, error)
    response = RedirectResponse(address, HTTPStatus.SEE_OTHER)
    kept = "|".join((attempt.state, attempt.nonce, attempt.verifier, inside(next)))
    set_cookie(response, studio.settings, ATTEMPT_COOKIE, kept, TIME_TO_LOG_IN)
    return response


@router.get("/back", name="end_provider_login")
async def end_provider_login(request: Request, studio: StudioDep, state: _Text = "", code: _Text = "") -> Response:
    """Whoever comes back from the provider is let in, if it was this browser that was sent there."""
    provider, redirect_uri = _provider(studio), _back_here(request, studio)
    try:
        await count_attempt(request, studio, EVERYBODY, browser=None)
        attempt, target = _begun(request)
        identity = await run_in_threadpool(provider.identity, attempt, state, code, redirect_uri)
        password = await studio.hashing.run(accounts.new_one_time_password)
        new_role = studio.settings.oidc_new_accounts
        async with studio.session_queue.writing() as session:
            account = await run_in_threadpool(
                provider_accounts.enter, session, identity, Role(new_role) if new_role else None, password
            )
    except (openid.ProviderRefused, openid.ProviderUnusable, provider_accounts.NoAccount, TooManyAttempts) as error:
        return _refused(request, error)
    if second_factor.is_on(account):
        response = await ask_for_code(request, studio, account, target)
    else:
        response = await enter(request, studio, account, target, "logged in by the identity provider")
    response.delete_cookie(ATTEMPT_COOKIE)
    return response


def _begun(request: Request) -> tuple[Attempt, str]:
    """Raises ProviderRefused."""
    parts = request.cookies.get(ATTEMPT_COOKIE, "").split("|")
    if len(parts) != 4:
        raise openid.ProviderRefused
    return Attempt(*parts[:3]), inside(parts[3])


def _provider(studio: Studio) -> Provider:
    if studio.provider is None:
        raise NoProvider
    return studio.provider


def _back_here(request: Request, studio: Studio) -> str:
    """From the settings, not from what the request says of its host: the provider compares it with what it knows."""
    return studio.settings.base_url + str(request.app.url_path_for("end_provider_login"))


def _refused(request: Request, error: AppError) -> Response:
    context = {"next": "", "name": "", "error": error.message, "provider": True}
    response = page(request, "experimenter/login.html", context, error.status)
    response.delete_cookie(ATTEMPT_COOKIE)
    return response
