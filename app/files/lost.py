"""Which artefacts are known to be damaged or missing: those with an entry in ``damaged`` and none in ``artefacts``."""

import re
import time
from threading import Lock, Thread

from app.errors import AppError
from app.files.interface import Files

LOOK_AGAIN_S = 10.0
"""What other machines have found to be lost is known here after so long."""
ARTEFACTS, DAMAGED = "artefacts", "damaged"
SHA256 = re.compile(r"[0-9a-f]{64}")


def place(sha256: str) -> str:
    """Under which name the artefact of this hash lies."""
    return f"{ARTEFACTS}/{sha256[:2]}/{sha256}"


def aside(sha256: str) -> str:
    """Where it is put when it is damaged; an empty file there says that it was missing."""
    return f"{DAMAGED}/{sha256}"


class Lost:
    """A bucket is asked in the background, so that nobody ever waits for it; a directory at once."""

    def __init__(self, files: Files) -> None:
        self._files = files
        self._lock = Lock()
        self._known: dict[str, int] = {}
        self.trouble: str | None = None
        """What kept the last look from the files, in words."""
        self._look_at_s = 0.0
        self._noted = 0

    def now(self) -> dict[str, int]:
        """Hashes, and since when (milliseconds since 1970): what is lost twice within a second is made again twice."""
        if not self._files.is_shared:
            return self._found()
        with self._lock:
            due = time.monotonic() >= self._look_at_s
            if due:
                self._look_at_s = time.monotonic() + LOOK_AGAIN_S
        if due:
            Thread(target=self._look, daemon=True).start()
        return dict(self._known)

    def note(self, sha256: str) -> None:
        """This one, too, from now on."""
        with self._lock:
            self._noted += 1
            self._known = self._known | {sha256: round(1000 * time.time())}

    def forget(self, sha256: str) -> None:
        """It is there again, or nobody wants it."""
        with self._lock:
            self._noted += 1
            self._known = {each: since for each, since in self._known.items() if each != sha256}

    def _look(self) -> None:
        noted = self._noted
        try:
            self._files.probe()
            found = self._found()
        except AppError as error:  # the last known is the best known
            self.trouble = error.message
            return
        self.trouble = None
        with self._lock:
            if self._noted == noted:  # else what was found may be older than what was noted
                self._known = found

    def _found(self) -> dict[str, int]:
        lost: dict[str, int] = {}
        for sha256, known in list(self._files.found(DAMAGED)):
            if not SHA256.fullmatch(sha256):
                continue
            if self._files.stat(place(sha256)) is not None:
                self._files.delete(aside(sha256))
            else:
                lost[sha256] = round(1000 * known.placed_at_s)
        return lost
