"""Making a backup while everybody works: a snapshot of the database first, then the files that it names.

Files are stored under their hash, are never changed and go when no row names them any more. So whatever a snapshot
names is still there a moment later, but for what somebody's withdrawal or a newer report has removed meanwhile: then
another snapshot is taken. The engine's file and unfinished trainings are left out. The database says what is missing,
and a file of the engine from another moment than the database would be set aside anyway (decision 58).
"""

import ctypes
import errno
import fcntl
import hashlib
import os
import shutil
import sqlite3
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from sqlalchemy import URL, make_url

from app.db import now, sqlite
from app.errors import AppError
from app.services.backups import layout, snapshots, withdrawals
from app.services.backups.layout import ARTEFACTS, BESIDE, DATABASE, DRAFT, MANIFEST, Backup, File, Manifest
from app.services.exports import export_formats
from app.settings import Settings
from app.storage import ArtefactStore, hash_of_file

SPARE_BYTES = 64 << 20
"""Left free on the backup's disk."""
_SNAPSHOTS = 5
_PIECE_BYTES = 1 << 20
_LIBC = ctypes.CDLL(None, use_errno=True)


class BackupFailed(AppError):
    """The backup could not be made. Nothing is left of it."""


class BackupUnderWay(AppError):
    """Another backup into this directory is being made. Wait until it has ended, then try again."""


class OfPostgresql(AppError):
    """The database is on a PostgreSQL server, whose own tools copy it."""


class OfBucket(AppError):
    """The stored files are in a bucket, whose own tools copy it (docs/deploy.md). No backup was made."""


class _Outdated(Exception):
    """Something that the snapshot names has been removed since."""


def make(settings: Settings, directory: Path) -> Backup:
    """A finished backup in a directory of backups. Raises BackupFailed, BackupUnderWay and OfPostgresql."""
    source = database_file(settings)
    _require_outside(settings, directory)
    try:
        with only_one(directory):
            return make_now(settings, source, directory)
    except (OSError, sqlite3.Error) as error:
        raise BackupFailed(f"{BackupFailed().message} {in_words(error)}") from error


def in_words(error: OSError | sqlite3.Error) -> str:
    """What the operating system or SQLite says, on one line."""
    if isinstance(error, OSError):
        return f"{error.filename or 'The disk'}: {error.strerror or error}."
    return f"The database says: {error}."


def database_file(settings: Settings) -> Path:
    """The database to copy. Raises OfPostgresql, which says how to copy any other, and OfBucket."""
    path = sqlite.file_of(settings.sqlalchemy_url)
    if path is None:
        raise OfPostgresql(_commands_for_postgresql(settings))
    if settings.storage_url is not None:
        raise OfBucket
    return path


@contextmanager
def only_one(directory: Path) -> Iterator[None]:
    """No other backup is made into this directory meanwhile; what a killed one has left is removed.

    Raises BackupUnderWay.
    """
    directory.mkdir(mode=0o700, parents=True, exist_ok=True)
    with os.fdopen(os.open(directory / "backup.lock", os.O_WRONLY | os.O_CREAT, 0o600)) as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise BackupUnderWay from error
        for left_over in directory.glob(f"{DRAFT}*"):
            shutil.rmtree(left_over)
        yield


def make_now(settings: Settings, source: Path, directory: Path) -> Backup:
    """The same for whoever holds only_one(). Raises OSError and sqlite3.Error as well."""
    if not source.exists():
        raise BackupFailed(f"There is no studio in {settings.data_dir}: {source} does not exist.")
    earlier = layout.folders_in(directory)
    for _ in range(_SNAPSHOTS):
        draft = Path(tempfile.mkdtemp(dir=directory, prefix=DRAFT))
        try:
            return _Draft(settings, source, draft, earlier[::-1]).finish(directory)
        except _Outdated:
            continue
        finally:
            shutil.rmtree(draft, ignore_errors=True)
    raise BackupFailed(f"{BackupFailed().message} Stored files were being removed all the time; try again.")


def erase(folder: Path) -> None:
    """Remove a backup: it stops being one at once, whatever is removed first."""
    doomed = folder.with_name(f"{DRAFT}{folder.name}")
    folder.rename(doomed)
    shutil.rmtree(doomed)


@dataclass(frozen=True)
class _Draft:
    """A backup in the making."""

    settings: Settings
    source: Path
    folder: Path
    earlier: Sequence[Path]
    """Finished backups in the same directory, the newest first."""

    def finish(self, directory: Path) -> Backup:
        """Copy everything, and only then give it its name."""
        made_at = now()
        _require_space(self.folder, self.source.stat().st_size)
        sqlite.copy(self.source, self.folder / DATABASE)
        with snapshots.reading(self.folder / DATABASE, still=True) as connection:
            complaint = snapshots.complaint(connection)
            if complaint is not None:
                raise BackupFailed(f"The database is damaged, so no backup was made: {complaint}.")
            revision, rows = snapshots.revision(connection), snapshots.row_counts(connection)
            named, people = snapshots.artefacts(connection), snapshots.present(connection)
            gone = snapshots.gone(connection)
        artefacts, missing = self._copy_artefacts(named)
        manifest = Manifest(
            format=layout.FORMAT,
            version=layout.VERSION,
            software_version=export_formats.software_version(),
            made_at=made_at,
            revision=revision,
            database=_file(self.folder / DATABASE),
            rows=rows,
            artefacts=artefacts,
            missing=missing,
            beside=self._copy_beside(),
            people=sorted(people),
        )
        self._write_manifest(manifest)
        flush(self.folder)
        if withdrawals.known_to(self.source) & people.keys() - gone.keys():
            raise _Outdated
        withdrawals.note(directory, withdrawals.known_to(self.source))
        name = directory / layout.name_of(made_at)
        self.folder.rename(name)
        sync(directory)
        return Backup(name, manifest)

    def _copy_artefacts(self, named: set[str]) -> tuple[dict[str, int], list[str]]:
        """Sizes by hash, and what the studio does not have any more. Raises _Outdated."""
        store = ArtefactStore(self.settings.data_dir / "artefacts")
        sizes: dict[str, int] = {}
        (self.folder / ARTEFACTS).mkdir(mode=0o700)
        for sha256 in sorted(named):
            target = self.folder / layout.artefact(sha256)
            target.parent.mkdir(mode=0o700, exist_ok=True)
            if (
                any(_linked(each, target, sha256) for each in self.earlier[:1])
                or _copied(self.settings.data_dir / layout.artefact(sha256), target, sha256)
                or any(_linked(each, target, sha256) for each in self.earlier[1:])
            ):
                sizes[sha256] = target.stat().st_size
        if missing := sorted(named - sizes.keys()):
            with snapshots.reading_after_writers(self.source) as connection:  # nobody deletes files now
                if not snapshots.artefacts(connection).issuperset(missing):
                    raise _Outdated
                for sha256 in missing:
                    source, target = (each / layout.artefact(sha256) for each in (self.settings.data_dir, self.folder))
                    if _copied(source, target, sha256):  # it was made again meanwhile
                        sizes[sha256] = target.stat().st_size
        lost = [sha256 for sha256 in missing if sha256 not in sizes]
        for sha256 in lost:
            store.has(sha256)  # which notes for the dashboard that it is lost
        return sizes, lost

    def _copy_beside(self) -> dict[str, File]:
        target = self.folder / BESIDE
        target.mkdir(mode=0o700)
        for path in layout.beside_in(self.settings.data_dir):
            _write(target / path.name, path.read_bytes())
        return {path.name: _file(path) for path in sorted(target.iterdir())}

    def _write_manifest(self, manifest: Manifest) -> None:
        content = manifest.model_dump_json(indent=0).encode()
        if len(content) > layout.LARGEST_MANIFEST_BYTES:
            raise BackupFailed("This studio has more files than a backup can list.")
        _write(self.folder / MANIFEST, content)


def _linked(earlier: Path, target: Path, sha256: str) -> bool:
    """Share the file with an earlier backup; False when that has none, or a damaged one, or the disk knows no links."""
    source = earlier / layout.artefact(sha256)
    try:
        if source.is_symlink():
            return False
        target.hardlink_to(source)
    except OSError:
        return False
    if hash_of_file(target) == sha256:  # a bit that has decayed would be in every backup otherwise
        return True
    target.unlink()
    return False


def _copied(source: Path, target: Path, sha256: str) -> bool:
    """Copy the file; False when it is missing or is not what its name says."""
    digest = hashlib.sha256()
    try:
        stream = source.open("rb")
    except FileNotFoundError:
        return False
    with stream, new_file(target) as copy_of_it:
        _require_space(target.parent, os.fstat(stream.fileno()).st_size)
        while piece := stream.read(_PIECE_BYTES):
            digest.update(piece)
            copy_of_it.write(piece)
        if digest.hexdigest() == sha256:
            return True
    target.unlink()
    return False


@contextmanager
def new_file(path: Path) -> Iterator[IO[bytes]]:
    """A file for its owner alone, which must not be there yet."""
    with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as stream:
        yield stream


def _write(path: Path, content: bytes) -> None:
    with new_file(path) as stream:
        stream.write(content)
        stream.flush()
        os.fsync(stream.fileno())


def _file(path: Path) -> File:
    return File(sha256=hash_of_file(path), byte_count=path.stat().st_size)


def flush(folder: Path) -> None:
    """Have the disk know everything that was written to it. File by file it takes 20 ms each on a busy disk."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        if _LIBC.syncfs(descriptor) != 0:
            number = ctypes.get_errno()
            raise OSError(number, os.strerror(number), str(folder))
    finally:
        os.close(descriptor)


def sync(folder: Path) -> None:
    """Have the disk know which names there are in a folder."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _require_space(folder: Path, byte_count: int) -> None:
    if shutil.disk_usage(folder).free < byte_count + SPARE_BYTES:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(folder.parent))


def _require_outside(settings: Settings, directory: Path) -> None:
    if directory.resolve().is_relative_to(settings.data_dir.resolve()):
        raise BackupFailed(
            f"{directory} lies in the data directory, and would be lost with it. Choose another one, best on another "
            "disk."
        )


def _commands_for_postgresql(settings: Settings) -> str:
    url = make_url(settings.sqlalchemy_url)
    server = URL.create("postgresql", url.username, None, url.host, url.port, url.database, url.query)
    address = server.render_as_string()
    to_copy, to_restore = _commands_for_files(settings)
    return (
        f"{OfPostgresql().message} First the database, then the files that it names:\n"
        f"  pg_dump --format=custom --file=studio.dump {address}\n"
        f"  {to_copy}\n"
        "To restore them while the studio is stopped, into an empty database:\n"
        f"  pg_restore --no-owner --exit-on-error --dbname={address} studio.dump\n"
        f"  {to_restore}\n"
        "docs/backups.md says more, also about pg_basebackup and going back to any moment."
    )


def _commands_for_files(settings: Settings) -> tuple[str, str]:
    """To copy the stored files, and to restore them."""
    if settings.storage_url is not None:
        there = f"{settings.storage_url}/artefacts"
        return f"aws s3 sync {there} studio-artefacts", f"aws s3 sync studio-artefacts {there}"
    there = str(settings.data_dir / "artefacts")
    return (
        f"mkdir -p studio-artefacts && cp -au {there}/. studio-artefacts/",
        f"mkdir -p {there} && cp -au studio-artefacts/. {there}/",
    )
