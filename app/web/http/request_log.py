"""Gives every request an id, times it, counts it, and writes one line about it."""

import logging
import re
import time
from uuid import uuid4

from prometheus_client import CollectorRegistry, Histogram
from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from app import logs

log = logging.getLogger("app.requests")

HEADER = "x-request-id"
BUCKETS_S = (0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0)
_WELL_FORMED = re.compile(r"[A-Za-z0-9_-]{8,64}")
_METHODS = frozenset({"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"})


class RequestLog:
    """ASGI middleware. Tells routes, never addresses: a personal link is a key, and is in no log and no metric."""

    def __init__(self, app: ASGIApp, *, registry: CollectorRegistry) -> None:
        self._app = app
        self._seconds = Histogram(
            "studio_request_seconds",
            "Time from a request to the last byte of its answer; event streams last as long as somebody looks.",
            ("method", "route", "status"),
            buckets=BUCKETS_S,
            registry=registry,
        )

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        given = Headers(scope=scope).get(HEADER, "")
        request_id = given if _WELL_FORMED.fullmatch(given) else uuid4().hex
        status = 500  # what the server makes of a request that is never answered

        async def send_with_id(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
                MutableHeaders(scope=message)[HEADER] = request_id
            await send(message)

        scope[HEADER] = request_id  # for the page about a failure, which is made outside of us
        logs.from_here_about(request=request_id)  # the server's line about a failure comes when we have returned
        started = time.perf_counter()
        try:
            await self._app(scope, receive, send_with_id)
        finally:
            self._note(scope, status, time.perf_counter() - started)

    def _note(self, scope: Scope, status: int, seconds: float) -> None:
        method = scope["method"] if scope["method"] in _METHODS else "other"
        route = route_of(scope)
        self._seconds.labels(method, route, str(status)).observe(seconds)
        fields = {"method": method, "route": route, "status": status, "ms": round(seconds * 1000, 1)}
        log.info("%s %s %d", method, route, status, extra={"fields": fields})


def route_of(scope: Scope) -> str:
    """The route with its parameters in braces, and what it is mounted below."""
    path = getattr(scope.get("route"), "path", None)
    if path is None:
        return "static files" if scope.get("root_path", "").endswith("/static") else "none"
    return f"{scope.get('root_path', '')}{path}"
