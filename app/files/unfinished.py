"""What is not finished: folders on this machine, and copies in the bucket for a machine that takes over."""

import shutil
import time
from contextlib import suppress
from pathlib import Path

from app.files.interface import Files

FOLDER = "unfinished"
KEPT = "*.safetensors"
"""What a training goes on from; notes of how far it is are of use on this machine only."""

REFINEMENT = "refinement"
WORKSPACES = ("export", "import", REFINEMENT)
"""How the names of folders begin that are of use to one process only."""


class Unfinished:
    """Trainings work in folders of this machine, and others go on from what they keep."""

    def __init__(self, root: Path, files: Files) -> None:
        """``root``: on this machine; on the same disk as the artefacts if those are on this machine."""
        self.root, self._files = root, files
        self._uploaded: dict[Path, int] = {}
        """when what was kept had been changed"""

    def folder(self, participant_id: int) -> Path:
        """For what long trainings for one person write; it may not exist."""
        return self.root / f"participant-{participant_id}"

    def bring(self, folder: Path) -> None:
        """Before a training goes on: get what was kept of it, which no file that is here is newer than."""
        if not self._files.is_shared:
            return
        there = self._there(folder)
        for name, known in list(self._files.found(there)):
            with (draft := folder / f".{name}").open("wb") as stream:
                stream.writelines(self._files.pieces(f"{there}/{name}", known))
            draft.replace(folder / name)
            self._uploaded[folder / name] = (folder / name).stat().st_mtime_ns

    def keep(self, folder: Path) -> None:
        """While a training goes on: let others have what has changed, should this machine not come back."""
        if not self._files.is_shared:
            return
        for path in folder.glob(KEPT):
            changed_ns = path.stat().st_mtime_ns
            if path.name.startswith(".") or self._uploaded.get(path) == changed_ns:
                continue
            link = folder / f".{path.name}.upload"
            link.unlink(missing_ok=True)
            link.hardlink_to(path)  # what replaces the file meanwhile leaves this one as it is
            self._files.take(f"{self._there(folder)}/{path.name}", link)
            self._uploaded[path] = changed_ns

    def forget(self, folder: Path) -> None:
        """Remove a folder, and what was kept of it."""
        shutil.rmtree(folder, ignore_errors=True)
        if self._files.is_shared:
            for name, _ in list(self._files.found(self._there(folder))):
                self._files.delete(f"{self._there(folder)}/{name}")

    def clear_workspaces(self, older_than_s: float) -> None:
        """Remove folders in which a killed program was at work on what several people said, an archive for example."""
        newest_s = time.time() - older_than_s
        for folder in [each for name in WORKSPACES for each in self.root.glob(f"{name}-*")]:
            with suppress(FileNotFoundError):
                if folder.stat().st_mtime < newest_s:
                    shutil.rmtree(folder, ignore_errors=True)

    def _there(self, folder: Path) -> str:
        return f"{FOLDER}/{folder.relative_to(self.root)}"
