"""Stands before every route: refuses forms sent by other sites, and tells browsers what our pages may do."""

from collections.abc import Callable, Iterable
from http import HTTPStatus
from urllib.parse import urlsplit

from starlette.datastructures import MutableHeaders
from starlette.requests import Request
from starlette.responses import Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from app.errors import AppError

SAFE_METHODS = frozenset({"GET", "HEAD", "OPTIONS"})

_CSP = "; ".join(
    (
        "default-src 'none'",
        "script-src 'self'",
        "style-src 'self'",
        "img-src 'self'",
        "media-src 'self' blob:",
        "connect-src 'self'",
        "form-action 'self'",
        "base-uri 'none'",
        "frame-ancestors 'none'",
    )
)

# same-origin, not no-referrer: with the latter browsers send "Origin: null" with our own forms, and over plain HTTP,
# where there is no Sec-Fetch-Site, nothing would tell them from another site's. Personal links set no-referrer.
HEADERS = {
    "content-security-policy": _CSP,
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
    "referrer-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "x-robots-tag": "noindex",
    "cache-control": "no-store",
}
_HEADERS_OVER_HTTPS = {
    "strict-transport-security": "max-age=31536000",
    "cross-origin-opener-policy": "same-origin",
}


class ForeignForm(AppError):
    """This request came from another website and was refused. Please use the pages of this site."""

    status = HTTPStatus.FORBIDDEN


class TwoLengths(AppError):
    """This request says in two ways where it ends, and was refused."""

    status = HTTPStatus.BAD_REQUEST


class Guard:
    """ASGI middleware: our headers on every response; unsafe methods only from our own pages.

    A request with a length and in chunks is refused and its connection closed: a proxy may have read another end of it
    than we do, and take what follows for somebody else's request (RFC 9112, 6.1).

    Browsers say where a request comes from: Sec-Fetch-Site (HTTPS and localhost), else Origin (plain HTTP).
    A client that sends neither is no browser, so it holds no victim's cookie.
    """

    def __init__(self, app: ASGIApp, *, https: bool, refuse: Callable[[Request, AppError], Response]) -> None:
        self._app = app
        self._refuse = refuse
        self._headers = {**HEADERS, **(_HEADERS_OVER_HTTPS if https else {})}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return

        async def send_guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in self._headers.items():
                    headers.setdefault(name, value)
            await send(message)

        app = self._app
        if _has_two_lengths(scope["headers"]):
            app = refusal = self._refuse(Request(scope), TwoLengths())
            refusal.headers["connection"] = "close"
        elif scope["method"] not in SAFE_METHODS and _is_foreign(scope["headers"]):
            app = self._refuse(Request(scope), ForeignForm())
        await app(scope, receive, send_guarded)


def _has_two_lengths(headers: Iterable[tuple[bytes, bytes]]) -> bool:
    return {b"content-length", b"transfer-encoding"} <= {name for name, _ in headers}


def _is_foreign(headers: Iterable[tuple[bytes, bytes]]) -> bool:
    said = {name: value for name, value in headers if name in (b"sec-fetch-site", b"origin", b"host")}
    site = said.get(b"sec-fetch-site")
    if site is not None:
        return site not in (b"same-origin", b"none")
    origin = said.get(b"origin")
    return origin is not None and _netloc(origin.decode("latin-1")) != said.get(b"host", b"").decode("latin-1").lower()


def _netloc(origin: str) -> str | None:
    try:
        return urlsplit(origin).netloc.lower()
    except ValueError:
        return None
