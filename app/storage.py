"""Artefacts (videos, trajectories, models, bundles) in a directory, each under the hash of its content."""

import hashlib
import logging
import os
import re
import stat
import tempfile
import time
from contextlib import suppress
from http import HTTPStatus
from pathlib import Path
from typing import NamedTuple

from app.errors import AppError
from app.settings import Settings

log = logging.getLogger("app.storage")

_OTHERS = 0o077
_OURS = (
    *("engine.sqlite3*", "*.lock", "artefacts", "unfinished", "backup*", "replaced-*", "restoring-*"),
    "signing.key",
)
"""In the data directory, beside the database. Closing a directory closes what is in it."""
_WRITING = ".writing-"
_SHA256 = re.compile(r"[0-9a-f]{64}")


LARGEST_CHECKED_BYTES = 256 * 1024**2
"""Larger files, which are exports, are not read through before they are used; a scrub does that."""


class ArtefactMissing(AppError):
    """A stored file is missing. Ask the experimenter to check that the data directory is complete."""

    status = HTTPStatus.NOT_FOUND


class ArtefactDamaged(ArtefactMissing):
    """A stored file is damaged: it no longer holds what was stored. Ask the experimenter to look at the dashboard."""


def keep_private(settings: Settings) -> None:
    """What people said and did is nobody else's on this machine: files are made for this account alone from now on.

    Those that an earlier version has made readable for all are closed.
    """
    os.umask(_OTHERS)
    found = [each for pattern in _OURS for each in settings.data_dir.glob(pattern)]
    database = settings.sqlalchemy_url.partition("sqlite:///")[2].partition("?")[0]
    if database:
        found += Path(database).parent.glob(f"{Path(database).name}*")
    for path in found:
        with suppress(PermissionError, FileNotFoundError):  # another account's, which can close it; or just gone
            mode = stat.S_IMODE(path.stat().st_mode)
            if mode & _OTHERS:
                path.chmod(mode & ~_OTHERS)


class ArtefactStore:
    """Files named by the SHA-256 of their bytes, so that a reference can neither dangle half-written nor go stale.

    What turns out to be damaged is set aside: whoever finds the file missing can make it anew under the same name. Of
    what turns out to be missing an empty file is set aside, so that the folder ``damaged`` says all that is wrong.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        self._aside = root.parent / "damaged"
        self._whole: dict[str, _Signature] = {}
        """files whose content was compared with their names, as they were then"""

    def put(self, content: bytes) -> str:
        """Store the bytes and return their hash. Complete or absent, never half: temporary file, fsync, rename."""
        sha256 = hashlib.sha256(content).hexdigest()
        target = self.path(sha256)
        if target.exists() and self._is_whole(sha256, target):
            target.touch()  # wanted again: whoever clears away what nobody refers to shall not take it for old
            self._whole[sha256] = _signature(target)
            return sha256
        target.parent.mkdir(parents=True, exist_ok=True)
        descriptor, temporary = tempfile.mkstemp(dir=target.parent, prefix=_WRITING)
        try:
            with os.fdopen(descriptor, "wb") as stream:
                stream.write(content)
                stream.flush()
                os.fsync(stream.fileno())
            Path(temporary).replace(target)
        finally:
            Path(temporary).unlink(missing_ok=True)
        _sync_directory(target.parent)
        self._is_back(sha256)
        return sha256

    def take(self, path: Path) -> str:
        """Move a finished file into the store and return its hash; for files too large to hold in memory.

        The file must lie on the same disk, below unfinished() for instance.
        """
        sha256 = hash_of_file(path)
        target = self.path(sha256)
        target.parent.mkdir(parents=True, exist_ok=True)
        with path.open("rb") as stream:
            os.fsync(stream.fileno())
        path.replace(target)
        _sync_directory(target.parent)
        self._is_back(sha256)
        return sha256

    def path(self, sha256: str) -> Path:
        """Where the artefact lies or would lie. Raises ArtefactMissing for anything that is not a hash."""
        if not _SHA256.fullmatch(sha256):
            raise ArtefactMissing
        return self.root / sha256[:2] / sha256

    def verified(self, sha256: str) -> Path:
        """Where the artefact lies, once its content was compared with its name; only a changed file is read again.

        Raises ArtefactMissing and ArtefactDamaged, and sets aside.
        """
        path = self.path(sha256)
        try:
            whole = self._is_whole(sha256, path)
        except FileNotFoundError as error:
            damaged = self._aside / sha256
            if damaged.exists() and damaged.stat().st_size:
                raise ArtefactDamaged from error
            self._note_missing(sha256)
            raise ArtefactMissing from error
        if not whole:
            self._set_aside(sha256, path)
            raise ArtefactDamaged
        return path

    def read(self, sha256: str) -> bytes:
        """The bytes, verified against their name. Raises ArtefactMissing and ArtefactDamaged."""
        try:
            content = self.path(sha256).read_bytes()
        except FileNotFoundError:
            return self.verified(sha256).read_bytes()  # which says what is wrong
        if hashlib.sha256(content).hexdigest() != sha256:
            self._set_aside(sha256, self.path(sha256))
            raise ArtefactDamaged
        return content

    def has(self, sha256: str) -> bool:
        """Whether the artefact is there, and whole."""
        try:
            self.verified(sha256)
        except ArtefactMissing:
            return False
        return True

    def holds(self, sha256: str) -> bool:
        """Whether there is a file of this name, whole or not; unlike has() for files that need not be there."""
        return self.path(sha256).exists()

    def scrub(self, sha256: str) -> bool:
        """Like has(), but reads the whole file, whatever was known about it."""
        self._whole.pop(sha256, None)
        path = self.path(sha256)
        if path.exists() and hash_of_file(path) != sha256:
            self._set_aside(sha256, path)
        return self.has(sha256)

    def lost(self) -> dict[str, int]:
        """What was found to be damaged or missing and is not back yet, with when that was (seconds since 1970)."""
        lost: dict[str, int] = {}
        for aside in self._aside.glob("?" * 64):
            if self.path(aside.name).exists():
                aside.unlink(missing_ok=True)
            else:
                lost[aside.name] = int(aside.stat().st_ctime)
        return lost

    def older_than(self, seconds: float) -> set[str]:
        """The artefacts that nobody has put here for so long. Half-written files of that age are removed."""
        newest_s, old = time.time() - seconds, set()
        for path in self.root.glob("??/*"):
            if path.stat().st_mtime >= newest_s:
                continue
            if path.name.startswith(_WRITING):
                path.unlink(missing_ok=True)
            else:
                old.add(path.name)
        return old

    def unfinished(self, participant_id: int) -> Path:
        """A folder for what long trainings for one person keep until they are done; it may not exist."""
        return self.root.parent / "unfinished" / f"participant-{participant_id}"

    def delete(self, sha256: str) -> None:
        """Remove the artefact if it is there, damaged or not."""
        self.path(sha256).unlink(missing_ok=True)
        self._is_back(sha256)

    def _is_whole(self, sha256: str, path: Path) -> bool:
        signature = _signature(path)
        if self._whole.get(sha256) != signature:
            if signature.size <= LARGEST_CHECKED_BYTES and hash_of_file(path) != sha256:
                return False
            self._whole[sha256] = signature
        return True

    def _set_aside(self, sha256: str, path: Path) -> None:
        log.error("the stored file %s is damaged; it is kept in %s", sha256, self._aside)
        with suppress(OSError):  # a disk that cannot be written to is another trouble, which others report
            self._aside.mkdir(exist_ok=True)
            path.replace(self._aside / sha256)

    def _note_missing(self, sha256: str) -> None:
        with suppress(OSError):
            self._aside.mkdir(exist_ok=True)
            (self._aside / sha256).touch(exist_ok=False)
            log.error("the stored file %s is missing", sha256)

    def _is_back(self, sha256: str) -> None:
        (self._aside / sha256).unlink(missing_ok=True)


class _Signature(NamedTuple):
    """What changes whenever somebody writes to a file."""

    inode: int
    size: int
    modified_ns: int
    changed_ns: int


def _signature(path: Path) -> _Signature:
    stat = path.stat()
    return _Signature(stat.st_ino, stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns)


def hash_of_file(path: Path) -> str:
    """SHA-256 of a file's content, read in pieces."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _sync_directory(directory: Path) -> None:
    descriptor = os.open(directory, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
