"""Artefacts are whole or absent, and are what their name says."""

import hashlib
from pathlib import Path

import pytest

from app.storage import ArtefactMissing, ArtefactStore


@pytest.fixture
def store(tmp_path: Path) -> ArtefactStore:
    return ArtefactStore(tmp_path)


def test_an_artefact_is_named_by_its_content_and_comes_back_unchanged(store: ArtefactStore) -> None:
    name = store.put(b"a clip")
    assert name == hashlib.sha256(b"a clip").hexdigest()
    assert store.read(name) == b"a clip"
    assert store.put(b"a clip") == name
    assert [path.name for path in store.root.rglob("*") if path.is_file()] == [name]


def test_a_damaged_artefact_is_never_handed_out(store: ArtefactStore) -> None:
    name = store.put(b"a model")
    store.path(name).write_bytes(b"another model")
    with pytest.raises(ArtefactMissing, match="damaged"):
        store.read(name)


@pytest.mark.parametrize("name", ["", "..", "../../etc/passwd", "A" * 64, "0" * 63, "0" * 64 + "\n"])
def test_only_hashes_are_names(store: ArtefactStore, name: str) -> None:
    with pytest.raises(ArtefactMissing):
        store.path(name)


def test_a_missing_artefact_says_what_to_do(store: ArtefactStore) -> None:
    with pytest.raises(ArtefactMissing, match="data directory"):
        store.read("0" * 64)


def test_a_deleted_artefact_is_gone(store: ArtefactStore) -> None:
    name = store.put(b"a clip")
    store.delete(name)
    assert not store.has(name)
