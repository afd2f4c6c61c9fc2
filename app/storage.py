"""Artefacts (videos, trajectories, models, bundles) in a directory, each under the hash of its content."""

import hashlib
import os
import re
import stat
import tempfile
import time
from contextlib import suppress
from pathlib import Path

from app.errors import AppError
from app.settings import Settings

_OTHERS = 0o077
_OURS = ("engine.sqlite3*", "*.lock", "artefacts", "unfinished", "backup*")
"""In the data directory, beside the database. Closing a directory closes what is in it."""
_WRITING = ".writing-"
_SHA256 = re.compile(r"[0-9a-f]{64}")


class ArtefactMissing(AppError):
    """A stored file is missing. Ask the experimenter to check that the data directory is complete."""


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
    """Files named by the SHA-256 of their bytes, so that a reference can neither dangle half-written nor go stale."""

    def __init__(self, root: Path) -> None:
        self.root = root

    def put(self, content: bytes) -> str:
        """Store the bytes and return their hash. Complete or absent, never half: temporary file, fsync, rename."""
        sha256 = hashlib.sha256(content).hexdigest()
        target = self.path(sha256)
        if target.exists():
            target.touch()  # wanted again: whoever clears away what nobody refers to shall not take it for old
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
        return sha256

    def path(self, sha256: str) -> Path:
        """Where the artefact lies or would lie. Raises ArtefactMissing for anything that is not a hash."""
        if not _SHA256.fullmatch(sha256):
            raise ArtefactMissing
        return self.root / sha256[:2] / sha256

    def read(self, sha256: str) -> bytes:
        """The bytes, verified against their name. Raises ArtefactMissing."""
        path = self.path(sha256)
        if not path.exists():
            raise ArtefactMissing
        content = path.read_bytes()
        if hashlib.sha256(content).hexdigest() != sha256:
            raise ArtefactMissing(f"The stored file {sha256[:12]} is damaged. Restore it from a backup.")
        return content

    def has(self, sha256: str) -> bool:
        """Whether the artefact is there."""
        return self.path(sha256).exists()

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
        """Remove the artefact if it is there."""
        self.path(sha256).unlink(missing_ok=True)


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
