"""A route that knows who is sending something before it reads what was sent.

The framework reads and parses a body before it asks any dependency, so strangers were told what was wrong with their
forms, and their bytes reached parsers. Here the question who may send comes first, in a short look of its own. It is
asked again inside the request's transaction, where it counts.
"""

from collections.abc import Awaitable, Callable, Coroutine, Iterator, Mapping, Sequence
from datetime import datetime
from typing import Any, ClassVar, TypeAlias

from fastapi import Request
from fastapi.concurrency import run_in_threadpool
from fastapi.dependencies.models import Dependant
from fastapi.responses import Response
from fastapi.routing import APIRoute
from sqlalchemy.exc import SQLAlchemyError
from starlette.background import BackgroundTask, BackgroundTasks

from app.db import complaints
from app.services.accounts import browser_sessions
from app.web.http import deps

Handler: TypeAlias = Callable[[Request], Coroutine[Any, Any, Response]]
Check: TypeAlias = Callable[[Request], Awaitable[object]]


class AuthorizedRoute(APIRoute):
    """A route of the pages: cookies say who is asking."""

    checks: ClassVar[Mapping[Callable[..., object], Check]] = deps.CHECKS
    """by dependency: what it asks of whom, without a turn on the database that is held for longer than that"""

    def get_route_handler(self) -> Handler:
        """See APIRoute. The check's errors are answered as the dependency's are."""
        handle = super().get_route_handler()
        asked = [each.call for each in _all_below(self.dependant)]
        checks = [check for dependency, check in self.checks.items() if dependency in asked]
        if not deps.EXPERIMENTERS.isdisjoint(asked):
            handle = _prolonging_the_login(handle)
        if not checks or not (self.body_field is not None or deps.read_typed in asked):
            return handle

        async def handle_known(request: Request) -> Response:
            for check in checks:
                await check(request)
            await request.body()  # whole, before anything is held that others wait for
            return await handle(request)

        return handle_known


def _prolonging_the_login(handle: Handler) -> Handler:
    """Notes that somebody is there, after the response: a full disk keeps nobody from looking."""

    async def handle_attended(request: Request) -> Response:
        response = await handle(request)
        until = getattr(request.state, "login_lasts_until", None)
        if until is not None and deps.UNATTENDED not in request.headers:
            response.background = BackgroundTasks([*_tasks(response), BackgroundTask(_prolong, request, until)])
        return response

    return handle_attended


async def _prolong(request: Request, until: datetime) -> None:
    studio, cookie = await deps.studio_of(request), request.cookies[deps.EXPERIMENTER_COOKIE]
    try:
        async with studio.session_queue.writing() as session:
            await run_in_threadpool(browser_sessions.prolong, session, cookie, until)
    except SQLAlchemyError as error:
        complaints.error("it could not be noted that a login was used: %s", error)


def _tasks(response: Response) -> Sequence[BackgroundTask]:
    return [] if response.background is None else [response.background]


def _all_below(dependant: Dependant) -> Iterator[Dependant]:
    for each in dependant.dependencies:
        yield each
        yield from _all_below(each)
