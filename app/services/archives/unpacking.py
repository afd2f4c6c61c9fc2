"""Zip files that somebody else has made: read in pieces and within limits, so that a small file fills no memory.

Four megabytes can hold a gigabyte of noughts. What a zip file says about itself is looked at before anything of it is
unpacked, and nothing is unpacked beyond what it said.
"""

import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

PIECE_BYTES = 1 << 20
LARGEST_DIRECTORY_BYTES = 8 << 20
"""Of the list of contents, which is read at once: about seventy thousand files."""
HIGHEST_RATIO = 300
"""Unpacked to packed. Answers reach 10, a long consent text that everybody agreed to 115; noughts reach 1000."""
RATIO_FROM_BYTES = 4 << 20
"""What is unpacked to less than this does no harm, whatever its ratio."""

UNREADABLE = (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, KeyError, OSError)
"""What reading a damaged zip file may raise."""


class ZipRefused(ValueError):
    """This zip file could do harm; says why."""


class _InPieces:
    """A file of which nobody reads more at once than the list of contents may take."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        self.seek, self.tell, self.seekable = file.seek, file.tell, file.seekable

    def read(self, size: int = -1) -> bytes:
        if size < 0:
            here = self.tell()
            size = self.seek(0, 2) - here
            self.seek(here)
        if size > LARGEST_DIRECTORY_BYTES:
            raise ZipRefused("its list of contents is too long")
        return self._file.read(size)


@contextmanager
def opened(source: Path | IO[bytes], most_bytes: int) -> Iterator[zipfile.ZipFile]:
    """The zip file, when what it says about itself is within the limits. Raises ZipRefused and BadZipFile."""
    if isinstance(source, Path):
        with source.open("rb") as file, opened(file, most_bytes) as archive:
            yield archive
        return
    with zipfile.ZipFile(_InPieces(source)) as archive:  # all that is used of a file
        source.seek(0, 2)
        _check(archive.infolist(), source.tell(), most_bytes)
        yield archive


def _check(members: list[zipfile.ZipInfo], packed_bytes: int, most_bytes: int) -> None:
    names = [each.filename for each in members]
    if len(set(names)) < len(names):
        raise ZipRefused("it holds two files of one name")
    if any(each.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED) for each in members):
        raise ZipRefused("it is packed in a way that is not read here")
    if any(each.flag_bits & 1 for each in members):
        raise ZipRefused("it is protected by a password")
    if any(_swells(each.file_size, each.compress_size) for each in members):
        raise ZipRefused("it would unpack to far more than it is")
    total = sum(each.file_size for each in members)
    if _swells(total, packed_bytes):  # members may lie over each other
        raise ZipRefused("it would unpack to far more than it is")
    if total > most_bytes:
        raise ZipRefused(f"it would unpack to {total / 1e9:.1f} GB, and at most {most_bytes / 1e9:.1f} GB are read")


def _swells(unpacked: int, packed: int) -> bool:
    return unpacked > RATIO_FROM_BYTES and unpacked > HIGHEST_RATIO * packed


def pieces(archive: zipfile.ZipFile, name: str, most_bytes: int) -> Iterator[bytes]:
    """The member's content. Raises ZipRefused when it is larger than that, and what UNREADABLE lists."""
    if archive.getinfo(name).file_size > most_bytes:
        raise ZipRefused(f"{name[:80]} in it is larger than {most_bytes / 1e6:.0f} MB")
    with archive.open(name) as stream:
        while piece := stream.read(PIECE_BYTES):
            yield piece


def content(archive: zipfile.ZipFile, name: str, most_bytes: int) -> bytes:
    """The whole member at once; raises as pieces() does."""
    return b"".join(pieces(archive, name, most_bytes))
