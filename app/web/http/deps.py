"""What a route may ask for: settings, sessions on the database, and the person who is asking."""

from collections.abc import AsyncIterator, Callable, Coroutine, Mapping
from dataclasses import dataclass, field
from datetime import timedelta
from functools import partial
from http import HTTPStatus
from threading import Event
from typing import Annotated, Any, TypeVar
from urllib.parse import parse_qsl

from fastapi import Depends, Path, Request, Response
from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel, ValidationError
from sqlalchemy.orm import Session

from app.db import Database
from app.domain.people import Experimenter, Role, StudyRole
from app.domain.studies import Participant
from app.errors import AppError
from app.services.accounts import browser_sessions, roles, second_factor
from app.services.accounts.hourly_counts import HourlyCounts
from app.services.accounts.openid import Provider
from app.services.monitoring.tallies import Tallies
from app.services.participants.time_left import UsualTimes
from app.services.studies import membership
from app.settings import Settings
from app.storage import ArtefactStore
from app.web.http.hashing import Hashing
from app.web.http.import_limit import ImportLimit
from app.web.http.rate_limit import LoginAttempts
from app.web.http.readiness import Readiness
from app.web.http.session_queue import SessionQueue
from app.web.http.shared_pages import SharedPages

T = TypeVar("T")
F = TypeVar("F", bound=BaseModel)
MOST_FIELDS = 100
"""Of an answer; it has fewer than twenty."""
PARTICIPANT_COOKIE = "studio_participant"
EXPERIMENTER_COOKIE = "studio_experimenter"
KNOWN_BROWSER_COOKIE = "studio_known_browser"
UNATTENDED = "x-unattended"
"""Header of requests that a page makes by itself, without anybody doing anything."""
LANGUAGE_COOKIE = "studio_language"
"""The language of the pages in this browser, for those that cannot tell who is asking."""


class LinkNeeded(AppError):
    """We cannot tell who you are. Please open your personal link again: you go on exactly where you were."""

    status = HTTPStatus.UNAUTHORIZED


class NotYet(AppError):
    """Something else comes first. You are taken there."""

    status = HTTPStatus.CONFLICT


class LoginNeeded(AppError):
    """Please log in."""

    status = HTTPStatus.UNAUTHORIZED


class NotSaved(LoginNeeded):
    """You are logged out, so this was not saved. Go back, log in in another tab, and send what you typed again."""


class PasswordChangeDue(AppError):
    """Please choose a password of your own first."""

    status = HTTPStatus.FORBIDDEN


class SecondFactorNeeded(AppError):
    """This studio asks for a second factor. Please set it up first."""

    status = HTTPStatus.FORBIDDEN


@dataclass(frozen=True)
class Studio:
    """The parts that every request shares."""

    settings: Settings
    database: Database
    store: ArtefactStore
    readiness: Readiness
    session_queue: SessionQueue
    login_attempts: LoginAttempts
    shared_pages: SharedPages
    provider: Provider | None
    """Where experimenters can log in instead of here."""
    token_attempts: LoginAttempts
    """Of their own: a program with an old token must not lock out the people who log in from the same address."""
    hashing: Hashing = field(default_factory=Hashing)
    hashing_for_known: Hashing = field(default_factory=Hashing)
    """For people whose browser is known or who are logged in: they do not queue behind strangers who guess."""
    imports: ImportLimit = field(default_factory=ImportLimit)
    failed_logins: HourlyCounts = field(default_factory=HourlyCounts)
    refusals: HourlyCounts = field(default_factory=HourlyCounts)
    tallies: Tallies = field(default_factory=Tallies)
    usual_times: UsualTimes = field(default_factory=UsualTimes)
    closing: Event = field(default_factory=Event)
    """Set when the server is asked to stop, so that open event streams end by themselves."""


async def studio_of(request: Request) -> Studio:
    """The parts as create_app made them. Async, because a plain function would take a thread for this."""
    studio: Studio = request.app.state.studio
    return studio


StudioDep = Annotated[Studio, Depends(studio_of)]


async def _reading_session(studio: StudioDep) -> AsyncIterator[Session]:
    async with studio.session_queue.reading() as session:
        yield session


async def _writing_session(studio: StudioDep) -> AsyncIterator[Session]:
    async with studio.session_queue.writing() as session:
        yield session


# scope="function": the transaction ends before the response leaves. With the default scope a commit that fails
# would come after a response that says "saved".
ReadingSession = Annotated[Session, Depends(_reading_session, scope="function")]
WritingSession = Annotated[Session, Depends(_writing_session, scope="function")]


def participant_or_nobody(request: Request, session: Session, *, lock: bool = False) -> Participant | None:
    """The participant whose browser this is, study loaded."""
    cookie = request.cookies.get(PARTICIPANT_COOKIE)
    participant = browser_sessions.participant_of(session, cookie, lock=lock) if cookie else None
    return None if participant is None or participant.withdrawn_at is not None else participant


def participant_asking(request: Request, session: Session, *, lock: bool = False) -> Participant:
    """The participant whose browser this is, study loaded. Raises LinkNeeded."""
    participant = participant_or_nobody(request, session, lock=lock)
    if participant is None:
        raise LinkNeeded
    return participant


@dataclass(frozen=True)
class Answering:
    """The way into the database for what participants do most: the whole request is one step of one thread."""

    request: Request
    studio: Studio

    async def act(self, step: Callable[[Session, Participant], T]) -> T:
        """What the step returns, committed. Requests of one person wait for each other.

        It may write nothing but rows of this participant: on PostgreSQL, others do so meanwhile. Raises LinkNeeded.
        """
        return await self.studio.session_queue.write_own_rows(
            lambda session: step(session, participant_asking(self.request, session, lock=True))
        )

    async def act_on(self, form: type[F], step: Callable[[Session, Participant, F], T]) -> T:
        """Like act(), with what was sent, where empty means left out.

        Nothing is parsed before it is known who sent it, and no second look is needed to know it. Raises LinkNeeded
        and RequestValidationError.
        """
        sent = await self.request.body()
        is_form = self.request.headers.get("content-type", "").startswith("application/x-www-form-urlencoded")
        return await self.act(lambda session, participant: step(session, participant, _form(form, sent * is_form)))


def _form(form: type[F], sent: bytes) -> F:
    try:
        fields = parse_qsl(sent.decode(errors="replace"), max_num_fields=MOST_FIELDS)
    except ValueError:
        fields = []
    try:
        return form.model_validate(dict(fields))
    except ValidationError as error:
        raise RequestValidationError([{**each, "loc": ("body", *each["loc"])} for each in error.errors()]) from None


def experimenter_asking(
    request: Request, session: Session, needed: StudyRole = StudyRole.VIEWER, account_needed: Role = Role.READER
) -> Experimenter:
    """The experimenter who is logged in, password changed, and whose the study of this address is, if it has one.

    There is no other way to an experimenter, so no page can forget to ask. Raises LoginNeeded, PasswordChangeDue,
    SecondFactorNeeded, StudyNotFound, RoleTooLow and StudyRoleTooLow.
    """
    experimenter = experimenter_with_own_password(request, session)
    if lacks_second_factor(request.app.state.studio.settings, experimenter):
        raise SecondFactorNeeded
    slug = request.path_params.get("slug")
    if slug is None:
        roles.require(experimenter, account_needed)
        request.state.may_change = roles.may(experimenter, Role.EXPERIMENTER)
    else:
        role = membership.enter(session, experimenter, slug, needed)
        request.state.may_change = membership.is_at_least(role, StudyRole.EDITOR)
        request.state.may_manage = membership.is_at_least(role, StudyRole.OWNER)
    return experimenter


def lacks_second_factor(settings: Settings, experimenter: Experimenter) -> bool:
    """Whether this installation asks for a second factor that the account does not have."""
    theirs = second_factor.is_on(experimenter) or experimenter.oidc_subject is not None  # the provider asks for it
    return settings.require_second_factor and not theirs


def experimenter_with_own_password(request: Request, session: Session) -> Experimenter:
    """The experimenter who is logged in, perhaps without a second factor. Raises LoginNeeded and PasswordChangeDue."""
    experimenter = experimenter_logged_in(request, session)
    if experimenter.must_change_password:
        raise PasswordChangeDue
    return experimenter


def experimenter_logged_in(request: Request, session: Session) -> Experimenter:
    """The experimenter who is logged in, perhaps with a one-time password. Raises LoginNeeded."""
    cookie = request.cookies.get(EXPERIMENTER_COOKIE)
    found = browser_sessions.login_of(session, cookie) if cookie else None
    if found is None:
        raise LoginNeeded
    experimenter, login = found
    settings: Settings = request.app.state.studio.settings
    request.state.asking = experimenter.name
    request.state.login_lasts_until = browser_sessions.lasts_until(login, settings.login_idle, settings.login_whole)
    return experimenter


def _participant(request: Request, session: WritingSession) -> Participant:
    return participant_asking(request, session)


async def _answering(request: Request, studio: StudioDep) -> "Answering":
    if PARTICIPANT_COOKIE not in request.cookies:
        raise LinkNeeded
    return Answering(request, studio)


def _experimenter(request: Request, session: ReadingSession) -> Experimenter:
    return experimenter_asking(request, session)


def _administrator(request: Request, session: ReadingSession) -> Experimenter:
    return experimenter_asking(request, session, account_needed=Role.ADMINISTRATOR)


def experimenter_awaited(request: Request, session: Session) -> Experimenter:
    """The experimenter whose password was right and whose code is still to come. Raises LoginNeeded."""
    cookie = request.cookies.get(EXPERIMENTER_COOKIE)
    account = browser_sessions.experimenter_of(session, cookie, second_factor_due=True) if cookie else None
    if account is None:
        raise LoginNeeded
    return account


def _briefly(ask: Callable[[Request, Session], T]) -> Callable[[Request], Coroutine[Any, Any, T]]:
    """Asks in a look of its own, so that no turn is held afterwards."""

    async def look(request: Request) -> T:
        studio = await studio_of(request)
        return await studio.session_queue.look(partial(ask, request))

    return look


_administrator_briefly = _briefly(_administrator)
_account_briefly = _briefly(experimenter_with_own_password)
_logged_in_briefly = _briefly(experimenter_logged_in)
_awaited_briefly = _briefly(experimenter_awaited)


def _acting_experimenter(request: Request, session: WritingSession) -> Experimenter:
    return experimenter_asking(request, session, StudyRole.EDITOR, Role.EXPERIMENTER)


def _study_owner(request: Request, session: WritingSession) -> Experimenter:
    return experimenter_asking(request, session, StudyRole.OWNER, Role.ADMINISTRATOR)


def _own_account(request: Request, session: WritingSession) -> Experimenter:
    return experimenter_asking(request, session)


CurrentParticipant = Annotated[Participant, Depends(_participant, scope="function")]
"""In the request's writing session: whatever a participant does leaves a trace, if only that they were here."""
AnsweringParticipant = Annotated[Answering, Depends(_answering)]
"""For what participants do with every pair. Raises LinkNeeded for a browser without a cookie."""
CurrentExperimenter = Annotated[Experimenter, Depends(_experimenter, scope="function")]
"""Whoever is logged in, readers included; a member of the study that the address names: for looking."""
ActingExperimenter = Annotated[Experimenter, Depends(_acting_experimenter, scope="function")]
"""In the request's writing session; an editor of the study, or where there is none an experimenter.

For whatever changes something or leaves the studio."""
StudyOwner = Annotated[Experimenter, Depends(_study_owner, scope="function")]
"""In the request's writing session; an owner of the study that the address names."""
CurrentAdministrator = Annotated[Experimenter, Depends(_administrator, scope="function")]
AdministratorBriefly = Annotated[Experimenter, Depends(_administrator_briefly)]
"""Like CurrentAdministrator, and no turn is held when the route begins: for what hashes a password."""
AccountBriefly = Annotated[Experimenter, Depends(_account_briefly)]
"""Whoever is logged in with a password of their own, a second factor may be missing; no turn is held either."""
LoggedInBriefly = Annotated[Experimenter, Depends(_logged_in_briefly)]
"""Whoever is logged in, a one-time password is enough; no turn is held either."""
AwaitedBriefly = Annotated[Experimenter, Depends(_awaited_briefly)]
"""Whoever has shown the password and must show a code; no turn is held either."""
OwnAccount = Annotated[Experimenter, Depends(_own_account, scope="function")]
"""In the request's writing session, whatever their role: for what concerns nobody but themselves."""

EXPERIMENTERS = {
    *(_experimenter, _administrator, _acting_experimenter, _study_owner, _own_account),
    *(_administrator_briefly, _account_briefly, _logged_in_briefly),
}
"""Dependencies of pages and forms that an experimenter opens or sends; streams and films come by themselves."""
CHECKS: Mapping[Callable[..., object], Callable[[Request], Coroutine[Any, Any, object]]] = {
    _participant: _briefly(participant_asking),
    **{ask: _briefly(ask) for ask in (_experimenter, _administrator, _acting_experimenter, _study_owner, _own_account)},
    **{ask: ask for ask in (_administrator_briefly, _account_briefly, _logged_in_briefly, _awaited_briefly)},
}
"""What is asked of whoever sends something, by dependency, before it is read (app.web.http.authorized_route)."""


async def read_typed(request: Request) -> Mapping[str, str]:
    """A form's fields, files left out."""
    async with request.form() as form:  # files that somebody sends along are closed again
        return {name: value for name, value in form.items() if isinstance(value, str)}


Typed = Annotated[Mapping[str, str], Depends(read_typed)]
"""A form's fields as they were typed, where which there are depends on the study."""
RowId = Annotated[int, Path(ge=1, le=2**31 - 1)]
Slug = Annotated[str, Path(pattern=r"^[a-z0-9-]{1,80}$")]
Code = Annotated[str, Path(pattern=r"^P[0-9]{2,8}$")]
Sha256 = Annotated[str, Path(pattern=r"^[0-9a-f]{64}$")]
Token = Annotated[str, Path(pattern=r"^[A-Za-z0-9_-]{20,100}$")]


def set_cookie(response: Response, settings: Settings, name: str, cookie: str, lifetime: timedelta) -> None:
    """Set a cookie that is out of reach of scripts and not sent along by other sites' forms."""
    response.set_cookie(
        name,
        cookie,
        max_age=int(lifetime.total_seconds()),
        httponly=True,
        samesite="lax",
        secure=settings.secure_cookies,
        path="/",
    )
