"""Who uses a data directory: programs share it while they run, a restore has it for itself."""

import fcntl
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from app.errors import AppError

LOCK = "studio.lock"
RESTORING = "restoring-"
"""Begins the name of the folder in which a restore prepares everything; it is the last thing that a restore removes."""


class DirectoryInUse(AppError):
    """The studio is running on this data directory. Stop it (Ctrl-C where it was started), then try again."""


class DirectoryBeingRestored(AppError):
    """A backup is being restored into this data directory. Wait until that has ended, then try again."""


class RestoreInterrupted(AppError):
    """A restore into this data directory was interrupted. Repeat it with --replace; what was here before it is kept in
    the folder whose name begins with replaced-."""


@contextmanager
def shared(data_dir: Path) -> Iterator[None]:
    """For a program that runs for long: nothing is restored meanwhile. Raises DirectoryBeingRestored."""
    with _locked(data_dir, fcntl.LOCK_SH, DirectoryBeingRestored):
        yield


@contextmanager
def alone(data_dir: Path) -> Iterator[None]:
    """For a restore: no program runs meanwhile. Raises DirectoryInUse."""
    with _locked(data_dir, fcntl.LOCK_EX, DirectoryInUse):
        yield


@contextmanager
def _locked(data_dir: Path, kind: int, refusal: type[AppError]) -> Iterator[None]:
    data_dir.mkdir(parents=True, exist_ok=True)
    with (data_dir / LOCK).open("a") as lock:
        try:
            fcntl.flock(lock, kind | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise refusal from error
        yield


def require_whole(data_dir: Path) -> None:
    """Raises RestoreInterrupted when a restore was killed before its end: some of the files may be the old ones."""
    if any(data_dir.glob(f"{RESTORING}*")):
        raise RestoreInterrupted
