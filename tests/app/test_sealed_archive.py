"""The archive of a blinded study: it tells nothing but what it is, until somebody has its seal key."""

import io
import json
import zipfile
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import pytest
from fastapi import FastAPI

from app.db import Database
from app.domain.studies import Study
from app.services.archives import archive, sealing
from app.services.archives.archive import ArchiveInvalid
from app.services.evaluation import unblinding
from app.storage import ArtefactStore
from tests import factories
from tests.app.conftest import bring
from tests.finished_study import make_finished_study

MOMENT = datetime(2026, 1, 31, tzinfo=UTC)


@pytest.fixture
def study(database: Database, store: ArtefactStore) -> Study:
    with database.writing() as session:
        return make_finished_study(session, store, people=3, labels=5)


@pytest.fixture
def sealed(database: Database, store: ArtefactStore, study: Study, tmp_path: Path) -> Path:
    """The archive of the same study while it is blinded."""
    path = tmp_path / "blinded.zip"
    with database.writing() as session:
        session.get_one(Study, study.id).unblinded_at = None
        session.flush()
        archive.write(session, store, session.get_one(Study, study.id), path)
    return path


def test_the_archive_of_a_blinded_study_says_nothing_but_what_it_is(sealed: Path) -> None:
    with zipfile.ZipFile(sealed) as file:
        assert file.namelist() == ["manifest.json", "sealed"]
        said = json.loads(file.read("manifest.json"))
        assert said.keys() == {"format", "version", "software_version", "written_at", "sealed"}
        assert (file.getinfo("sealed").file_size - 16) % (2**20 + 16) == 0, "whole pieces"
    content = sealed.read_bytes()
    for told in (b'pbarl"', b"reference", b"letter", b"feeding-finished", b"rows/", b"files/"):
        assert told not in content, told


def test_a_sealed_archive_arrives_with_its_key_of_letters(
    database: Database, elsewhere: FastAPI, study: Study, sealed: Path
) -> None:
    imported = bring(elsewhere, sealed, sealing.key_of(study).lower().replace("-", " "))
    with elsewhere.state.studio.database.writing() as session:
        there = session.get_one(Study, imported.study.id)
        assert unblinding.is_blinded(there)
        assert there.key_secret == study.key_secret, "who comes later is drawn as they would have been"
        there.unblinded_at = MOMENT
        key = unblinding.key_of(session, there)
    with database.writing() as session:
        session.get_one(Study, study.id).unblinded_at = MOMENT
        assert key == unblinding.key_of(session, session.get_one(Study, study.id))


@pytest.mark.parametrize("wrong", ["", "ABCD", "AAAA-AAAA-AAAA-AAAA-AAAA-AAAA-AAAA-AAAA"])
def test_without_its_seal_key_a_sealed_archive_stays_shut(elsewhere: FastAPI, sealed: Path, wrong: str) -> None:
    with pytest.raises(ArchiveInvalid, match="seal key"):
        bring(elsewhere, sealed, wrong)


def _with_a_piece_left_out(content: bytes) -> bytes:
    return content[: 16 + 2**20 + 16]


def _with_pieces_exchanged(content: bytes) -> bytes:
    first, second = content[16 : 16 + 2**20 + 16], content[16 + 2**20 + 16 :]
    return content[:16] + second + first


def _with_another_bit(content: bytes) -> bytes:
    return content[:100] + bytes([content[100] ^ 1]) + content[101:]


@pytest.mark.parametrize("change", [_with_a_piece_left_out, _with_pieces_exchanged, _with_another_bit])
def test_a_seal_that_was_tampered_with_is_noticed(study: Study, change: Callable[[bytes], bytes]) -> None:
    content = bytes(range(256)) * 6000
    key, target = sealing.key_of(study), io.BytesIO()
    sealing.seal(io.BytesIO(content), len(content), target, key)
    opened = io.BytesIO()
    sealing.unseal(io.BytesIO(target.getvalue()), opened, key)
    assert opened.getvalue() == content
    with pytest.raises(sealing.SealBroken):
        sealing.unseal(io.BytesIO(change(target.getvalue())), io.BytesIO(), key)


def test_a_study_without_an_evaluation_keeps_its_secret_to_itself(
    database: Database, store: ArtefactStore, tmp_path: Path
) -> None:
    """Its archive is not sealed, and an evaluation may be added later."""
    with database.writing() as session:
        study = factories.make_study(session)
        archive.write(session, store, study, tmp_path / "plain.zip")
    with zipfile.ZipFile(tmp_path / "plain.zip") as file:
        contents = [file.read(name) for name in file.namelist()]
    assert study.key_secret.encode() not in b"".join(contents)
