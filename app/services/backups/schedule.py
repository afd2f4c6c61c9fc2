"""Backups without anybody's doing: when one is due, which ones go, and what the dashboard is to say about it.

Asked again and again, as all of the worker's work is: the answer follows from the backups that are there and from the
database, so neither a restart nor a second worker can leave one out or make one twice.
"""

import json
import logging
import os
import sqlite3
from collections.abc import Set
from dataclasses import asdict, dataclass, replace
from datetime import datetime, timedelta
from functools import lru_cache
from pathlib import Path
from typing import Any

from app.db import now
from app.errors import AppError
from app.services.backups import layout, making, snapshots, withdrawals
from app.services.backups.layout import BackupRefused
from app.settings import Settings

log = logging.getLogger(__name__)

RETRY_AFTER = timedelta(minutes=10)
_FILE = "backups.json"
_LONGEST_WORDS = 300


@dataclass(frozen=True)
class Standing:
    """How the schedule does: a file beside the database, since a full disk may be what is wrong."""

    every_hours: int
    since: datetime
    """The schedule began."""
    made_at: datetime | None = None
    """The newest backup."""
    failed_at: datetime | None = None
    """The last attempt; None when it succeeded."""
    words: str = ""
    """Why it failed; may name files, and is for experimenters only."""

    @property
    def late(self) -> bool:
        """Whether the newest backup is older than twice the interval."""
        return now() - (self.made_at or self.since) > 2 * timedelta(hours=self.every_hours)


def standing(data_dir: Path) -> Standing | None:
    """As it was last noted; None without a schedule."""
    try:
        row: dict[str, Any] = json.loads((data_dir / _FILE).read_text())
        times = {name: row[name] and datetime.fromisoformat(row[name]) for name in ("since", "made_at", "failed_at")}
        return Standing(**{**row, **times})
    except (OSError, ValueError, TypeError, KeyError):
        return None


def forget(data_dir: Path) -> None:
    """There is no schedule any more."""
    (data_dir / _FILE).unlink(missing_ok=True)


def tend(settings: Settings, directory: Path) -> None:
    """Make a backup if one is due, remove those that are too old or hold somebody who has been erased since."""
    before = standing(settings.data_dir) or Standing(settings.backup_every_hours, now())
    before = replace(before, every_hours=settings.backup_every_hours)
    if before.failed_at is not None and abs(now() - before.failed_at) < RETRY_AFTER:
        return
    try:
        with making.only_one(directory):
            made_at = _tend(settings, directory)
    except making.BackupUnderWay:  # by hand, or by another worker
        return
    except (AppError, OSError, sqlite3.Error) as error:
        words = making.in_words(error) if isinstance(error, OSError | sqlite3.Error) else str(error)
        log.error("the backup into %s failed: %s", directory, words)
        _note(settings.data_dir, replace(before, failed_at=now(), words=words[:_LONGEST_WORDS]))
        return
    _note(settings.data_dir, replace(before, made_at=made_at, failed_at=None, words=""))


def with_somebody_erased(settings: Settings, directory: Path) -> list[Path]:
    """Backups that hold somebody of whom nothing may be left."""
    with snapshots.reading(making.database_file(settings)) as connection:
        erased = snapshots.erased(connection).keys()
    return [folder for folder in layout.folders_in(directory) if _holds(folder, erased)]


def _tend(settings: Settings, directory: Path) -> datetime:
    """When the newest backup was made. The new one comes first: it shares the files of those that go."""
    source = making.database_file(settings)
    doomed = with_somebody_erased(settings, directory)
    withdrawals.note(directory, withdrawals.known_to(source))
    newest = next((made_at for each in layout.folders_in(directory)[::-1] if (made_at := _summary(each)[0])), None)
    try:
        if doomed or newest is None or abs(now() - newest) >= timedelta(hours=settings.backup_every_hours):
            backup = making.make_now(settings, source, directory)
            newest = backup.manifest.made_at
            log.info("the studio is backed up as %s", backup.folder)
    finally:  # a promise to somebody is worth more than going back
        for folder in doomed:
            making.erase(folder)
            log.warning("%s is erased: somebody who is in it has withdrawn", folder)
    for folder in layout.folders_in(directory)[: -settings.backups_kept]:
        making.erase(folder)
    return newest


def _holds(folder: Path, people: Set[snapshots.Identity]) -> bool:
    """Whether one of them is in the backup, or may be."""
    there = _summary(folder)[1]
    return bool(people) if there is None else not there.isdisjoint(people)


@lru_cache(maxsize=256)
def _summary(folder: Path) -> tuple[datetime | None, frozenset[snapshots.Identity] | None]:
    """When a backup was made and who is in it; nothing of one whose manifest is damaged. Manifests never change."""
    try:
        manifest = layout.opened(folder).manifest
    except BackupRefused:
        return None, None
    return manifest.made_at, frozenset(manifest.people)


def _note(data_dir: Path, current: Standing) -> None:
    """Replace what was noted before, if it differs. A full disk is told by others."""
    if standing(data_dir) == current:
        return
    times = {name: time and time.isoformat() for name, time in asdict(current).items() if isinstance(time, datetime)}
    draft = data_dir / f"{Path(_FILE).stem}.writing"
    try:
        descriptor = os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
        with os.fdopen(descriptor, "w") as stream:
            json.dump({**asdict(current), **times}, stream)
        draft.replace(data_dir / _FILE)
    except OSError as error:
        log.warning("%s could not be written: %s", data_dir / _FILE, error.strerror)
