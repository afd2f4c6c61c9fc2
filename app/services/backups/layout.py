"""What a backup is: one folder that is complete or absent, each file of it under a hash that the manifest says.

    manifest.json            when, by which version, of which schema, and what every other file must hash to
    studio.sqlite3           the database
    artefacts/ab/abcdef...   the files that its rows name, under the hash of their content
    beside/<name>            what else lies in the data directory, such as keys

The manifest names no paths: where a file lies follows from its hash, so none can lead out of the folder. Backups in one
directory share the files they have in common (hard links); each is whole without the others.
"""

import hashlib
import os
import re
import stat
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime
from http import HTTPStatus
from pathlib import Path
from typing import Annotated, Literal

from pydantic import AwareDatetime, BaseModel, Field, ValidationError

from app.errors import AppError

FORMAT, VERSION = "pbarl-studio-backup", 1
MANIFEST, DATABASE, ARTEFACTS, BESIDE = "manifest.json", "studio.sqlite3", "artefacts", "beside"
NAME, DRAFT = "backup-", ".making-"
"""How names of folders begin: of backups, and of those that are not finished."""
LARGEST_MANIFEST_BYTES = 128 << 20
"""About a million files."""
LARGEST_BESIDE_BYTES = 1 << 20
_PIECE_BYTES = 1 << 20
_BESIDE_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,99}")
_NOT_BESIDE = re.compile(r"studio\.sqlite3.*|engine\.sqlite3.*|.*\.lock|falls\..*|backups\..*|.*\.writing")
"""What each start makes anew, or what is taken in another way."""

Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
ByteCount = Annotated[int, Field(ge=0)]


class BackupRefused(AppError):
    """This is not a whole backup, and it was not restored."""

    status = HTTPStatus.UNPROCESSABLE_ENTITY


class File(BaseModel):
    """What a file must be."""

    sha256: Sha256
    byte_count: ByteCount


class Manifest(BaseModel):
    """manifest.json."""

    format: Literal["pbarl-studio-backup"]
    version: int
    software_version: str = ""
    made_at: AwareDatetime
    """The database is as it was then or a little later."""
    revision: str
    """Of the database's schema."""
    database: File
    rows: dict[str, int]
    """How many each table has."""
    artefacts: dict[Sha256, ByteCount]
    missing: list[Sha256]
    """Files that the database names, and that the studio had lost already."""
    beside: dict[str, File]
    people: list[str]
    """Participants and studies that are in it and were not erased then, see snapshots.Identity."""


@dataclass(frozen=True)
class Backup:
    """A finished backup; whether its files are what the manifest says is another question."""

    folder: Path
    manifest: Manifest

    @property
    def byte_count(self) -> int:
        """Of all files, shared or not."""
        manifest = self.manifest
        beside = sum(file.byte_count for file in manifest.beside.values())
        return manifest.database.byte_count + sum(manifest.artefacts.values()) + beside


def opened(folder: Path) -> Backup:
    """The backup in a folder, its manifest read and nothing else. Raises BackupRefused."""
    if not (folder / MANIFEST).exists():
        found = folders_in(folder)
        hint = f" It is a directory of backups; the newest is {found[-1]}." if found else ""
        raise BackupRefused(f"{folder} is no backup, or one that was never finished: it has no {MANIFEST}.{hint}")
    try:
        content = b"".join(pieces(folder / MANIFEST, None, LARGEST_MANIFEST_BYTES))
        manifest = Manifest.model_validate_json(content)
    except ValidationError as error:
        place = ".".join(str(part) for part in error.errors()[0]["loc"])
        raise BackupRefused(f"The manifest of {folder} is damaged or not one of a backup: {place[:80]}.") from error
    if manifest.version != VERSION:
        raise BackupRefused(
            f"{folder} is a backup of format {manifest.version}, and this version of the studio reads format {VERSION}."
        )
    for name in manifest.beside:
        if not is_beside(name):
            raise BackupRefused(f"{folder} holds a file that no backup has: {name[:80]}. Nothing was restored.")
    return Backup(folder, manifest)


def folders_in(directory: Path) -> list[Path]:
    """The finished backups in a directory, the oldest first."""
    return sorted(each for each in directory.glob(f"{NAME}*") if (each / MANIFEST).is_file())


def name_of(made_at: datetime) -> str:
    """Sorted by name is sorted by time."""
    return f"{NAME}{made_at:%Y%m%dT%H%M%S.%f}Z"


def is_beside(name: str) -> bool:
    """Whether a file of this name beside the database belongs to a backup."""
    return _BESIDE_NAME.fullmatch(name) is not None and _NOT_BESIDE.fullmatch(name) is None


def files(manifest: Manifest) -> Iterator[tuple[str, File]]:
    """Every file but the manifest: its place in the folder, and what it must be."""
    yield DATABASE, manifest.database
    for sha256, byte_count in manifest.artefacts.items():
        yield artefact(sha256), File.model_construct(sha256=sha256, byte_count=byte_count)
    for name, file in manifest.beside.items():
        yield f"{BESIDE}/{name}", file


def artefact(sha256: str) -> str:
    """The place of an artefact; the same as in the studio's own store."""
    return f"{ARTEFACTS}/{sha256[:2]}/{sha256}"


def require_no_links(backup: Backup) -> None:
    """Raises BackupRefused when a folder in it is a link to elsewhere; pieces() refuses files that are."""
    parents = {(backup.folder / place).parent for place, _ in files(backup.manifest)} - {backup.folder}
    for folder in sorted(parents | {each.parent for each in parents} - {backup.folder}):
        if folder.is_symlink():
            raise BackupRefused(f"{folder} is a link to elsewhere, which no backup has. Nothing was restored.")


def pieces(path: Path, expected: File | None, most_bytes: int | None = None) -> Iterator[bytes]:
    """The content of a file, which is compared with what it must be. Raises BackupRefused, at the latest at its end."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)  # neither links nor pipes
    except FileNotFoundError as error:
        raise BackupRefused(f"{path} is missing. This backup is not whole; take another one.") from error
    except OSError as error:
        raise BackupRefused(f"{path} cannot be read: {error.strerror}.") from error
    digest = hashlib.sha256()
    try:
        found = os.fstat(descriptor)
        if not stat.S_ISREG(found.st_mode):
            raise BackupRefused(f"{path} is no ordinary file, which no backup has. Nothing was restored.")
        if most_bytes is not None and found.st_size > most_bytes:
            raise BackupRefused(f"{path} is larger than {most_bytes / 1e6:.0f} MB, which no backup has.")
        if expected is not None and found.st_size != expected.byte_count:
            raise BackupRefused(f"{path} is damaged: its size differs. This backup is not whole; take another one.")
        left = found.st_size
        while left and (piece := _read(path, descriptor, min(left, _PIECE_BYTES))):
            left -= len(piece)
            digest.update(piece)
            yield piece
    finally:
        os.close(descriptor)
    if expected is not None and (left or digest.hexdigest() != expected.sha256):
        raise BackupRefused(f"{path} is damaged. This backup is not whole; take another one.")


def _read(path: Path, descriptor: int, byte_count: int) -> bytes:
    try:
        return os.read(descriptor, byte_count)
    except OSError as error:  # a disk that dies
        raise BackupRefused(f"{path} cannot be read: {error.strerror}.") from error


def beside_in(data_dir: Path) -> Iterator[Path]:
    """The files beside the database that belong to a backup."""
    for path in sorted(data_dir.iterdir()):
        if is_beside(path.name) and path.is_file() and path.stat().st_size <= LARGEST_BESIDE_BYTES:
            yield path
