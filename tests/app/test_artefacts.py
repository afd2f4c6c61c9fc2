"""Artefacts are whole or absent, and are what their name says."""

import hashlib

import pytest

from app.files import lost
from app.files.interface import Stat
from app.settings import Settings
from app.storage import ArtefactDamaged, ArtefactMissing, ArtefactStore
from tests import stored_files
from tests.waiting import until


@pytest.fixture
def store(settings: Settings) -> ArtefactStore:
    return ArtefactStore.of(settings)


def test_an_artefact_is_named_by_its_content_and_comes_back_unchanged(store: ArtefactStore) -> None:
    name = store.put(b"a clip")
    assert name == hashlib.sha256(b"a clip").hexdigest()
    assert store.read(name) == b"a clip"
    assert store.put(b"a clip") == name
    assert stored_files.names(store) == {name}


def test_a_damaged_artefact_is_never_handed_out(store: ArtefactStore) -> None:
    name = store.put(b"a model")
    stored_files.overwrite(store, name, b"another model")
    for _ in range(2):
        with pytest.raises(ArtefactDamaged, match="damaged"):
            store.read(name)
        with pytest.raises(ArtefactDamaged):
            store.verified(name)
        assert not store.has(name)


def test_damage_after_the_first_look_is_found(store: ArtefactStore) -> None:
    name = store.put(b"a clip")
    assert b"".join(store.verified(name).pieces()) == b"a clip"
    stored_files.overwrite(store, name, b"a crap")
    with pytest.raises(ArtefactDamaged):
        store.verified(name)


def test_a_file_is_read_through_once_and_not_at_every_request(
    store: ArtefactStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = store.put(b"a clip")
    read: list[str] = []

    def counted(name: str, _known: Stat) -> str:
        read.append(name)
        return hashlib.sha256(b"a clip").hexdigest()

    monkeypatch.setattr(store.files, "sha256", counted)
    for _ in range(5):
        store.verified(name)
    assert len(read) == 1


def test_what_is_damaged_is_set_aside_and_can_be_made_anew(store: ArtefactStore) -> None:
    name, other = store.put(b"a clip"), store.put(b"another clip")
    stored_files.overwrite(store, name, b"a crap")
    stored_files.lose(store, other)
    assert (store.has(name), store.has(other)) == (False, False)
    assert store.lost().keys() == {name, other}
    assert store.put(b"a clip") == name
    assert store.read(name) == b"a clip"
    stored_files.overwrite(store, other, b"another clip")  # from a backup
    assert until(lambda: store.lost() == {})


def test_what_is_damaged_does_not_keep_the_same_from_being_stored(store: ArtefactStore) -> None:
    name = store.put(b"a clip")
    stored_files.overwrite(store, name, b"a crap")
    assert store.put(b"a clip") == name
    assert store.read(name) == b"a clip"


def test_a_scrub_finds_damage_that_left_no_trace(store: ArtefactStore, monkeypatch: pytest.MonkeyPatch) -> None:
    name = store.put(b"a clip")
    assert store.has(name)
    known, stat = store.files.stat(lost.place(name)), store.files.stat

    def as_before(place: str, *, fresh: bool = False) -> Stat | None:
        """A decaying disk changes bytes and nothing else."""
        found = stat(place, fresh=fresh)
        return known if found is not None and place == lost.place(name) else found

    stored_files.overwrite(store, name, b"a crap")
    monkeypatch.setattr(store.files, "stat", as_before)
    assert store.has(name)
    assert not store.scrub(name)
    assert store.lost().keys() == {name}


def test_nothing_of_a_deleted_artefact_is_kept(store: ArtefactStore) -> None:
    name = store.put(b"a diary")
    stored_files.overwrite(store, name, b"a dairy")
    assert not store.has(name)
    store.delete(name)
    assert list(stored_files.everything(store)) == []


@pytest.mark.parametrize("name", ["", "..", "../../etc/passwd", "A" * 64, "0" * 63, "0" * 64 + "\n"])
def test_only_hashes_are_names(store: ArtefactStore, name: str) -> None:
    with pytest.raises(ArtefactMissing):
        store.verified(name)


def test_a_missing_artefact_says_what_to_do(store: ArtefactStore) -> None:
    with pytest.raises(ArtefactMissing, match="data directory"):
        store.read("0" * 64)


def test_a_deleted_artefact_is_gone(store: ArtefactStore) -> None:
    name = store.put(b"a clip")
    store.delete(name)
    assert not store.has(name)
