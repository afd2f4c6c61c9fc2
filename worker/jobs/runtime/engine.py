"""The durable engine and its file: one that is lost, damaged or of another time than the database is replaced.

The engine knows how far unfinished work has come, and nothing else: whatever it is wrong about, or has forgotten, is
asked of the database again. So its file is never repaired. It is set aside, and unfinished work begins anew.
"""

import fcntl
import logging
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from datetime import datetime, timedelta
from pathlib import Path

from dbos import DBOS, WorkflowStatus
from sqlalchemy.exc import DatabaseError

from app.db import Database, now
from app.db.sqlite import BUSY_TIMEOUT_S
from app.domain.models import RunKind, WorkerPresence
from app.errors import AppError
from app.settings import Settings

log = logging.getLogger("worker")

NAME = "pbarl-studio"
VERSION = "10"
"""Raised when steps or names of workflows change, so that a half-finished one could not be resumed: it begins anew."""

QUEUES = {
    RunKind.CLIPS: 2,
    RunKind.REWARD: 1,
    RunKind.FILTER: 1,
    RunKind.REFINEMENT: 1,
    RunKind.METHOD: 4,  # those that are only measured keep their place while they give way to whoever waits
    RunKind.SHARED: 1,
    RunKind.FILMS: 1,
    RunKind.REPORT: 1,
    RunKind.EXPORT: 1,
    RunKind.POWER: 1,
}
"""How many jobs of each kind one worker does at a time."""
RESERVE = 2
"""So many more are begun of a kind when somebody waits; what began earlier gives way in the lanes."""
AWAITED = {RunKind.CLIPS, RunKind.REWARD}
"""What somebody may be waiting for who is answering: begun within AWAITED_POLL_S, anything else within POLL_S.

Asking the engine for all kinds five times a second took a tenth of a core, whether there was work or not."""
AWAITED_POLL_S, POLL_S = 0.3, 1.0

SILENCE = timedelta(seconds=60)
"""Work that the engine takes for begun, and nobody has begun, is begun again after this long."""
KEPT = 3
"""files that were set aside, the newest"""
_ASIDE = ".set-aside-"
_COMPANIONS = ("", "-journal", "-wal", "-shm")
_ENDED = frozenset({"SUCCESS", "ERROR", "CANCELLED", "MAX_RECOVERY_ATTEMPTS_EXCEEDED"})


class EngineInUse(AppError):
    """The engine's file is in use by another program. Stop all workers of this data directory, then start again."""


class EngineLost(AppError):
    """The engine's file was removed or damaged under a running worker. It starts again with a new one."""


def file_of(settings: Settings) -> Path | None:
    """Where the engine keeps its own notes; None when they lie on the PostgreSQL server."""
    return settings.data_dir.resolve() / "engine.sqlite3" if settings.sqlalchemy_url.startswith("sqlite") else None


def address(settings: Settings) -> str:
    """Of the engine's notes, as SQLAlchemy takes it."""
    path = file_of(settings)
    return settings.sqlalchemy_url if path is None else f"sqlite:///{path}"


@contextmanager
def running(settings: Settings, database: Database) -> Iterator["Bond"]:
    """The engine at work, on a file that can be trusted."""
    path = file_of(settings)
    if path is None:
        launch(settings)
        yield Bond(None, settings.worker_name, None)
        return
    with path.with_name("engine.lock").open("w") as lock:
        alone = _alone(lock.fileno())
        wrong = _what_is_wrong(path, settings.worker_name, database)
        if wrong is not None:
            _replace(path, wrong, alone)
        try:
            launch(settings)
        except DatabaseError as error:
            DBOS.destroy()
            if not isinstance(error.orig, sqlite3.DatabaseError) or not _is_damage(error.orig):
                raise EngineInUse(f"The engine's file cannot be written: {error.orig}.") from error
            _replace(path, f"cannot be used ({error.orig})", alone)
            launch(settings)
        fcntl.flock(lock, fcntl.LOCK_SH)
        yield Bond(path, settings.worker_name, _last_sign(database, settings.worker_name))


def launch(settings: Settings) -> None:
    """Start the engine on its file as it is."""
    DBOS(
        config={
            "name": NAME,
            "system_database_url": address(settings),
            "executor_id": settings.worker_name,
            "application_version": VERSION,
            "log_level": "ERROR",
        }
    )
    DBOS.launch()
    for kind, count in QUEUES.items():
        interval = AWAITED_POLL_S if kind in AWAITED else POLL_S
        DBOS.register_queue(kind.value, worker_concurrency=count + RESERVE, polling_interval_sec=interval)


def is_at_it(name: str) -> bool:
    """Whether the engine will do this, or somebody has just begun; not whether it has once been done."""
    known = DBOS.get_workflow_status(name)
    if known is None or is_over(known):
        return False
    begun_ms = known.updated_at or 0
    return known.status != "PENDING" or now().timestamp() - begun_ms / 1000 < SILENCE.total_seconds()


def gave_up(name: str) -> bool:
    """Whether the worker has fallen again and again in the middle of this."""
    known = DBOS.get_workflow_status(name)
    return known is not None and known.status == "MAX_RECOVERY_ATTEMPTS_EXCEEDED"


def resume(name: str) -> bool:
    """Go on with what somebody has left behind; False when the engine knows nothing of it, or takes it for ended."""
    known = DBOS.get_workflow_status(name)
    if known is None:
        return False
    if is_over(known):
        DBOS.delete_workflow(name)
        return False
    if known.status == "PENDING":  # whatever waits in a queue is going to be done
        DBOS.resume_workflow(name)
    return True


def forget_set_aside(path: Path) -> None:
    """Erase the files that were set aside: they may name somebody who has withdrawn."""
    for aside in path.parent.glob(f"{path.name}*{_ASIDE}*"):
        aside.unlink(missing_ok=True)


class Bond:
    """Ties the engine's file to the database: a worker's sign of life is written to both.

    A file that was restored without the other, or is older or newer than it, is told by this at the next start: half
    done work would otherwise go on in a database that has never heard of its first half.
    """

    def __init__(self, path: Path | None, worker_name: str, signed: str | None) -> None:
        """``signed``: the last sign in the database."""
        self._path, self._worker = path, worker_name
        self._signed = signed
        self._promised: str | None = None

    def promise(self, moment: datetime) -> bool:
        """Note the sign that is about to be written to the database; False when it must wait. Raises EngineLost."""
        if self._path is None:
            return True
        promised = _as_text(moment)
        try:
            with closing(_connect(self._path)) as connection:
                connection.execute("SELECT version FROM dbos_migrations")
                connection.execute(
                    "CREATE TABLE IF NOT EXISTS studio_bond (worker TEXT PRIMARY KEY, promised TEXT, signed TEXT)"
                )
                if self._is_another(connection):
                    raise EngineLost
                row = (self._worker, promised, self._signed)
                connection.execute("INSERT OR REPLACE INTO studio_bond VALUES (?, ?, ?)", row)
        except sqlite3.DatabaseError as error:
            if not _is_damage(error):
                log.warning("the engine's file could not be written, trying again: %s", error)
                return False
            raise EngineLost from error
        self._promised = promised
        return True

    def _is_another(self, connection: sqlite3.Connection) -> bool:
        """Whether this is not the file of the last promise any more, but an older one in its place."""
        asked = "SELECT promised FROM studio_bond WHERE worker = ?"
        found = connection.execute(asked, (self._worker,)).fetchone()
        return self._promised is not None and (found is None or found[0] != self._promised)

    def signed(self, moment: datetime) -> None:
        """The database has it as well."""
        self._signed = _as_text(moment)


def is_over(known: WorkflowStatus) -> bool:
    """Whether the engine will never touch it again: what an earlier version has left half done is never resumed."""
    return known.status in _ENDED or known.app_version not in (None, VERSION)


def _alone(lock: int) -> bool:
    """True with a lock that keeps other workers from starting; False with one that is shared with running ones."""
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        fcntl.flock(lock, fcntl.LOCK_SH)
        return False
    return True


def _what_is_wrong(path: Path, worker_name: str, database: Database) -> str | None:
    """Why the file cannot be used, in words that go on from "the engine's file"; None when it can."""
    if not path.exists():
        return "is missing" if any(_with(path, end).exists() for end in _COMPANIONS) else None
    try:
        with closing(_connect(path)) as connection:
            (verdict,) = connection.execute("PRAGMA quick_check(1)").fetchone()
            tables = {name for (name,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
            bond = "SELECT promised, signed FROM studio_bond WHERE worker = ?"
            signs = connection.execute(bond, (worker_name,)).fetchone() if "studio_bond" in tables else None
    except sqlite3.DatabaseError as error:
        if _is_damage(error):
            return f"cannot be read ({error})"
        raise EngineInUse from error
    if verdict != "ok":
        return f"is damaged ({verdict})"
    if "dbos_migrations" not in tables:
        return "is empty or of another program"
    if signs is not None and _last_sign(database, worker_name) not in signs:
        return "is of another time than the database"
    return None


def _last_sign(database: Database, worker_name: str) -> str | None:
    with database.reading() as session:
        presence = session.get(WorkerPresence, worker_name)
        return None if presence is None else _as_text(presence.last_seen_at)


def _replace(path: Path, wrong: str, alone: bool) -> None:
    """Keep what is there under another name, so that the engine makes a new file."""
    if not alone:
        raise EngineInUse(f"The engine's file {wrong}, and another worker uses it. Stop all workers, then start again.")
    ending = f"{_ASIDE}{now():%Y%m%dT%H%M%S.%f}"
    for companion in _COMPANIONS:
        part = _with(path, companion)
        if part.exists():
            part.rename(part.with_name(part.name + ending))
    log.warning("the engine's file %s; it is kept as %s, unfinished work begins anew", wrong, path.name + ending)
    endings = sorted({aside.name.partition(_ASIDE)[2] for aside in path.parent.glob(f"{path.name}*{_ASIDE}*")})
    for old in endings[:-KEPT]:
        for aside in path.parent.glob(f"{path.name}*{_ASIDE}{old}"):
            aside.unlink()


def _connect(path: Path) -> sqlite3.Connection:
    """A connection of our own to the engine's file, which is never created here."""
    return sqlite3.connect(f"{path.as_uri()}?mode=rw", uri=True, timeout=BUSY_TIMEOUT_S, isolation_level=None)


def _is_damage(error: sqlite3.DatabaseError) -> bool:
    """Whether waiting will not help: neither locked nor without space."""
    passing = {sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED, sqlite3.SQLITE_FULL, sqlite3.SQLITE_READONLY}
    return getattr(error, "sqlite_errorcode", sqlite3.SQLITE_ERROR) & 0xFF not in passing


def _with(path: Path, companion: str) -> Path:
    return path.with_name(path.name + companion)


def _as_text(moment: datetime) -> str:
    return moment.isoformat(timespec="microseconds")
