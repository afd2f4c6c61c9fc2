"""Checkpoints of a training that takes minutes: whoever was killed goes on where the last one was written.

Everything is in one file that is replaced as a whole. Beside it lies a short note of how far the training is, for
whoever waits for it in another process. When the folder is gone, nobody wants the result any more.
"""

import json
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from safetensors import safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor

from worker.whole_files import written_whole

STATE_FILE, NOTE_FILE, PAUSE_FILE = "state.safetensors", "share", "pause"
EVERY_S = 45.0
NOTE_EVERY_S = 1.0


class Abandoned(RuntimeError):
    """The folder of this training has been removed, so its result is not wanted any more."""


class Paused(RuntimeError):
    """Somebody else needs the process; the training goes on from its checkpoint later."""


@dataclass
class Checkpoint:
    """The folder of one training; it must exist."""

    folder: Path
    every_s: float = EVERY_S
    _written_at: float = field(default_factory=time.monotonic)
    _noted_at: float = float("-inf")
    pause_is_asked: bool = field(default=False, init=False)
    """as of the last note"""

    def note(self, share: float) -> None:
        """Say which share of the training is done, and see whether to pause; once a second. Raises Abandoned."""
        if time.monotonic() - self._noted_at < NOTE_EVERY_S:
            return
        if not self.folder.is_dir():
            raise Abandoned(" ".join((Abandoned.__doc__ or "").split()))
        self._noted_at = time.monotonic()
        self.pause_is_asked = (self.folder / PAUSE_FILE).exists()
        with self._writing(NOTE_FILE) as draft:
            draft.write_text(f"{share:.4f}")

    @property
    def is_due(self) -> bool:
        """Whether it is time to write again."""
        return time.monotonic() - self._written_at >= self.every_s

    def write(self, tensors: dict[str, Tensor], counts: dict[str, Any]) -> None:
        """Keep everything a restart needs: arrays, and plain values that JSON can hold."""
        whole = {name: tensor.contiguous() for name, tensor in tensors.items()}
        with self._writing(STATE_FILE) as draft:
            save_file(whole, draft, metadata={"counts": json.dumps(counts)})
        self._written_at = time.monotonic()

    def read(self) -> tuple[dict[str, Tensor], dict[str, Any]] | None:
        """What was written last; None at the beginning."""
        counts = self.read_counts()
        if counts is None:
            return None
        return load_file(self.folder / STATE_FILE), counts

    def read_counts(self) -> dict[str, Any] | None:
        """The plain values of read(), without its arrays."""
        path = self.folder / STATE_FILE
        if not path.exists():
            return None
        with safe_open(path, "pt") as stored:
            counts: dict[str, Any] = json.loads(stored.metadata()["counts"])
        return counts

    @contextmanager
    def _writing(self, name: str) -> Iterator[Path]:
        try:
            with written_whole(self.folder / name) as draft:
                yield draft
        except FileNotFoundError as error:
            raise Abandoned(" ".join((Abandoned.__doc__ or "").split())) from error


def ask_to_pause(folder: Path) -> None:
    """Have the training in this folder write a checkpoint and raise Paused; forgotten when it begins again."""
    if folder.is_dir():
        (folder / PAUSE_FILE).touch()


def begin_again(folder: Path) -> None:
    """Forget that anybody asked for a pause."""
    (folder / PAUSE_FILE).unlink(missing_ok=True)


def go_on_from(begun: Path, folder: Path) -> None:
    """Have the training in this folder go on from another one's checkpoint, if there is one, and none of its own."""
    if (begun / STATE_FILE).exists() and not (folder / STATE_FILE).exists():
        with written_whole(folder / STATE_FILE) as draft:
            shutil.copyfile(begun / STATE_FILE, draft)


def share_done(folder: Path) -> float:
    """What the training in this folder noted last; 0 before it began."""
    try:
        return float((folder / NOTE_FILE).read_text())
    except (FileNotFoundError, ValueError):
        return 0.0
