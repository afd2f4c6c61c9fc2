"""What tests do to stored files behind a studio's back, wherever those lie."""

from collections.abc import Iterator
from pathlib import PurePosixPath

from app.files import lost
from app.storage import ArtefactStore


def names(store: ArtefactStore) -> set[str]:
    """The hashes of all artefacts there are."""
    return {PurePosixPath(name).name for name, _ in store.files.found(lost.ARTEFACTS)}


def everything(store: ArtefactStore) -> Iterator[bytes]:
    """The content of every artefact and of everything that was set aside."""
    for folder in (lost.ARTEFACTS, lost.DAMAGED):
        for name, _ in list(store.files.found(folder)):
            yield store.files.read(f"{folder}/{name}")


def content(store: ArtefactStore, sha256: str) -> bytes:
    """What is in the file, whether it is what its name says or not."""
    return store.files.read(lost.place(sha256))


def overwrite(store: ArtefactStore, sha256: str, other: bytes) -> None:
    """Let the file hold something else than its name says, as another program could."""
    store.files.put(lost.place(sha256), other)


def damage(store: ArtefactStore, sha256: str) -> None:
    """One bit is wrong, as on a decaying disk."""
    decayed = bytearray(content(store, sha256))
    decayed[len(decayed) // 2] ^= 1
    overwrite(store, sha256, bytes(decayed))


def lose(store: ArtefactStore, sha256: str) -> None:
    """The file is gone."""
    store.files.delete(lost.place(sha256))
