"""Artefacts are whole or absent, and are what their name says."""

import hashlib
from pathlib import Path

import pytest

from app import storage
from app.storage import ArtefactDamaged, ArtefactMissing, ArtefactStore


@pytest.fixture
def store(tmp_path: Path) -> ArtefactStore:
    return ArtefactStore(tmp_path / "artefacts")


def test_an_artefact_is_named_by_its_content_and_comes_back_unchanged(store: ArtefactStore) -> None:
    name = store.put(b"a clip")
    assert name == hashlib.sha256(b"a clip").hexdigest()
    assert store.read(name) == b"a clip"
    assert store.put(b"a clip") == name
    assert [path.name for path in store.root.rglob("*") if path.is_file()] == [name]


def test_a_damaged_artefact_is_never_handed_out(store: ArtefactStore) -> None:
    name = store.put(b"a model")
    store.path(name).write_bytes(b"another model")
    for _ in range(2):
        with pytest.raises(ArtefactDamaged, match="damaged"):
            store.read(name)
        with pytest.raises(ArtefactDamaged):
            store.verified(name)
        assert not store.has(name)


def test_damage_after_the_first_look_is_found(store: ArtefactStore) -> None:
    name = store.put(b"a clip")
    assert store.verified(name).read_bytes() == b"a clip"
    store.path(name).write_bytes(b"a crap")
    with pytest.raises(ArtefactDamaged):
        store.verified(name)


def test_a_file_is_read_through_once_and_not_at_every_request(
    store: ArtefactStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = store.put(b"a clip")
    read: list[Path] = []

    def counted(path: Path) -> str:
        read.append(path)
        return name

    monkeypatch.setattr(storage, "hash_of_file", counted)
    for _ in range(5):
        store.verified(name)
    assert len(read) == 1


def test_what_is_damaged_is_set_aside_and_can_be_made_anew(store: ArtefactStore) -> None:
    name, other = store.put(b"a clip"), store.put(b"another clip")
    store.path(name).write_bytes(b"a crap")
    store.path(other).unlink()
    assert (store.has(name), store.has(other)) == (False, False)
    assert store.lost().keys() == {name, other}
    assert store.put(b"a clip") == name
    assert store.read(name) == b"a clip"
    store.path(other).write_bytes(b"another clip")  # from a backup
    assert store.lost() == {}


def test_what_is_damaged_does_not_keep_the_same_from_being_stored(store: ArtefactStore) -> None:
    name = store.put(b"a clip")
    store.path(name).write_bytes(b"a crap")
    assert store.put(b"a clip") == name
    assert store.read(name) == b"a clip"


def test_a_scrub_finds_damage_that_left_no_trace(store: ArtefactStore, monkeypatch: pytest.MonkeyPatch) -> None:
    name = store.put(b"a clip")
    assert store.has(name)
    signature = storage._signature(store.path(name))
    store.path(name).write_bytes(b"a crap")
    monkeypatch.setattr(storage, "_signature", lambda _path: signature)  # as a decaying disk changes bytes
    assert store.has(name)
    assert not store.scrub(name)
    assert store.lost().keys() == {name}


def test_nothing_of_a_deleted_artefact_is_kept(store: ArtefactStore) -> None:
    name = store.put(b"a diary")
    store.path(name).write_bytes(b"a dairy")
    assert not store.has(name)
    store.delete(name)
    assert not [path for path in store.root.parent.rglob("*") if path.is_file()]


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
