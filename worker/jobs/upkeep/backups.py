"""Scheduled backups, in a thread of their own: a large studio takes minutes, and the sign of life must go on."""

import math
import threading
import time

from app.services.backups import schedule
from app.settings import Settings

LOOK_S = 10.0


class Backups:
    """Looks now and then whether a backup is due; one look at a time."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._looked_at = -math.inf
        self._thread: threading.Thread | None = None
        if settings.backup_dir is None:
            schedule.forget(settings.data_dir)

    def look(self) -> None:
        """Never waits. A worker that stops in the middle leaves a draft, which the next backup removes."""
        directory = self._settings.backup_dir
        if directory is None or time.monotonic() - self._looked_at < LOOK_S or self.busy:
            return
        self._looked_at = time.monotonic()
        self._thread = threading.Thread(target=schedule.tend, args=(self._settings, directory), daemon=True)
        self._thread.start()

    @property
    def busy(self) -> bool:
        """Whether a look is being taken, or a backup made."""
        return self._thread is not None and self._thread.is_alive()
