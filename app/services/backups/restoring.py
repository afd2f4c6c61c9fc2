"""Verifying a backup, and restoring one: everything is checked and laid out before anything that is there is touched.

What is restored is prepared in a folder inside the data directory. Then what was there moves aside, into another folder
inside it, and what was prepared takes its place, the database last. Until the folder of preparation is gone no program
starts there (app.data_directory), so a restore that is killed leaves nothing that looks whole and is not.
"""

import shutil
import sqlite3
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from app import data_directory, upgrading
from app.db import now, sqlite
from app.errors import AppError
from app.services.backups import layout, making, snapshots, withdrawals
from app.services.backups.layout import BESIDE, DATABASE, Backup, BackupRefused
from app.settings import Settings

REPLACED = "replaced-"
"""Begins the name of the folder that keeps what was there before."""
_STAYS = {"lost+found"}


class DirectoryNotEmpty(AppError):
    """There is something in this data directory. Restore into another one with --into, or say --replace: what is here
    is then kept in a folder whose name begins with replaced-."""


class RestoreFailed(AppError):
    """The backup could not be restored."""


@dataclass(frozen=True)
class Restored:
    """What a restore came to."""

    data_dir: Path
    erased_again: int
    """Participants and studies in the backup that are known to have withdrawn since."""
    replaced: Path | None
    """Where what was there before is kept."""


def verify(settings: Settings, folder: Path) -> Backup:
    """Read everything in a backup. Raises BackupRefused and NewerDatabase."""
    backup = _opened(settings, folder)
    for place, file in layout.files(backup.manifest):
        for _ in layout.pieces(backup.folder / place, file):
            pass
    _check_database(backup, backup.folder / DATABASE)
    return backup


def restore(settings: Settings, folder: Path, into: Path | None = None, *, replace: bool = False) -> Restored:
    """Put a backup in place. ``replace``: move aside what is there. Raises what verify() does, and in words."""
    if into is None and sqlite.file_of(settings.sqlalchemy_url) != settings.data_dir.resolve() / DATABASE:
        raise RestoreFailed(
            "DATABASE_URL says that the database is not in the data directory. Restore with --into a new directory and "
            "move the database from there to its place. For PostgreSQL, docs/backups.md has the commands."
        )
    if into is None and settings.storage_url is not None:
        raise RestoreFailed("STORAGE_URL says that files are in a bucket. Restore with --into a new directory.")
    backup = _opened(settings, folder)
    target = into or settings.data_dir
    try:
        with data_directory.alone(target):
            if _present(target) and not replace:
                raise DirectoryNotEmpty
            gone = _known_withdrawals(settings, folder, target)
            return _restore(settings, backup, target, gone)
    except (OSError, sqlite3.Error) as error:
        raise RestoreFailed(f"{RestoreFailed().message} {making.in_words(error)}") from error


def forget_replaced(data_dir: Path) -> None:
    """Erase what restores have moved aside: somebody who has withdrawn is still in it."""
    for folder in data_dir.glob(f"{REPLACED}*"):
        shutil.rmtree(folder)


def _restore(settings: Settings, backup: Backup, target: Path, gone: set[str]) -> Restored:
    needed = 2 * backup.manifest.database.byte_count + backup.byte_count + making.SPARE_BYTES
    free = shutil.disk_usage(target).free
    if free < needed:
        raise RestoreFailed(f"There is no room for this backup: free {(needed - free) / 1e9:.2f} GB on the disk.")
    interrupted = list(target.glob(f"{data_directory.RESTORING}*"))
    prepared = Path(tempfile.mkdtemp(dir=target, prefix=data_directory.RESTORING))
    try:
        _lay_out(backup, prepared)
        _check_database(backup, prepared / DATABASE)
        there = settings.model_copy(update={"data_dir": prepared, "database_url": None})
        erased_again = withdrawals.replay(there, gone)
    except BaseException:
        shutil.rmtree(prepared)
        raise
    for left_over in interrupted:
        shutil.rmtree(left_over)
    replaced = _move_aside(target)
    for path in sorted(prepared.iterdir(), key=lambda each: each.name == DATABASE):  # the database last
        if not path.name.endswith(".lock"):
            path.rename(target / path.name)
    making.sync(target)
    shutil.rmtree(prepared)
    return Restored(target, erased_again, replaced)


def _opened(settings: Settings, folder: Path) -> Backup:
    """What can be said of a backup without reading its files."""
    backup = layout.opened(folder)
    layout.require_no_links(backup)
    upgrading.require_known(settings, backup.manifest.revision)
    return backup


def _lay_out(backup: Backup, prepared: Path) -> None:
    """Copy the files, each compared with what it must be, to where a studio has them."""
    (prepared / layout.ARTEFACTS).mkdir(mode=0o700)
    for place, file in layout.files(backup.manifest):
        target = prepared / place.removeprefix(f"{BESIDE}/")
        target.parent.mkdir(mode=0o700, exist_ok=True)
        with making.new_file(target) as stream:
            for piece in layout.pieces(backup.folder / place, file):
                stream.write(piece)
    making.flush(prepared)


def _check_database(backup: Backup, path: Path) -> None:
    """Compare what the database says with what the manifest says. Raises BackupRefused."""
    manifest = backup.manifest
    try:
        with snapshots.reading(path, still=True) as connection:
            complaint = snapshots.complaint(connection)
            if complaint is None and snapshots.revision(connection) != manifest.revision:
                complaint = "it is of another revision than the manifest says"
            if complaint is None and snapshots.row_counts(connection) != manifest.rows:
                complaint = "it does not have the rows that the manifest says"
            named = snapshots.artefacts(connection) if complaint is None else set()
    except sqlite3.DatabaseError as error:
        raise BackupRefused(f"The database in {backup.folder} is damaged: {error}.") from error
    if complaint is not None:
        raise BackupRefused(f"The database in {backup.folder} is damaged: {complaint}.")
    if lost := named - manifest.artefacts.keys() - set(manifest.missing):
        raise BackupRefused(f"{backup.folder} lacks files that its database names, such as {min(lost)}.")


def _known_withdrawals(settings: Settings, folder: Path, target: Path) -> set[str]:
    """From the lists beside the backup and in BACKUP_DIR, and from the studio as it is now."""
    gone: set[str] = set()
    for directory in {folder.resolve().parent, *([settings.backup_dir] if settings.backup_dir else [])}:
        try:
            gone |= withdrawals.noted(directory)
        except ValueError as error:
            raise BackupRefused(f"{error} It says who has withdrawn since: put a sound one there, or none.") from error
    for path in {target / DATABASE, sqlite.file_of(settings.sqlalchemy_url)} - {None}:
        if path is not None and path.exists():
            gone |= withdrawals.known_to(path)
    return gone


def _present(target: Path) -> list[Path]:
    return list(_movable(target)) + list(target.glob(f"{data_directory.RESTORING}*"))


def _movable(target: Path) -> Iterator[Path]:
    """What a studio has there; not the locks, which are being held, nor what earlier restores have moved aside."""
    for path in sorted(target.iterdir()):
        ours = path.name.startswith((data_directory.RESTORING, REPLACED)) or path.name.endswith(".lock")
        if not ours and path.name not in _STAYS:
            yield path


def _move_aside(target: Path) -> Path | None:
    """Everything, the database with its log first: what is left of an interrupted move is no studio."""
    present = sorted(_movable(target), key=lambda each: not each.name.startswith(DATABASE))
    if not present:
        return None
    replaced = target / f"{REPLACED}{now():%Y%m%dT%H%M%S.%f}Z"
    replaced.mkdir(mode=0o700)
    for path in present:
        path.rename(replaced / path.name)
    making.sync(target)
    return replaced
