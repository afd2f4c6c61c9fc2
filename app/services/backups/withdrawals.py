"""Who has withdrawn, noted beside the backups: a restore erases them again, however old the backup is.

The list holds row ids, seeds and times of creation, and nothing about anybody. It only ever grows.
"""

import json
import os
import sqlite3
from collections.abc import Collection
from contextlib import suppress
from pathlib import Path

from sqlalchemy.orm import Session

from app import upgrading
from app.db import Database, now, sqlite
from app.domain.studies import Participant, Study
from app.services import audit
from app.services.backups import snapshots
from app.services.backups.snapshots import Identity
from app.services.participants import withdrawal
from app.settings import Settings
from app.storage import ArtefactStore

LIST = "withdrawn.json"
_LARGEST_LIST_BYTES = 64 << 20


def note(directory: Path, gone: Collection[Identity]) -> None:
    """Add them to the list in a directory of backups; it is replaced as a whole."""
    before = noted(directory)
    if before >= set(gone):
        return
    draft = directory / f".{LIST}"
    descriptor = os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
    with os.fdopen(descriptor, "w") as stream:
        json.dump(sorted(before | set(gone)), stream, indent=0)
        stream.flush()
        os.fsync(stream.fileno())
    draft.replace(directory / LIST)


def noted(directory: Path) -> set[Identity]:
    """Those in the list, if there is one."""
    path = directory / LIST
    try:
        if path.stat().st_size > _LARGEST_LIST_BYTES:
            raise ValueError(f"{path} is too large to be a list of withdrawals.")
        found = json.loads(path.read_text())
    except FileNotFoundError:
        return set()
    if not isinstance(found, list):
        raise ValueError(f"{path} is not a list of withdrawals.")
    return {str(each) for each in found}


def known_to(database_file: Path) -> set[Identity]:
    """Those whom a studio's database knows of; nobody when it cannot be read, as after the accident."""
    with suppress(sqlite3.Error), snapshots.reading(database_file) as connection:
        return set(snapshots.gone(connection))
    return set()


def replay(settings: Settings, gone: Collection[Identity]) -> int:
    """Erase them from a studio that nobody uses yet, to the last byte; returns how many there were.

    The database is brought to the newest schema for it, since erasing knows no other.
    """
    path = sqlite.file_of(settings.sqlalchemy_url)
    if path is None or not _rows(path, gone):
        return 0
    upgrading.upgrade(settings)
    database, store = Database(settings.sqlalchemy_url), ArtefactStore(settings.data_dir / "artefacts")
    rows = _rows(path, gone)
    with database.writing() as session:
        for identity, row_id in rows.items():
            _erase(session, store, identity, row_id)
    database.forget_erased()
    database.dispose()
    upgrading.forget_copies(path)
    return len(rows)


def _rows(path: Path, gone: Collection[Identity]) -> dict[Identity, int]:
    """Those of them who are still there, with their row ids."""
    with snapshots.reading(path, still=True) as connection:
        known = set(gone) - snapshots.gone(connection).keys()
        return {identity: row_id for identity, row_id in snapshots.present(connection).items() if identity in known}


def _erase(session: Session, store: ArtefactStore, identity: Identity, row_id: int) -> None:
    if identity.startswith("participant/"):
        withdrawal.withdraw(session, store, session.get_one(Participant, row_id), audit.SYSTEM)
        return
    study = session.get_one(Study, row_id)
    study.deleted_at = now()
    withdrawal.erase_study(session, store, study)
    audit.record(session, audit.SYSTEM, "study deleted", study.slug)  # by now that is its number
