"""What a place for files must be able to do. Names have slashes, such as ``artefacts/ab/abcdef``."""

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Iterator
from http import HTTPStatus
from pathlib import Path
from typing import ClassVar, NamedTuple

from app.errors import AppError

PIECE_BYTES = 4 << 20
"""No more than this of a large file is ever in memory."""


class StorageUnavailable(AppError):
    """Stored files cannot be reached at the moment. Nothing that was answered is lost; please try again in a minute."""

    status = HTTPStatus.SERVICE_UNAVAILABLE


class Stat(NamedTuple):
    """What is known of a file without reading it."""

    byte_count: int
    written_at_s: float
    """Seconds since 1970, by the clock of whoever keeps the file."""
    placed_at_s: float
    """When it was given this name, by the same clock."""
    mark: object
    """Differs whenever somebody has written to the file."""


class Files(ABC):
    """Files under names. Each is complete or absent, whoever is killed meanwhile.

    Nothing here asks for a lock or a conditional write: a name is either the hash of its content, so that two who write
    it write the same, or belongs to one run of one worker. Every S3-compatible server can do that much.
    """

    is_shared: ClassVar[bool]
    """Whether other machines see the same files."""

    def require_usable(self) -> None:  # noqa: B027  (a directory makes itself)
        """At the start of a program. Raises AppError for what no waiting mends."""

    def probe(self) -> None:  # noqa: B027  (whether a directory can be written to, the database tells)
        """Write and read something small. Raises StorageUnavailable, and AppError for what no waiting mends."""

    @abstractmethod
    def put(self, name: str, content: bytes) -> None:
        """Write a file, or write it anew."""

    @abstractmethod
    def take(self, name: str, path: Path) -> None:
        """Move a local file here; for files too large to hold in memory."""

    @abstractmethod
    def renew(self, name: str) -> bool:
        """Make a file that is there already look just written; False when it has to be written for that."""

    @abstractmethod
    def stat(self, name: str, *, fresh: bool = False) -> Stat | None:
        """What is known of the file, None when there is none. ``fresh``: nothing that was known before will do."""

    @abstractmethod
    def read(self, name: str) -> bytes:
        """The whole file. Raises FileNotFoundError."""

    @abstractmethod
    def pieces(self, name: str, known: Stat, first: int = 0, end: int | None = None) -> Iterator[bytes]:
        """The bytes from ``first`` up to, not including, ``end``, of the file as it was when ``known`` was asked.

        Raises FileNotFoundError.
        """

    @abstractmethod
    def local(self, name: str) -> Path | None:
        """Where the file lies on this machine; None when it lies on another."""

    @abstractmethod
    def found(self, folder: str) -> Iterator[tuple[str, Stat]]:
        """Names below the folder, without it, and what is known of each; half-written ones are left out."""

    @abstractmethod
    def rename(self, name: str, other: str) -> None:
        """Give a file another name. Raises FileNotFoundError."""

    @abstractmethod
    def delete(self, name: str) -> None:
        """Remove the file if it is there."""

    @abstractmethod
    def clear(self, older_than_s: float) -> None:
        """Remove what was begun so many seconds ago and never written to its end."""

    def sha256(self, name: str, known: Stat) -> str:
        """The hash of the file's content, read in pieces. Raises FileNotFoundError."""
        digest = hashlib.sha256()
        for piece in self.pieces(name, known):
            digest.update(piece)
        return digest.hexdigest()
