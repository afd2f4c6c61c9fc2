"""Files in a bucket of an S3-compatible server, so that machines without a common disk see the same ones.

Small ones that were read are kept in memory for a while: a browser asks for a clip in ranges, one after the other, and
a worker reads the same trajectories for every model. Nothing is kept on this machine's disk, where it would have to be
erased when somebody withdraws.
"""

import logging
import os
import time
from collections import OrderedDict
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from threading import Lock
from typing import Any, ClassVar
from urllib.parse import urlsplit

import obstore
from obstore.exceptions import BaseError
from obstore.store import S3Store

from app.errors import AppError, OncePerMinute
from app.files.interface import PIECE_BYTES, Files, Stat, StorageUnavailable

log = logging.getLogger("app.files")
log.addFilter(OncePerMinute())

TRUSTED_S = 60.0
"""So long a file is taken to be as it was. Its content is its name's hash, so it can only go or be damaged."""
SMALL_BYTES = 8 << 20
"""Larger files are read in pieces and never kept."""
KEPT_BYTES = 128 << 20
KEPT_FILES = 20_000
CONNECT_S, REQUEST_S = 2, 10
RETRIES, RETRY_S = 2, 20
"""Whoever waits longer is better told so: browsers and workers try again by themselves."""
_PARTS_AT_ONCE = 4


class BucketRefused(AppError):
    """The bucket of STORAGE_URL cannot be used. Check its name, AWS_ENDPOINT_URL and the keys in the environment."""


@dataclass
class _Known:
    stat: Stat
    asked_at_s: float
    content: bytes | None = None


class Bucket(Files):
    """A bucket, or what lies below a prefix in it. Keys and endpoint come from AWS's usual variables."""

    is_shared: ClassVar[bool] = True

    def __init__(self, url: str) -> None:
        self.url = url
        plain = (os.environ.get("AWS_ENDPOINT_URL") or "").startswith("http://")
        self._s3 = S3Store.from_url(
            url,
            region=os.environ.get("AWS_REGION") or os.environ.get("AWS_DEFAULT_REGION") or "us-east-1",
            client_options={
                "allow_http": plain,
                "connect_timeout": timedelta(seconds=CONNECT_S),
                "timeout": timedelta(seconds=REQUEST_S),
            },
            retry_config={"max_retries": RETRIES, "retry_timeout": timedelta(seconds=RETRY_S)},
        )
        self._lock = Lock()
        self._known: OrderedDict[str, _Known] = OrderedDict()
        self._kept_bytes = 0

    def require_usable(self) -> None:
        """See Files. A wrong name or key is refused; a server that is away is waited for."""
        try:
            self.probe()
        except StorageUnavailable:
            log.warning("trying again when a file is needed")

    def probe(self) -> None:
        """See Files. Raises BucketRefused."""
        try:
            obstore.put(self._s3, "probe", b"written at every start, and while somebody looks at a dashboard")
            obstore.get(self._s3, "probe")
        except FileNotFoundError as error:
            name = urlsplit(self.url).netloc
            raise BucketRefused(f"There is no bucket {name}. Make it, or correct STORAGE_URL.") from error
        except BaseError as error:
            if type(error).__name__ in ("PermissionDeniedError", "UnauthenticatedError"):
                raise BucketRefused from error
            log.warning("stored files cannot be reached: %s", _first_line(error))
            raise StorageUnavailable from error

    def put(self, name: str, content: bytes) -> None:
        """See Files."""
        self._forget(name)
        with _talking():
            obstore.put(self._s3, name, content, max_concurrency=_PARTS_AT_ONCE)

    def take(self, name: str, path: Path) -> None:
        """See Files."""
        self._forget(name)
        with _talking():
            obstore.put(self._s3, name, path, max_concurrency=_PARTS_AT_ONCE)
        path.unlink()

    def renew(self, name: str) -> bool:
        """See Files."""
        return False

    def stat(self, name: str, *, fresh: bool = False) -> Stat | None:
        """See Files."""
        if fresh:
            self._forget(name)
        if (known := self._trusted(name)) is not None:
            return known.stat
        try:
            with _talking():
                found = obstore.head(self._s3, name)
        except FileNotFoundError:
            self._forget(name)
            return None
        return self._note(name, _stat(found), None).stat

    def read(self, name: str) -> bytes:
        """See Files."""
        known = self._trusted(name)
        if known is not None and known.content is not None:
            return known.content
        with _talking():
            answer = obstore.get(self._s3, name)
            content = bytes(answer.bytes())
        self._note(name, _stat(answer.meta), content if len(content) <= SMALL_BYTES else None)
        return content

    def pieces(self, name: str, known: Stat, first: int = 0, end: int | None = None) -> Iterator[bytes]:
        """See Files. Each piece is a request of its own, so that a slow reader keeps no connection open."""
        last = known.byte_count if end is None else end
        if known.byte_count <= SMALL_BYTES:
            yield self.read(name)[first:last]
            return
        for start in range(first, last, PIECE_BYTES):
            span = (start, min(start + PIECE_BYTES, last))
            with _talking():
                yield bytes(obstore.get(self._s3, name, options={"range": span, "if_match": str(known.mark)}).bytes())

    def local(self, name: str) -> Path | None:
        """See Files."""
        return None

    def found(self, folder: str) -> Iterator[tuple[str, Stat]]:
        """See Files."""
        with _talking():
            for some in obstore.list(self._s3, folder):
                for each in some:
                    yield each["path"].removeprefix(f"{folder}/"), _stat(each)

    def rename(self, name: str, other: str) -> None:
        """See Files."""
        self._forget(name)
        with _talking():
            obstore.copy(self._s3, name, other)
            obstore.delete(self._s3, name)

    def delete(self, name: str) -> None:
        """See Files."""
        self._forget(name)
        with _talking(), suppress(FileNotFoundError):
            obstore.delete(self._s3, name)

    def clear(self, older_than_s: float) -> None:
        """See Files. What was uploaded in part is the server's: buckets have a rule for that (docs/deploy.md)."""

    def _trusted(self, name: str) -> _Known | None:
        with self._lock:
            known = self._known.get(name)
            if known is None or time.monotonic() - known.asked_at_s > TRUSTED_S:
                return None
            self._known.move_to_end(name)
            return known

    def _note(self, name: str, stat: Stat, content: bytes | None) -> _Known:
        """Remember what was found; the content of a file that has not changed stays known."""
        with self._lock:
            before = self._known.pop(name, None)
            if content is None and before is not None and before.stat.mark == stat.mark:
                content = before.content
            self._kept_bytes += len(content or b"") - len((before and before.content) or b"")
            known = self._known[name] = _Known(stat, time.monotonic(), content)
            while self._kept_bytes > KEPT_BYTES or len(self._known) > KEPT_FILES:
                _, oldest = self._known.popitem(last=False)
                self._kept_bytes -= len(oldest.content or b"")
            return known

    def _forget(self, name: str) -> None:
        with self._lock:
            before = self._known.pop(name, None)
            self._kept_bytes -= len((before and before.content) or b"")


def _stat(found: Any) -> Stat:
    written_at_s = found["last_modified"].timestamp()
    return Stat(found["size"], written_at_s, written_at_s, found["e_tag"])


@contextmanager
def _talking() -> Iterator[None]:
    """Whatever the server or the network does wrong is one error for everybody else."""
    try:
        yield
    except BaseError as error:
        log.error("stored files cannot be reached: %s", _first_line(error))
        raise StorageUnavailable from error


def _first_line(error: Exception) -> str:
    return str(error).strip().partition("\n")[0][:300]
