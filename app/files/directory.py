"""Files in a directory of this machine."""

import os
import tempfile
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import ClassVar

from app.files.interface import PIECE_BYTES, Files, Stat

WRITING = ".writing-"


class Directory(Files):
    """A directory on a disk that keeps what it was told to flush."""

    is_shared: ClassVar[bool] = False

    def __init__(self, root: Path) -> None:
        self.root = root

    def put(self, name: str, content: bytes) -> None:
        """See Files: temporary file, fsync, rename."""
        target = self.root / name
        target.parent.mkdir(parents=True, exist_ok=True)
        descriptor, temporary = tempfile.mkstemp(dir=target.parent, prefix=WRITING)
        try:
            with os.fdopen(descriptor, "wb") as stream:
                stream.write(content)
                stream.flush()
                os.fsync(stream.fileno())
            Path(temporary).replace(target)
        finally:
            Path(temporary).unlink(missing_ok=True)
        _sync(target.parent)

    def take(self, name: str, path: Path) -> None:
        """See Files. The file must lie on the same disk."""
        target = self.root / name
        target.parent.mkdir(parents=True, exist_ok=True)
        with path.open("rb") as stream:
            os.fsync(stream.fileno())
        path.replace(target)
        _sync(target.parent)

    def renew(self, name: str) -> bool:
        """See Files."""
        (self.root / name).touch()
        return True

    def stat(self, name: str, *, fresh: bool = False) -> Stat | None:
        """See Files."""
        try:
            return _stat(self.root / name)
        except FileNotFoundError:
            return None

    def read(self, name: str) -> bytes:
        """See Files."""
        return (self.root / name).read_bytes()

    def pieces(self, name: str, known: Stat, first: int = 0, end: int | None = None) -> Iterator[bytes]:
        """See Files."""
        left = (known.byte_count if end is None else end) - first
        with (self.root / name).open("rb") as stream:
            stream.seek(first)
            while left > 0 and (piece := stream.read(min(PIECE_BYTES, left))):
                left -= len(piece)
                yield piece

    def local(self, name: str) -> Path | None:
        """See Files."""
        return self.root / name

    def found(self, folder: str) -> Iterator[tuple[str, Stat]]:
        """See Files."""
        base = self.root / folder
        for path in base.rglob("*"):
            with suppress(FileNotFoundError):  # deleted meanwhile
                if path.is_file() and not path.name.startswith(WRITING):
                    yield str(path.relative_to(base)), _stat(path)

    def rename(self, name: str, other: str) -> None:
        """See Files."""
        target = self.root / other
        target.parent.mkdir(parents=True, exist_ok=True)
        (self.root / name).replace(target)

    def delete(self, name: str) -> None:
        """See Files."""
        (self.root / name).unlink(missing_ok=True)

    def clear(self, older_than_s: float) -> None:
        """See Files."""
        newest_s = time.time() - older_than_s
        for path in self.root.glob(f"artefacts/??/{WRITING}*"):
            if path.stat().st_mtime < newest_s:
                path.unlink(missing_ok=True)


def _stat(path: Path) -> Stat:
    stat = path.stat()
    mark = (stat.st_ino, stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns)
    return Stat(stat.st_size, stat.st_mtime, stat.st_ctime, mark)


def _sync(directory: Path) -> None:
    descriptor = os.open(directory, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
