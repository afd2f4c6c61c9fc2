"""Sends a stored file: from this machine's disk, or piece by piece from a bucket, ranges included."""

import re
from collections.abc import Iterator, Mapping
from http import HTTPStatus
from itertools import chain
from typing import NamedTuple

from fastapi.concurrency import run_in_threadpool
from fastapi.responses import FileResponse, Response, StreamingResponse
from starlette.datastructures import Headers
from starlette.types import Receive, Scope, Send

from app.storage import ArtefactStore

_ONE_RANGE = re.compile(r"bytes=(\d{0,15})-(\d{0,15})")
"""Browsers and programs that go on with a download ask for one; whoever asks for more gets the whole file."""


def send(
    store: ArtefactStore,
    sha256: str,
    media_type: str,
    *,
    filename: str | None = None,
    headers: Mapping[str, str] | None = None,
) -> Response:
    """The file, once its content was compared with its name. Raises ArtefactMissing and ArtefactDamaged."""
    if store.files.is_shared:
        named = {"content-disposition": f'attachment; filename="{filename}"'} if filename else {}
        return _FromBucket(store, sha256, media_type, {"etag": f'"{sha256}"', **named, **(headers or {})})
    path = store.verified(sha256).path
    assert path is not None  # noqa: S101  (files that are not shared lie on this machine)
    return FileResponse(path, headers=headers, media_type=media_type, filename=filename, stat_result=path.stat())


class _Span(NamedTuple):
    first: int
    end: int


class _FromBucket(Response):
    """Asks the bucket when the route has returned: a slow one holds up neither a transaction nor a turn to read."""

    def __init__(self, store: ArtefactStore, sha256: str, media_type: str, told: Mapping[str, str]) -> None:
        super().__init__(headers=told, media_type=media_type)
        self._store, self._sha256 = store, sha256
        self._told = {**told, "content-type": media_type, "accept-ranges": "bytes"}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """See Response. What goes wrong before the first byte becomes an error page."""
        answer = await run_in_threadpool(self._answer, scope["method"], Headers(scope=scope))
        await answer(scope, receive, send)

    def _answer(self, method: str, asked: Headers) -> Response:
        artefact = self._store.verified(self._sha256)
        size = artefact.stat.byte_count
        span = self._span(asked, size)
        if span is None:
            headers = {**self._told, "content-range": f"bytes */{size}"}
            return Response(status_code=HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE, headers=headers)
        headers, status = {**self._told, "content-length": str(span.end - span.first)}, HTTPStatus.OK
        if span != (0, size):
            headers["content-range"] = f"bytes {span.first}-{span.end - 1}/{size}"
            status = HTTPStatus.PARTIAL_CONTENT
        if method == "HEAD":
            return Response(status_code=status, headers=headers)
        return StreamingResponse(_begun(artefact.pieces(*span)), status, headers)

    def _span(self, asked: Headers, size: int) -> _Span | None:
        """What to send; None when that lies beyond the end."""
        etag = self._told["etag"]
        found = _ONE_RANGE.fullmatch(asked.get("range", "").strip())
        if found is None or not any(found.groups()) or asked.get("if-range", etag) != etag:
            return _Span(0, size)
        first, last = found.groups()
        if not first:
            return _Span(max(0, size - int(last)), size) if int(last) else None
        if last and int(last) < int(first):
            return _Span(0, size)  # not valid, and to be ignored, says RFC 9110
        return _Span(int(first), min(size, int(last) + 1) if last else size) if int(first) < size else None


def _begun(pieces: Iterator[bytes]) -> Iterator[bytes]:
    """The same, with the first one at hand: what goes wrong at once can still be said."""
    return chain([next(pieces, b"")], pieces)
