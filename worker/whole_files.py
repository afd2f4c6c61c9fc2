"""Files that are complete or absent, however a program ends."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def written_whole(path: Path) -> Iterator[Path]:
    """A neighbour to write to, which then takes the place of the file. Its name ends like that of the file."""
    draft = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    try:
        yield draft
        with draft.open("rb") as stream:
            os.fsync(stream.fileno())
        draft.replace(path)
    finally:
        draft.unlink(missing_ok=True)


def whole_files(folder: Path, pattern: str) -> list[Path]:
    """What a pattern finds, in order, without the drafts that killed writers left behind."""
    return [path for path in sorted(folder.glob(pattern)) if not path.name.startswith(".")]
