"""What leaves the studio is signed with its own key; what comes in is checked, and the page says what was found."""

import json
import stat
import subprocess
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest
from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat
from fastapi import FastAPI
from fastapi.testclient import TestClient
from pydantic import ValidationError

from app import signing
from app.db import Database
from app.domain.protocol import EvaluationSettings
from app.domain.studies import Study
from app.services.archives import archive, sealing, study_import
from app.services.archives.archive import ArchiveInvalid
from app.settings import Settings
from app.storage import ArtefactStore
from tests import factories
from tests.app.conftest import bring
from tests.app.test_audit_chain import run, stamp

DOCUMENT = {"format": "pbarl-studio-of-a-test", "value": 1.5, "text": "Grüße"}


class TestKey:
    def test_it_is_made_once_for_this_account_alone(self, settings: Settings) -> None:
        first = signing.load(settings)
        assert stat.S_IMODE(settings.signing_key_path.stat().st_mode) == 0o600
        assert signing.load(settings).fingerprint == first.fingerprint
        assert list(settings.data_dir.glob(".signing-*")) == []

    def test_a_file_that_holds_none_is_said_to(self, settings: Settings) -> None:
        other = X25519PrivateKey.generate().private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
        for stored in (b"", b"no key", other):
            settings.signing_key_path.write_bytes(stored)
            with pytest.raises(signing.SigningKeyUnreadable, match=r"signing\.key"):
                signing.load(settings)

    def test_it_may_lie_elsewhere(self, settings: Settings, tmp_path: Path) -> None:
        elsewhere = settings.model_copy(update={"signing_key_file": tmp_path / "secrets" / "lab.pem"})
        assert signing.load(elsewhere).fingerprint != signing.load(settings).fingerprint
        assert (tmp_path / "secrets" / "lab.pem").exists()

    def test_trusted_keys_are_fingerprints(self) -> None:
        fingerprint = "AB" * 32
        assert Settings(_env_file=None, trusted_keys=f" {fingerprint}, ").trusted_fingerprints == {"ab" * 32}
        with pytest.raises(ValidationError, match="no fingerprint"):
            Settings(_env_file=None, trusted_keys="lab-b")


class TestDocuments:
    def test_a_signature_names_its_key_and_the_same_document_has_the_same_one(self, settings: Settings) -> None:
        key = signing.load(settings)
        signed = key.signed(DOCUMENT)
        assert signing.signer_of(json.loads(json.dumps(signed))) == key.fingerprint
        assert key.signed(DOCUMENT) == signed == key.signed(signed)
        assert signing.signer_of(DOCUMENT) is None

    @pytest.mark.parametrize(
        "change",
        [
            lambda signed: signed | {"value": 2.5},
            lambda signed: signed | {"more": True},
            lambda signed: {name: value for name, value in signed.items() if name != "text"},
            lambda signed: signed | {"signature": signed["signature"] | {"value": "00" * 64}},
            lambda signed: signed | {"signature": signed["signature"] | {"public_key": "11" * 32}},
            lambda signed: signed | {"signature": signed["signature"] | {"public_key": "no hex"}},
            lambda signed: signed | {"signature": signed["signature"] | {"algorithm": "none"}},
            lambda signed: signed | {"signature": "yes"},
            lambda signed: signed | {"signature": {}},
            lambda signed: signed | {"signature": []},
        ],
    )
    def test_whatever_was_changed_breaks_it(
        self, settings: Settings, change: Callable[[dict[str, object]], dict[str, object]]
    ) -> None:
        with pytest.raises(signing.SignatureBroken):
            signing.signer_of(change(signing.load(settings).signed(DOCUMENT)))

    def test_openssl_agrees(self, settings: Settings, tmp_path: Path) -> None:
        key = signing.load(settings)
        (tmp_path / "key.pem").write_text(key.public_pem)
        (tmp_path / "document").write_bytes(signing.canonical(DOCUMENT))
        (tmp_path / "signature").write_bytes(bytes.fromhex(key.signed(DOCUMENT)["signature"]["value"]))
        command = "openssl pkeyutl -verify -pubin -inkey key.pem -rawin -in document -sigfile signature"
        done = subprocess.run(command.split(), cwd=tmp_path, capture_output=True, text=True, check=False)
        assert "Verified Successfully" in done.stdout


def packed(
    database: Database, store: ArtefactStore, path: Path, key: signing.SigningKey | None, blinded: bool = False
) -> tuple[Path, str]:
    """An archive and its seal key."""
    with database.writing() as session:
        settings = {"evaluation": EvaluationSettings()} if blinded else {}
        study = factories.make_study(session, "Pilot", **settings)
        factories.make_queries(session, store, factories.make_participant(session, study)[0], 1)
        archive.write(session, store, study, path, key)
        return path, sealing.key_of(study)


def rewritten(path: Path, change: Callable[[dict[str, object]], object]) -> Path:
    """The archive with another manifest."""
    changed = path.with_name("changed.zip")
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(changed, "w") as new:
        for name in old.namelist():
            stored = old.read(name)
            if name == archive.MANIFEST:
                manifest = json.loads(stored)
                change(manifest)
                stored = json.dumps(manifest).encode()
            new.writestr(name, stored)
    return changed


@pytest.mark.parametrize("blinded", [False, True])
def test_an_archive_says_which_studio_it_comes_from(
    database: Database, store: ArtefactStore, settings: Settings, elsewhere: FastAPI, tmp_path: Path, blinded: bool
) -> None:
    key = signing.load(settings)
    path, seal_key = packed(database, store, tmp_path / "signed.zip", key, blinded)
    imported = bring(elsewhere, path, seal_key if blinded else "")
    assert imported.signer == key.fingerprint
    there: Settings = elsewhere.state.studio.settings
    assert f"does not know. Compare its fingerprint with its owner: {key.fingerprint}" in signing.in_words(
        imported.signer, there
    )
    trusting = there.model_copy(update={"trusted_keys": key.fingerprint})
    assert "a key that this studio trusts" in signing.in_words(imported.signer, trusting)
    assert signing.in_words(imported.signer, settings) == "It was signed by this studio."
    with elsewhere.state.studio.database.reading() as session:
        study = session.get_one(Study, imported.study.id)
        assert study_import.signer_of(session, study) == (True, key.fingerprint)


def test_an_archive_without_a_signature_is_taken_and_said_to_have_none(
    database: Database, store: ArtefactStore, elsewhere: FastAPI, tmp_path: Path
) -> None:
    imported = bring(elsewhere, packed(database, store, tmp_path / "plain.zip", None)[0])
    assert imported.signer is None
    assert "nothing proves" in signing.in_words(None, elsewhere.state.studio.settings)


def test_a_broken_signature_is_refused_and_a_claimed_signer_is_not_believed(
    database: Database, store: ArtefactStore, settings: Settings, elsewhere: FastAPI, tmp_path: Path
) -> None:
    key = signing.load(settings)
    path, _ = packed(database, store, tmp_path / "signed.zip", key)
    with pytest.raises(ArchiveInvalid, match="signature of this archive is broken"):
        bring(elsewhere, rewritten(path, lambda manifest: manifest.update(software_version="9.9")))

    def claim(manifest: dict[str, object]) -> None:
        del manifest["signature"]
        manifest["signer"] = key.fingerprint

    assert bring(elsewhere, rewritten(path, claim)).signer is None


def test_the_pages_say_who_signed_what_was_imported(
    database: Database, store: ArtefactStore, experimenter: TestClient, settings: Settings, tmp_path: Path
) -> None:
    path, _ = packed(database, store, tmp_path / "signed.zip", signing.load(settings))
    with path.open("rb") as file:
        answer = experimenter.post("/import", files={"file": file})
    assert "It was signed by this studio." in experimenter.get(answer.headers["location"]).text
    page = experimenter.get("/studies/pilot-2/export").text
    assert "It was signed by this studio." in page
    assert signing.load(settings).fingerprint in page
    assert "This study was imported" not in experimenter.get("/studies/pilot/export").text


def test_commands_show_the_key_and_check_files(
    database: Database, store: ArtefactStore, settings: Settings, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    stamp(settings)
    key = signing.load(settings)
    assert run(settings, "signing-key") == 0
    assert key.fingerprint in capsys.readouterr().out
    path, _ = packed(database, store, tmp_path / "signed.zip", key)
    assert run(settings, "check-signature", str(path)) == 0
    assert "It was signed by this studio." in capsys.readouterr().out
    receipt = tmp_path / "receipt.json"
    receipt.write_text(json.dumps(key.signed({"format": "pbarl-studio-erasure-receipt", "files": 3})))
    assert run(settings, "check-signature", str(receipt)) == 0
    receipt.write_text(receipt.read_text().replace('"files": 3', '"files": 4'))
    assert run(settings, "check-signature", str(receipt)) == 1
    assert "broken" in capsys.readouterr().out
    for stored in (b"", b"[]", b"{}", b"PK\x03\x04"):
        receipt.write_bytes(stored)
        assert run(settings, "check-signature", str(receipt)) == 1


def test_nobody_s_signature_and_a_stranger_s_are_no_success(
    settings: Settings, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Strip the signature, or sign with a key of your own: a script that asks must not take it for good."""
    stranger = signing.load(settings.model_copy(update={"data_dir": tmp_path / "elsewhere"}))
    document = {"format": "pbarl-studio-erasure-receipt", "files": 3}
    file = tmp_path / "receipt.json"
    for stored, said in ((document, "It is not signed"), (stranger.signed(document), "does not know")):
        file.write_text(json.dumps(stored))
        assert run(settings, "check-signature", str(file)) == 1
        assert said in capsys.readouterr().out
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TRUSTED_KEYS", stranger.fingerprint)
        assert run(settings, "check-signature", str(file)) == 0


DEEP = "[" * 100_000


@pytest.mark.parametrize(
    "members",
    [
        {"manifest.json": "[]"},
        {"manifest.json": '"x"'},
        {"manifest.json": DEEP},
        {"manifest.json": '{"files": []}'},
        {"manifest.json": '{"files": 3}'},
        {"manifest.json": '{"files": {"a": 3}}', "a": "x"},
        {"manifest.json": '{"files": {}}', "signature.json": "[]"},
        {"manifest.json": '{"files": {}}', "signature.json": "3"},
        {"manifest.json": '{"files": {}}', "signature.json": DEEP},
        {},
    ],
)
def test_a_malformed_file_is_told_in_words(
    settings: Settings, tmp_path: Path, members: dict[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "bundle.zip"
    with zipfile.ZipFile(file, "w") as packed_by_hand:
        for name, content in members.items():
            packed_by_hand.writestr(name, content)
    assert run(settings, "check-signature", str(file)) == 1
    assert "it is damaged" in capsys.readouterr().out
