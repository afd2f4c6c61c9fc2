"""Bring your own clips: a folder or zip of recordings becomes a study, in whichever of the known layouts it is.

Everything is read and checked before anything is kept, and a message says in which file what is wrong.
"""

import zipfile
from pathlib import Path

from app.db import Database
from app.services import audit
from app.services.archives import unpacking
from app.services.participants import withdrawal
from app.storage import ArtefactStore
from worker.jobs.clips import own_clips
from worker.jobs.clips.arena_folder import ArenaFolder
from worker.jobs.clips.lerobot_folder import LerobotFolder
from worker.jobs.clips.manifest_folder import Folder, Manifested, Zip
from worker.jobs.clips.own_clips import NOTHING_SAID, Choices, ClipsInvalid, Recordings
from worker.jobs.runtime.context import NotingStore

LARGEST_UNPACKED_BYTES = 64 << 30

__all__ = ["ClipsInvalid", "import_clips"]


def import_clips(
    database: Database,
    store: ArtefactStore,
    path: Path,
    choices: Choices = NOTHING_SAID,
    actor: str = audit.SYSTEM,
) -> str:
    """Make a study of a folder or zip file; returns its slug. Raises ClipsInvalid."""
    if path.is_dir():
        return _import(database, store, _recordings(path, choices), actor)
    try:
        with unpacking.opened(path, LARGEST_UNPACKED_BYTES) as archive:
            return _import(database, store, Manifested(Zip(archive)), actor)
    except unpacking.ZipRefused as error:
        raise ClipsInvalid(f"{path} is not read: {error}.") from error
    except (OSError, zipfile.BadZipFile) as error:
        raise ClipsInvalid(f"{path} is neither a folder nor a zip file.") from error


def _recordings(path: Path, choices: Choices) -> Recordings:
    """In the layout that the folder has."""
    if LerobotFolder.is_one(path):
        return LerobotFolder(path, choices)
    if ArenaFolder.is_one(path):
        return ArenaFolder(path, choices)
    return Manifested(Folder(path))


def _import(database: Database, store: ArtefactStore, recordings: Recordings, actor: str) -> str:
    """Files are stored one clip after the other, and go again when one of them is wrong."""
    noted = set[str]()
    shelf = NotingStore(store, noted)
    try:
        ready = [own_clips.stored(shelf, each) for each in recordings.clips()]
        own_clips.check_observations(ready)
        settings = own_clips.settings_of(recordings.material, ready)
        with database.writing() as session:
            return own_clips.save(session, recordings.material, settings, ready, actor).slug
    except BaseException:
        with database.writing() as session:  # nobody can begin to refer to one of them meanwhile
            for sha256 in noted - withdrawal.in_use(session, noted):
                store.delete(sha256)
        raise
