"""Brings a database to the newest schema: wholly or not at all, one program at a time, and never without a copy."""

import fcntl
import logging
import shutil
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from sqlalchemy import create_engine, inspect, text
from sqlalchemy.exc import DatabaseError, OperationalError

from app.data_directory import require_whole
from app.db import now, sqlite
from app.errors import AppError, in_words
from app.files.lost import ARTEFACTS
from app.paths import MIGRATIONS
from app.settings import Settings
from app.storage import ArtefactStore

if TYPE_CHECKING:
    from alembic.config import Config
    from alembic.script import ScriptDirectory

log = logging.getLogger(__name__)

KEPT_COPIES = 3
SPARE_BYTES = 64 * 1024**2
"""What is left free beside the copy and the growth of the database itself."""
_COPY = ".before-"
_VERSIONS = "alembic_version"


class NewerDatabase(AppError):
    """The database was written by a newer version of this program. Install that version, or restore an older copy."""


class UnfinishedDatabase(AppError):
    """The database has tables and no version: an earlier version was killed while it made them."""


class NoSpaceToUpgrade(AppError):
    """There is too little space for the copy that is made before the database is upgraded."""


class UpgradeFailed(AppError):
    """The database could not be upgraded and is as it was. If an earlier version of this program was killed while it
    upgraded, restore the database from before that."""


class DamagedDatabase(AppError):
    """The database is damaged and was left as it is. Restore it from a backup."""


class LogDoesNotFit(AppError):
    """The database and its log (studio.sqlite3-wal) do not fit together; both were left as they are. If the log was put
    there from elsewhere, move it away and start again. Otherwise restore the database from a backup."""


class DatabaseLost(AppError):
    """The database is gone, and stored files of it are there. Restore it from a backup. To begin anew, choose another
    DATA_DIR, or move this one away."""


def upgrade(settings: Settings) -> None:
    """Bring the database to the newest schema; whoever comes second finds it done."""
    settings.data_dir.mkdir(parents=True, exist_ok=True)
    require_whole(settings.data_dir)
    config = _config(settings)
    newest = _scripts(config).get_current_head() or ""
    with _one_at_a_time(settings):
        path = sqlite.file_of(settings.sqlalchemy_url)
        if path is not None and path.exists() and not sqlite.fits_its_log(path):
            raise LogDoesNotFit
        present = _revision(settings, config)
        if present == newest:
            return
        if present is None:
            _require_new(settings)
        if present is not None and path is not None:
            _copy(path, newest)
        elif present is not None:
            log.warning("the database is upgraded to revision %s; pg_dump makes copies of what it is", newest)
        from alembic import command

        try:
            command.upgrade(config, "head")
        except DatabaseError as error:
            if in_words(error) is not None:  # nothing to do with what is in the database
                raise
            raise UpgradeFailed(f"{_words(UpgradeFailed)} The database says: {error.orig}.") from error


def revisions(settings: Settings) -> tuple[str | None, str | None]:
    """What the schema's revision is, None while there is none, and what this version needs. Changes nothing.

    Raises NewerDatabase, DamagedDatabase and UnfinishedDatabase.
    """
    config = _config(settings)
    return _revision(settings, config), _scripts(config).get_current_head()


def require_known(settings: Settings, revision: str) -> None:
    """Raises NewerDatabase for a schema that this version cannot bring to its own."""
    if revision not in _known(_config(settings)):
        raise NewerDatabase(f"{_words(NewerDatabase)} (It is of revision {revision[:20]}.)")


def forget_copies(path: Path) -> None:
    """Erase the copies made before upgrades: somebody who has withdrawn is still in them."""
    for each in [*copies(path), _draft(path)]:
        if each.exists():
            each.unlink()
            log.warning("%s is erased: somebody who is in it has withdrawn", each.name)


def copies(path: Path) -> list[Path]:
    """The copies made before upgrades, the oldest first."""
    return sorted(path.parent.glob(f"{path.name}{_COPY}*"), key=lambda each: each.stat().st_mtime_ns)


def _draft(path: Path) -> Path:
    """A copy in the making, or what is left of one that was killed."""
    return path.with_name(f"{path.name}.copying")


def _config(settings: Settings) -> "Config":
    from alembic.config import Config  # takes a quarter of a second to load, and most programs upgrade nothing

    config = Config()
    config.set_main_option("script_location", str(MIGRATIONS))
    config.set_main_option("sqlalchemy.url", settings.sqlalchemy_url.replace("%", "%%"))
    return config


def _require_new(settings: Settings) -> None:
    """Raises DatabaseLost where an empty database would take the place of one: the worker clears away what no row of
    it refers to."""
    path = sqlite.file_of(settings.sqlalchemy_url)
    log_of_it = path and path.with_name(f"{path.name}-wal")
    has_log = log_of_it is not None and log_of_it.exists() and log_of_it.stat().st_size > 0
    if has_log or next(iter(ArtefactStore.of(settings).files.found(ARTEFACTS)), None) is not None:
        raise DatabaseLost


@contextmanager
def _one_at_a_time(settings: Settings) -> Iterator[None]:
    with (settings.data_dir / "upgrade.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def _revision(settings: Settings, config: "Config") -> str | None:
    """The schema's revision, None while there is none. Raises what an upgrade could not mend."""
    path = sqlite.file_of(settings.sqlalchemy_url)
    if path is not None and not path.exists():
        return None
    engine = create_engine(settings.sqlalchemy_url)
    try:
        tables = set(inspect(engine).get_table_names())
        with engine.connect() as connection:
            found = connection.scalar(text("SELECT version_num FROM alembic_version")) if _VERSIONS in tables else None
    except DatabaseError as error:
        if path is None or isinstance(error, OperationalError):  # away, locked or forbidden, which is not damaged
            raise
        raise DamagedDatabase from error
    finally:
        engine.dispose()
    if found is not None and found not in _known(config):
        raise NewerDatabase(f"{_words(NewerDatabase)} (It is of revision {found}.)")
    if found is None and tables - {_VERSIONS}:
        raise UnfinishedDatabase(
            f"{_words(UnfinishedDatabase)} Nothing can have been recorded in it: move {path or 'its tables'} away and "
            "start again."
        )
    return found


def _known(config: "Config") -> set[str]:
    return {script.revision for script in _scripts(config).walk_revisions()}


def _scripts(config: "Config") -> "ScriptDirectory":
    from alembic.script import ScriptDirectory

    return ScriptDirectory.from_config(config)


def _copy(path: Path, newest: str) -> None:
    """A consistent copy for its owner only, complete or absent; the oldest copies make room."""
    needed = 2 * path.stat().st_size + SPARE_BYTES  # once for the copy, once for what the upgrade rewrites
    free = shutil.disk_usage(path.parent).free
    if free < needed:
        raise NoSpaceToUpgrade(f"{_words(NoSpaceToUpgrade)} Free {(needed - free) / 1024**2:.0f} MiB on its disk.")
    target = path.with_name(f"{path.name}{_COPY}{newest}-{now():%Y%m%dT%H%M%S.%f}")
    draft = _draft(path)
    draft.unlink(missing_ok=True)
    try:
        sqlite.copy(path, draft)
        draft.replace(target)
    except sqlite3.DatabaseError as error:
        if error.sqlite_errorcode & 0xFF in {sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB}:
            raise DamagedDatabase from error
        raise
    finally:
        draft.unlink(missing_ok=True)
    log.warning("the database is upgraded to revision %s; a copy of what it was is %s", newest, target.name)
    for old in copies(path)[:-KEPT_COPIES]:
        old.unlink()


def _words(error: type[AppError]) -> str:
    return error().message
