"""Opening an archive that comes in: it is hostile until it has been looked at, its rows by archive_rows.

Everything is read in pieces: the rows of a table go to a file of their own, line by line, and only the ids that others
refer to are remembered. Whoever may import could otherwise make accounts, take over what belongs to other studies, or
fill the memory of the web server.
"""

import base64
import hashlib
import json
import shutil
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import IO, Any

from pydantic import ValidationError
from sqlalchemy import Table

from app import signing
from app.db import Base, UtcDateTime
from app.services.archives import sealing, unpacking
from app.services.archives.archive import (
    FORMAT,
    LARGEST_MANIFEST_BYTES,
    MANIFEST,
    SEALED,
    VERSION,
    ArchiveInvalid,
    Manifest,
    tables_of,
)
from app.services.archives.archive_rows import SHA256, RowCheck
from app.services.archives.unpacking import ZipRefused

LARGEST_UNPACKED_BYTES = 64 << 30
LARGEST_TABLE_BYTES = 4 << 30
LARGEST_FILE_BYTES = 4 << 30
_OLDEST_VERSION = 1


@dataclass(frozen=True)
class Checked:
    """An archive whose rows have been looked at; they lie in ``folder``, one file per table."""

    manifest: Manifest
    folder: Path

    def rows(self, table_name: str) -> Iterator[dict[str, Any]]:
        """The rows of a table, times as times."""
        path = self.folder / table_name
        if path.exists():
            table = Base.metadata.tables[table_name]
            with path.open("rb") as lines:
                for line in lines:
                    yield _from_stored(table, json.loads(line))


TakeFile = Callable[[str, Iterator[bytes]], None]
"""What becomes of a file: its hash, which has yet to be compared, and its content."""


@contextmanager
def checked(
    source: Path | IO[bytes], workspace: Path, seal_key: str, take: TakeFile, is_here: Callable[[str], bool]
) -> Iterator[Checked]:
    """Everything in the archive, looked at. ``workspace``: a folder for files that are gone afterwards.

    ``is_here``: whether this installation has a file already, which an archive may not refer to without bringing it.
    Raises ArchiveInvalid.
    """
    workspace.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=workspace, prefix="import-") as name:
        folder = Path(name)
        with _in_words():
            ready = _read(source, folder, seal_key, take, is_here)
        yield ready


def verify(path: Path, workspace: Path, seal_key: str) -> str | None:
    """Read back what was written, as another installation would. Returns whose key has signed it, if it is signed.

    Raises ArchiveInvalid.
    """

    def take(sha256: str, pieces: Iterator[bytes]) -> None:
        digest = hashlib.sha256()
        for piece in pieces:
            digest.update(piece)
        if digest.hexdigest() != sha256:
            raise ArchiveInvalid("A file in this archive is damaged.")

    with checked(path, workspace, seal_key, take, lambda _sha256: False) as ready:
        return ready.manifest.signer


@contextmanager
def _in_words() -> Iterator[None]:
    try:
        yield
    except ZipRefused as error:
        raise ArchiveInvalid(f"This file is not read: {error}. Nothing was imported.") from error
    except (*unpacking.UNREADABLE, ValueError, RecursionError) as error:
        raise ArchiveInvalid from error


def _read(
    source: Path | IO[bytes], folder: Path, seal_key: str, take: TakeFile, is_here: Callable[[str], bool]
) -> Checked:
    with unpacking.opened(source, LARGEST_UNPACKED_BYTES) as archive:
        manifest = _manifest(archive)
        if not manifest.sealed:
            return _read_plain(archive, manifest, folder, take, is_here)
        plain = folder / SEALED
        _need_room(folder, archive)
        _unseal(archive, plain, seal_key)
    with unpacking.opened(plain, LARGEST_UNPACKED_BYTES) as inside:
        ready = _read_plain(inside, _manifest(inside), folder, take, is_here)
    plain.unlink()
    return ready


def _need_room(folder: Path, archive: zipfile.ZipFile) -> None:
    needed = sum(each.file_size for each in archive.infolist())
    if shutil.disk_usage(folder).free < needed:
        raise ArchiveInvalid(f"There is no room for this archive: {needed / 1e9:.1f} GB are needed on the disk.")


def _unseal(archive: zipfile.ZipFile, target: Path, seal_key: str) -> None:
    if not seal_key.strip():
        raise ArchiveInvalid(
            "This archive is sealed, because its study is blinded. Type its seal key as well: the page “Data as files” "
            "of the studio it comes from shows it. Nothing was imported."
        )
    try:
        with archive.open(SEALED) as source, target.open("wb") as plain:
            sealing.unseal(source, plain, seal_key)
    except sealing.SealBroken as error:
        raise ArchiveInvalid("This seal key does not open this archive, or the archive is damaged.") from error


def _manifest(archive: zipfile.ZipFile) -> Manifest:
    stored = json.loads(unpacking.content(archive, MANIFEST, LARGEST_MANIFEST_BYTES))
    if not isinstance(stored, dict) or stored.get("format") != FORMAT:
        raise ArchiveInvalid
    version = stored.get("version")
    if version not in range(_OLDEST_VERSION, VERSION + 1):
        raise ArchiveInvalid(
            f"This archive has version {str(version)[:20]}, and this installation reads version {VERSION} and older. "
            "Update the older of the two installations."
        )
    try:
        signer = signing.signer_of(stored)
        return Manifest.model_validate(stored).model_copy(update={"signer": signer})
    except signing.SignatureBroken as error:
        raise ArchiveInvalid(f"The signature of this archive is broken. {error} Nothing was imported.") from error
    except ValidationError as error:
        place = ".".join(str(part) for part in error.errors()[0]["loc"])
        raise ArchiveInvalid(f"The manifest of this archive is damaged: {place[:80]}. Nothing was imported.") from error


def _read_plain(
    archive: zipfile.ZipFile, manifest: Manifest, folder: Path, take: TakeFile, is_here: Callable[[str], bool]
) -> Checked:
    _need_room(folder, archive)
    known = [table for table, _ in tables_of(0)]
    _refuse(sorted(manifest.tables.keys() - {table.name for table in known}), "a table that no archive of a study has")
    places = {_place(name, each.sealed) for name, each in manifest.tables.items()}
    expected = {MANIFEST, *places, *(f"files/{sha256}" for sha256 in manifest.files)}
    _refuse(sorted(set(archive.namelist()) - expected), "a file that its manifest does not list")
    check = RowCheck(manifest, is_here)
    for table in known:
        if table.name in manifest.tables:
            _extract(archive, manifest, table.name, folder / table.name)
            check.table(table, folder / table.name)
    check.whole()
    for sha256, size in manifest.files.items():
        if not SHA256.fullmatch(sha256) or archive.getinfo(f"files/{sha256}").file_size != size:
            raise ArchiveInvalid("A file in this archive is damaged. Nothing was imported.")
        take(sha256, unpacking.pieces(archive, f"files/{sha256}", LARGEST_FILE_BYTES))
    return Checked(manifest, folder)


def _refuse(names: list[str], what: str) -> None:
    if names:
        raise ArchiveInvalid(f"This archive holds {what}: {names[0][:60]}. Nothing was imported.")


def _place(table_name: str, sealed: bool) -> str:
    return f"rows/{table_name}.{'sealed' if sealed else 'jsonl'}"


def _extract(archive: zipfile.ZipFile, manifest: Manifest, table_name: str, target: Path) -> None:
    """Put the lines of a table into a file, when they are what the manifest says."""
    said = manifest.tables[table_name]
    pieces = unpacking.pieces(archive, _place(table_name, said.sealed), LARGEST_TABLE_BYTES)
    digest = hashlib.sha256()
    with target.open("wb") as lines:
        for piece in _of_version_1(pieces) if said.sealed else pieces:
            digest.update(piece)
            lines.write(piece)
    if digest.hexdigest() != said.sha256:
        raise ArchiveInvalid(f"The table {table_name} in this archive is damaged. Nothing was imported.")


def _of_version_1(pieces: Iterator[bytes]) -> Iterator[bytes]:
    """What version 1 called sealed: compressed, then written as text."""
    unzip, left, packed, unpacked = zlib.decompressobj(), b"", 0, 0
    for piece in pieces:
        packed += len(piece)
        text = left + piece
        whole = len(text) // 4 * 4
        left, waiting = text[whole:], base64.b64decode(text[:whole], validate=True)
        while waiting:
            opened = unzip.decompress(waiting, unpacking.PIECE_BYTES)
            unpacked, waiting = unpacked + len(opened), unzip.unconsumed_tail
            if unpacked > max(unpacking.RATIO_FROM_BYTES, unpacking.HIGHEST_RATIO * packed):
                raise ZipRefused("it would unpack to far more than it is")
            yield opened
    if left or not unzip.eof:
        raise ArchiveInvalid


def _from_stored(table: Table, row: Mapping[str, Any]) -> dict[str, Any]:
    return {
        name: datetime.fromisoformat(value)
        if value is not None and isinstance(table.c[name].type, UtcDateTime)
        else value
        for name, value in row.items()
    }
