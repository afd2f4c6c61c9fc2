"""Commands about proof: check the audit log, show its head, receipts of erasures, the signing key and signatures."""

import hashlib
import json
import tempfile
import zipfile
from pathlib import Path
from typing import Any

from app import signing, upgrading
from app.commands.parsers import Commands, add_command
from app.db import Database
from app.errors import AppError
from app.programs import say
from app.services import audit
from app.services.archives import archive, archive_reading, unpacking
from app.services.auditing import chain_check, lookup, receipts
from app.settings import Settings

LARGEST_BUNDLE_BYTES = 256 << 20
MOST_FAULTS_SAID = 20
_BUNDLE_FORMAT = "pbarl-studio-bundle-signature"
_MALFORMED = (*unpacking.UNREADABLE, ValueError, TypeError, AttributeError, RecursionError)
"""What a file raises that is of no form of ours, such as a manifest that is a list."""


class FileUnreadable(AppError):
    """This file is neither a bundle, an archive, a receipt nor a head of the audit log, or it is damaged."""


def add_to(commands: Commands) -> None:
    """Make the commands known to the command line."""
    add_command(commands, "audit-head", audit_head)
    add_command(commands, "signing-key", signing_key)
    checking = add_command(commands, "verify-audit", verify_audit)
    checking.add_argument("--head", default=None, metavar="HASH", help="the head as it was noted elsewhere")
    checking.add_argument("--file", type=Path, default=None, help="an export (JSONL) to check instead of the database")
    showing = add_command(commands, "erasure-receipts", erasure_receipts)
    showing.add_argument("number", type=int, nargs="?", help="of the receipt to print, signed")
    signature = add_command(commands, "check-signature", check_signature)
    signature.add_argument("file", type=Path)
    signature.add_argument("--seal-key", default="", help="of the archive of a study that is still blinded")


def audit_head(settings: Settings) -> int:
    """Print the number and the hash of the newest row of the audit log, to be noted elsewhere."""
    with _migrated(settings).reading() as session:
        head = audit.head(session)
    say(f"{head.row} {head.hash}")
    return 0


def verify_audit(settings: Settings, head: str | None, file: Path | None) -> int:
    """Check that no row of the audit log was edited, removed, inserted or moved; with --head none before it either."""
    noted = head.strip().lower() if head is not None else None
    if file is not None:
        try:
            with file.open(encoding="utf-8") as lines:
                outcome = lookup.check_lines(lines, noted)
        except (OSError, UnicodeDecodeError) as error:
            raise AppError(f"{file} cannot be read.") from error
    else:
        with _migrated(settings).reading() as session:
            outcome = chain_check.check(session, noted)
    for fault in outcome.faults[:MOST_FAULTS_SAID]:
        say(fault)
    if outcome.faults:
        say(f"The audit log is NOT whole: {len(outcome.faults)} faults in {outcome.rows} rows.")
        return 1
    say(f"The audit log is whole: {outcome.rows} rows, {outcome.erased} of them with an erased subject.")
    say(f"Head: row {outcome.head.row} {outcome.head.hash}")
    if outcome.noted is not None:
        say(f"The noted head is row {outcome.noted.row}: nothing up to it was changed since it was noted.")
    else:
        say("Compared with no earlier head (--head), so newest rows may have been removed, or all made anew.")
    return 0


def erasure_receipts(settings: Settings, number: int | None) -> int:
    """List the receipts of erasures, or print one of them, signed, as JSON."""
    with _migrated(settings).reading() as session:
        if number is not None:
            document = receipts.document(session, receipts.find(session, number))
            say(json.dumps(signing.load(settings).signed(document), indent=2))
            return 0
        for each in receipts.erasures(session):
            first = each.steps[0]
            state = "complete" if each.is_complete else "the worker removes the last traces"
            say(
                f"{each.number}: {first.at:%Y-%m-%d %H:%M} UTC, {first.contents['of']} in study {first.study_id}, "
                f"{each.rows} rows, {each.files} files, {state}"
            )
    return 0


def signing_key(settings: Settings) -> int:
    """Print the fingerprint and the public part of this installation's signing key, made at the first use."""
    key = signing.load(settings)
    say(f"Fingerprint: {key.fingerprint}")
    say(key.public_pem.strip())
    return 0


def check_signature(settings: Settings, file: Path, seal_key: str) -> int:
    """Say whether a bundle, archive, receipt or head is unchanged and whose key signed it; 0 for trusted keys only."""
    if not file.is_file():
        raise AppError(f"There is no file {file}.")
    try:
        signer = _of_zip(file, seal_key) if zipfile.is_zipfile(file) else _of_document(file.read_bytes())
    except signing.SignatureBroken as error:
        say(f"The signature is broken. {error}")
        return 1
    except _MALFORMED as error:
        raise FileUnreadable from error
    say(signing.in_words(signer, settings))
    return 0 if signing.is_trusted(signer, settings) else 1


def _of_document(stored: bytes) -> str | None:
    document = json.loads(stored)
    if not isinstance(document, dict) or not str(document.get("format")).startswith("pbarl-studio-"):
        raise FileUnreadable
    say("A document; nothing else belongs to it.")
    return signing.signer_of(document)


def _of_zip(file: Path, seal_key: str) -> str | None:
    with unpacking.opened(file, archive_reading.LARGEST_UNPACKED_BYTES) as packed:
        manifest = json.loads(unpacking.content(packed, archive.MANIFEST, archive.LARGEST_MANIFEST_BYTES))
        if manifest.get("format") != archive.FORMAT:
            return _of_bundle(packed, manifest)
    with tempfile.TemporaryDirectory() as folder:
        signer = archive_reading.verify(file, Path(folder), seal_key)
    say("An archive; all files are those that its manifest lists.")
    return signer


def _of_bundle(packed: zipfile.ZipFile, manifest: dict[str, Any]) -> str | None:
    """Raises SignatureBroken when anything is not as it was signed."""
    listed, names = manifest["files"], set(packed.namelist()) - {archive.MANIFEST, "signature.json"}
    for name in sorted(names | listed.keys()):
        stored = unpacking.content(packed, name, LARGEST_BUNDLE_BYTES) if name in names else b""
        if name not in listed or hashlib.sha256(stored).hexdigest() != listed[name]["sha256"]:
            raise signing.SignatureBroken(f"{name} is not what the manifest lists.")
    say("A bundle; all files are those that its manifest lists.")
    if "signature.json" not in packed.namelist():
        return None
    document = json.loads(unpacking.content(packed, "signature.json", archive.LARGEST_MANIFEST_BYTES))
    whole = hashlib.sha256(unpacking.content(packed, archive.MANIFEST, archive.LARGEST_MANIFEST_BYTES)).hexdigest()
    signer = signing.signer_of(document)
    if signer is None or document.get("format") != _BUNDLE_FORMAT or document.get("manifest_sha256") != whole:
        raise signing.SignatureBroken("signature.json is of another manifest.")
    return signer


def _migrated(settings: Settings) -> Database:
    upgrading.upgrade(settings)
    return Database(settings.sqlalchemy_url)
