"""Who asks the API: told by a bearer token, never by a cookie, so no other site can ask in somebody's name."""

from collections.abc import Callable, Mapping
from functools import partial
from http import HTTPStatus
from typing import Annotated, ClassVar

from fastapi import Depends, Request
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer
from sqlalchemy.orm import Session

from app.domain.people import Experimenter, StudyRole, TokenScope
from app.domain.studies import Participant, Study
from app.errors import AppError
from app.services import audit
from app.services.accounts import api_tokens, hourly_counts
from app.services.accounts.api_tokens import ScopeTooNarrow, TokenInvalid
from app.services.studies import membership, studies
from app.web.http.authorized_route import AuthorizedRoute, Check
from app.web.http.deps import (
    ReadingSession,
    SecondFactorNeeded,
    Studio,
    StudioDep,
    lacks_second_factor,
    studio_of,
)
from app.web.http.security import SAFE_METHODS

PREFIX = "/api/v1"
"""Where the API is mounted."""

bearer = HTTPBearer(auto_error=False, description="A token from the page of API tokens.")


class TokenMissing(AppError):
    """Send a token: the header Authorization: Bearer pbarl_... Tokens are made on the page of API tokens."""

    status = HTTPStatus.UNAUTHORIZED


class TooManyWrongTokens(AppError):
    """Too many wrong tokens from your address. Please wait a minute, then try again with a right one."""

    status = HTTPStatus.TOO_MANY_REQUESTS


def _whoever(
    request: Request,
    studio: StudioDep,
    session: ReadingSession,
    credentials: Annotated[HTTPAuthorizationCredentials | None, Depends(bearer)],
) -> Experimenter:
    """Whose token was sent, and it may be used so.

    Raises TokenMissing, TokenInvalid, TooManyWrongTokens, ScopeTooNarrow and SecondFactorNeeded.
    """
    if credentials is None:
        raise TokenMissing
    try:
        token, experimenter = api_tokens.find(session, credentials.credentials)
    except TokenInvalid:
        count = studio.failed_logins.count(hourly_counts.WRONG_TOKEN)
        if count is not None:
            with studio.database.writing() as writing:
                subject = hourly_counts.in_words(hourly_counts.WRONG_TOKEN, count)
                audit.record(writing, audit.STRANGER, "login failed", subject)
        address = request.client.host if request.client else "unknown"
        if not studio.token_attempts.allow(address):
            raise TooManyWrongTokens from None
        raise
    request.state.asking = experimenter.name
    if lacks_second_factor(studio.settings, experimenter):
        raise SecondFactorNeeded
    if token.scope == TokenScope.READ and request.method not in SAFE_METHODS:
        raise ScopeTooNarrow
    request.state.token = token
    if api_tokens.use_is_worth_noting(token):
        with studio.database.writing() as writing:
            api_tokens.note_use(writing, token.id)
    return experimenter


Whoever = Annotated[Experimenter, Depends(_whoever, scope="function")]
"""Whose token it is, whatever it may do."""


async def _needs(request: Request, needed: StudyRole) -> None:
    """Whether whoever sends something may, in a look of its own (app.web.http.authorized_route)."""
    studio, credentials = await studio_of(request), await bearer(request)
    await studio.session_queue.look(
        lambda session: _entering(request, session, _whoever(request, studio, session, credentials), needed)
    )


def _caller(request: Request, session: ReadingSession, experimenter: Whoever) -> Experimenter:
    return _entering(request, session, experimenter, StudyRole.VIEWER)


def _acting_caller(request: Request, session: ReadingSession, experimenter: Whoever) -> Experimenter:
    return _entering(request, session, experimenter, StudyRole.EDITOR)


def _owning_caller(request: Request, session: ReadingSession, experimenter: Whoever) -> Experimenter:
    return _entering(request, session, experimenter, StudyRole.OWNER)


def _entering(request: Request, session: Session, experimenter: Experimenter, needed: StudyRole) -> Experimenter:
    """Whose the study of this address is, if it has one. Raises StudyNotFound, RoleTooLow and StudyRoleTooLow."""
    slug = request.path_params.get("slug")
    if slug is not None:
        membership.enter(session, experimenter, slug, needed)
        if request.state.token.study_id not in (None, studies.find_study(session, slug).id):
            raise membership.OthersStudy
    return experimenter


class AuthorizedCall(AuthorizedRoute):
    """A route of the API: a token says who is asking."""

    checks: ClassVar[Mapping[Callable[..., object], Check]] = {
        _caller: partial(_needs, needed=StudyRole.VIEWER),
        _acting_caller: partial(_needs, needed=StudyRole.EDITOR),
        _owning_caller: partial(_needs, needed=StudyRole.OWNER),
    }


Caller = Annotated[Experimenter, Depends(_caller, scope="function")]
"""A member of the study that the address names: for looking."""
ActingCaller = Annotated[Experimenter, Depends(_acting_caller, scope="function")]
"""An editor of it: for whatever changes something or leaves the studio."""
OwningCaller = Annotated[Experimenter, Depends(_owning_caller, scope="function")]


def note_reading(
    studio: Studio,
    session: Session,
    caller: Experimenter,
    what: str,
    study: Study,
    subject: str,
    person: Participant | None = None,
) -> None:
    """Kept before anything is given away."""
    action = f"{what} read by the API"
    audit.note_reading(studio.database, session, caller.name, action, subject, study=study, participant=person)
