"""Artefacts (videos, trajectories, models, bundles), each under the hash of its content, in a directory or a bucket."""

import hashlib
import logging
import os
import stat
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from http import HTTPStatus
from pathlib import Path

from app.errors import AppError
from app.files.directory import Directory
from app.files.interface import Files, Stat, StorageUnavailable
from app.files.lost import ARTEFACTS, DAMAGED, SHA256, Lost, aside, place
from app.files.unfinished import FOLDER, Unfinished
from app.settings import Settings

log = logging.getLogger("app.storage")

_OTHERS = 0o077
_OURS = (
    *("engine.sqlite3*", "*.lock", "artefacts", "unfinished", "backup*", "replaced-*", "restoring-*"),
    "signing.key",
)
"""In the data directory, beside the database. Closing a directory closes what is in it."""

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


@dataclass(frozen=True)
class Artefact:
    """A stored file whose content was compared with its name."""

    sha256: str
    stat: Stat
    path: Path | None
    """Where it lies on this machine; None when it lies in a bucket."""
    _name: str
    _files: Files

    def pieces(self, first: int = 0, end: int | None = None) -> Iterator[bytes]:
        """The bytes from ``first`` up to, not including, ``end``. Raises ArtefactMissing and StorageUnavailable."""
        try:
            yield from self._files.pieces(self._name, self.stat, first, end)
        except FileNotFoundError as error:
            raise ArtefactMissing from error


class ArtefactStore:
    """Files named by the SHA-256 of their bytes, so that a reference can neither dangle half-written nor go stale.

    What turns out to be damaged is set aside: whoever finds the file missing can make it anew under the same name. Of
    what turns out to be missing an empty file is set aside, so that the folder ``damaged`` says all that is wrong.

    Every method raises StorageUnavailable when the files lie in a bucket that cannot be reached, except lost() and
    seems_whole(), which never wait.
    """

    def __init__(self, root: Path, files: Files | None = None) -> None:
        """``root``: the folder of artefacts in the data directory. ``files``: where they are instead."""
        self.root = root
        self.files = files or Directory(root.parent)
        self.unfinished = Unfinished(root.parent / FOLDER, self.files)
        self._lost = Lost(self.files)
        self._whole: dict[str, object] = {}
        """files whose content was compared with their names, by the marks they had then"""

    @classmethod
    def of(cls, settings: Settings) -> "ArtefactStore":
        """The store of a studio: in its data directory, or where STORAGE_URL says."""
        root = settings.data_dir / ARTEFACTS
        if settings.storage_url is None:
            return cls(root)
        from app.files.bucket import Bucket  # whoever has a directory need not load this

        return cls(root, Bucket(settings.storage_url))

    def put(self, content: bytes) -> str:
        """Store the bytes and return their hash. Complete or absent, never half."""
        sha256 = hashlib.sha256(content).hexdigest()
        name = _name(sha256)
        # wanted again: whoever clears away what nobody refers to shall not take it for old
        if not self.files.is_shared and self._is_there_and_whole(sha256) and self.files.renew(name):
            known = self.files.stat(name)
            self._whole[sha256] = known and known.mark
            return sha256
        self.files.put(name, content)
        self._is_back(sha256)
        return sha256

    def take(self, path: Path) -> str:
        """Move a finished file into the store and return its hash; for files too large to hold in memory.

        The file must lie in a folder below ``unfinished.root``.
        """
        sha256 = hash_of_file(path)
        self.files.take(_name(sha256), path)
        self._is_back(sha256)
        return sha256

    def verified(self, sha256: str) -> Artefact:
        """The artefact, once its content was compared with its name; only a changed file is read again.

        Raises ArtefactMissing and ArtefactDamaged, and sets aside.
        """
        name = _name(sha256)
        known = self.files.stat(name)
        if known is None:
            damaged = self.files.stat(aside(sha256))
            if damaged is not None and damaged.byte_count:
                raise ArtefactDamaged
            self._note_missing(sha256)
            raise ArtefactMissing
        try:
            whole = self._is_whole(sha256, known)
        except FileNotFoundError as error:
            raise ArtefactMissing from error
        if not whole:
            self._set_aside(sha256)
            raise ArtefactDamaged
        return Artefact(sha256, known, self.files.local(name), name, self.files)

    def read(self, sha256: str) -> bytes:
        """The bytes, verified against their name. Raises ArtefactMissing and ArtefactDamaged."""
        try:
            content = self.files.read(_name(sha256))
        except FileNotFoundError:
            return b"".join(self.verified(sha256).pieces())  # which says what is wrong
        if hashlib.sha256(content).hexdigest() != sha256:
            self._set_aside(sha256)
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
        return self.files.stat(_name(sha256), fresh=True) is not None

    def seems_whole(self, sha256: str) -> bool:
        """Like has(), for whoever holds locks and must not wait for a server: nobody has found anything wrong so far.

        What is wrong is found when the file is asked for, and known here from then on.
        """
        return sha256 not in self.lost() if self.files.is_shared else self.has(sha256)

    def scrub(self, sha256: str) -> bool:
        """Like has(), but reads the whole file, whatever was known about it."""
        known = self.files.stat(_name(sha256), fresh=True)
        if known is not None:
            if self.files.sha256(_name(sha256), known) == sha256:
                self._whole[sha256] = known.mark
            else:
                self._set_aside(sha256)
        return self.has(sha256)

    def lost(self) -> dict[str, int]:
        """What was found to be damaged or missing and is not back yet, with when that was (milliseconds since 1970)."""
        return self._lost.now()

    def trouble(self) -> str | None:
        """Why files could be neither stored nor read when lost() last had somebody look, in words."""
        return self._lost.trouble

    def older_than(self, seconds: float) -> set[str]:
        """The artefacts that nobody has put here for so long. Half-written files of that age are removed."""
        newest_s = time.time() - seconds
        old = {Path(name).name for name, known in self.files.found(ARTEFACTS) if known.written_at_s < newest_s}
        self.files.clear(seconds)
        return old

    def delete(self, sha256: str) -> None:
        """Remove the artefact if it is there, damaged or not."""
        self.files.delete(_name(sha256))
        self._is_back(sha256)

    def _is_there_and_whole(self, sha256: str) -> bool:
        known = self.files.stat(_name(sha256))
        return known is not None and self._is_whole(sha256, known)

    def _is_whole(self, sha256: str, known: Stat) -> bool:
        if self._whole.get(sha256) != known.mark:
            if known.byte_count <= LARGEST_CHECKED_BYTES and self.files.sha256(_name(sha256), known) != sha256:
                return False
            self._whole[sha256] = known.mark
        return True

    def _set_aside(self, sha256: str) -> None:
        log.error("the stored file %s is damaged; it is kept in %s", sha256, DAMAGED)
        with suppress(OSError, StorageUnavailable):  # a disk that cannot be written to is what others report
            self.files.rename(_name(sha256), aside(sha256))
        self._lost.note(sha256)

    def _note_missing(self, sha256: str) -> None:
        with suppress(OSError, StorageUnavailable):
            if self.files.stat(aside(sha256)) is None:
                self.files.put(aside(sha256), b"")
                log.error("the stored file %s is missing", sha256)
        self._lost.note(sha256)

    def _is_back(self, sha256: str) -> None:
        self.files.delete(aside(sha256))
        self._lost.forget(sha256)


def _name(sha256: str) -> str:
    """Raises ArtefactMissing for anything that is not a hash."""
    if not SHA256.fullmatch(sha256):
        raise ArtefactMissing
    return place(sha256)


def hash_of_file(path: Path) -> str:
    """SHA-256 of a file's content, read in pieces."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
