"""A route that knows who is sending something before it reads what was sent.

The framework reads and parses a body before it asks any dependency, so strangers were told what was wrong with their
forms, and their bytes reached parsers. Here the question who may send comes first, in a short look of its own. It is
asked again inside the request's transaction, where it counts.
"""

from collections.abc import Awaitable, Callable, Coroutine, Iterator, Mapping
from http import HTTPStatus
from typing import Any, ClassVar, TypeAlias

from fastapi import HTTPException, Request
from fastapi.dependencies.models import Dependant
from fastapi.responses import Response
from fastapi.routing import APIRoute
from starlette.requests import ClientDisconnect

from app.web.http import deps

Check: TypeAlias = Callable[[Request], Awaitable[object]]


class AuthorizedRoute(APIRoute):
    """A route of the pages: cookies say who is asking."""

    checks: ClassVar[Mapping[Callable[..., object], Check]] = deps.CHECKS
    """by dependency: what it asks of whom, without a turn on the database that is held for longer than that"""

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        """See APIRoute. The check's errors are answered as the dependency's are."""
        handle = super().get_route_handler()
        asked = [each.call for each in _all_below(self.dependant)]
        checks = [check for dependency, check in self.checks.items() if dependency in asked]
        if not checks or not (self.body_field is not None or deps.read_typed in asked):
            return handle

        async def handle_known(request: Request) -> Response:
            for check in checks:
                await check(request)
            try:
                await request.body()  # whole, before anything is held that others wait for
            except ClientDisconnect as error:
                raise HTTPException(HTTPStatus.BAD_REQUEST) from error
            return await handle(request)

        return handle_known


def _all_below(dependant: Dependant) -> Iterator[Dependant]:
    for each in dependant.dependencies:
        yield each
        yield from _all_below(each)
