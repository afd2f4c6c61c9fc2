"""Accounts of this studio, for administrators: add, change the role, reset the password, disable."""

from http import HTTPStatus
from typing import Annotated

from fastapi import APIRouter, Form, Request
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import RedirectResponse, Response
from sqlalchemy.orm import Session

from app.domain.people import Experimenter, Role
from app.errors import AppError
from app.services.accounts import accounts, second_factor
from app.web.http.authorized_route import AuthorizedRoute
from app.web.http.deps import AdministratorBriefly, CurrentAdministrator, ReadingSession, RowId, StudioDep
from app.web.texts.templating import page

router = APIRouter(prefix="/accounts", route_class=AuthorizedRoute)


@router.get("", name="show_accounts")
def show_accounts(request: Request, admin: CurrentAdministrator, session: ReadingSession) -> Response:
    """Everybody who can log in."""
    return _page(request, admin, session)


@router.post("", name="add_account")
async def add_account(
    request: Request,
    admin: AdministratorBriefly,
    studio: StudioDep,
    name: Annotated[str, Form(max_length=200)],
    role: Annotated[Role, Form()],
) -> Response:
    """Add somebody and show their one-time password, this one time."""
    password = await studio.hashing_for_known.run(accounts.new_one_time_password)
    async with studio.session_queue.writing() as session:
        return await run_in_threadpool(_add, request, session, admin, name, role, password)


def _add(
    request: Request,
    session: Session,
    admin: Experimenter,
    name: str,
    role: Role,
    password: accounts.OneTimePassword,
) -> Response:
    try:
        added = accounts.add(session, name, role, password, admin.name)
    except accounts.NameUnacceptable as error:
        return _page(request, admin, session, typed=name, error=error)
    return _page(request, admin, session, shown=(added.name, password.text))


@router.post("/{account_id}/password", name="reset_account")
async def reset_account(
    request: Request, account_id: RowId, admin: AdministratorBriefly, studio: StudioDep
) -> Response:
    """A new one-time password; the old one and every login of the account end."""
    password = await studio.hashing_for_known.run(accounts.new_one_time_password)
    async with studio.session_queue.writing() as session:
        return await run_in_threadpool(_reset, request, session, admin, account_id, password)


def _reset(
    request: Request, session: Session, admin: Experimenter, account_id: int, password: accounts.OneTimePassword
) -> Response:
    account = accounts.find(session, account_id)
    accounts.use_one_time_password(session, account, password, admin.name)
    return _page(request, admin, session, shown=(account.name, password.text))


@router.post("/{account_id}/second-factor/off", name="remove_second_factor")
def remove_second_factor(
    request: Request, account_id: RowId, admin: CurrentAdministrator, studio: StudioDep
) -> Response:
    """For somebody who has lost phone and recovery codes: the password alone is enough again."""
    with studio.database.writing() as session:
        second_factor.turn_off(session, accounts.find(session, account_id), admin.name)
    return _back(request)


@router.post("/{account_id}/role", name="change_account_role")
def change_account_role(
    request: Request,
    account_id: RowId,
    admin: CurrentAdministrator,
    studio: StudioDep,
    role: Annotated[Role, Form()],
) -> Response:
    """Another role."""
    with studio.database.writing() as session:
        accounts.change_role(session, accounts.find(session, account_id), role, admin.name)
    return _back(request)


@router.post("/{account_id}/disable", name="disable_account")
def disable_account(request: Request, account_id: RowId, admin: CurrentAdministrator, studio: StudioDep) -> Response:
    """Shut the account out at once."""
    with studio.database.writing() as session:
        accounts.disable(session, accounts.find(session, account_id), admin.name)
    return _back(request)


@router.post("/{account_id}/enable", name="enable_account")
def enable_account(request: Request, account_id: RowId, admin: CurrentAdministrator, studio: StudioDep) -> Response:
    """Let it in again."""
    with studio.database.writing() as session:
        accounts.enable(session, accounts.find(session, account_id), admin.name)
    return _back(request)


def _page(
    request: Request,
    admin: Experimenter,
    session: Session,
    *,
    shown: tuple[str, str] | None = None,
    typed: str = "",
    error: AppError | None = None,
) -> Response:
    context = {
        "experimenter": admin,
        "accounts": accounts.everybody(session),
        "roles": list(Role),
        "shown": shown,
        "typed": typed,
        "error": None if error is None else error.message,
    }
    return page(request, "experimenter/accounts.html", context, 200 if error is None else error.status)


def _back(request: Request) -> RedirectResponse:
    return RedirectResponse(request.app.url_path_for("show_accounts"), HTTPStatus.SEE_OTHER)
