"""The installation's signature: an Ed25519 key of its own, which signs what leaves the studio.

What is signed is a JSON document, in its canonical form and without its member ``signature``. Bundles carry such a
document about their manifest (worker.ml.export.bundle); archives, receipts and heads of the audit log are documents
themselves. A signature says which studio something comes from, if its fingerprint was compared on another way.
"""

import hashlib
import json
import os
import tempfile
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.kdf.hkdf import HKDF
from cryptography.hazmat.primitives.serialization import (
    Encoding,
    NoEncryption,
    PrivateFormat,
    PublicFormat,
    load_pem_private_key,
)

from app.errors import AppError
from app.settings import Settings

SIGNATURE = "signature"
_ALGORITHM = "Ed25519"


class SigningKeyUnreadable(AppError):
    """The file of the signing key does not hold a private Ed25519 key in PEM format. Restore it from a backup."""


class SignatureBroken(ValueError):
    """The signature does not belong to what it is on: one of them was changed."""


@dataclass(frozen=True)
class SigningKey:
    """The private key; whoever has it can sign in the name of this installation."""

    private: Ed25519PrivateKey

    @property
    def public_hex(self) -> str:
        """The 32 bytes of the public key."""
        return self.private.public_key().public_bytes(Encoding.Raw, PublicFormat.Raw).hex()

    @property
    def public_pem(self) -> str:
        """The public key as other programs read it."""
        return self.private.public_key().public_bytes(Encoding.PEM, PublicFormat.SubjectPublicKeyInfo).decode()

    @property
    def fingerprint(self) -> str:
        """SHA-256 of the public key: what people compare."""
        return fingerprint_of(self.public_hex)

    def derived(self, purpose: bytes) -> bytes:
        """32 bytes for another purpose, HKDF with SHA-256: whoever has them learns nothing of the key itself."""
        private = self.private.private_bytes_raw()
        return HKDF(algorithm=SHA256(), length=32, salt=None, info=b"pbarl-studio " + purpose).derive(private)

    def signed(self, document: Mapping[str, Any]) -> dict[str, Any]:
        """The document with its signature."""
        rest = {name: value for name, value in document.items() if name != SIGNATURE}
        value = self.private.sign(canonical(rest)).hex()
        return rest | {SIGNATURE: {"algorithm": _ALGORITHM, "public_key": self.public_hex, "value": value}}


def load(settings: Settings) -> SigningKey:
    """The key of this installation, made when there is none yet. Raises SigningKeyUnreadable."""
    path = settings.signing_key_path
    if not path.exists():
        _make(path)
    try:
        private = load_pem_private_key(path.read_bytes(), password=None)
    except (ValueError, TypeError) as error:
        raise SigningKeyUnreadable(f"{SigningKeyUnreadable.__doc__} ({path})") from error
    if not isinstance(private, Ed25519PrivateKey):
        raise SigningKeyUnreadable(f"{SigningKeyUnreadable.__doc__} ({path})")
    return SigningKey(private)


def signer_of(document: Mapping[str, Any]) -> str | None:
    """The fingerprint of the key that has signed the document; None when it is not signed. Raises SignatureBroken."""
    signature = document.get(SIGNATURE)
    if signature is None:
        return None
    rest = {name: value for name, value in document.items() if name != SIGNATURE}
    try:
        if signature["algorithm"] != _ALGORITHM:
            raise SignatureBroken(f"It is signed with {str(signature['algorithm'])[:40]}, which is not known here.")
        public = Ed25519PublicKey.from_public_bytes(bytes.fromhex(signature["public_key"]))
        public.verify(bytes.fromhex(signature["value"]), canonical(rest))
    except (InvalidSignature, KeyError, TypeError, ValueError) as error:
        raise error if isinstance(error, SignatureBroken) else SignatureBroken(SignatureBroken.__doc__) from error
    return fingerprint_of(signature["public_key"])


def canonical(document: Mapping[str, Any]) -> bytes:
    """The bytes that are signed: JSON with sorted names, without spaces, in ASCII."""
    return json.dumps(document, sort_keys=True, separators=(",", ":"), allow_nan=False).encode()


def fingerprint_of(public_hex: str) -> str:
    """SHA-256 of a public key, in hexadecimal."""
    return hashlib.sha256(bytes.fromhex(public_hex)).hexdigest()


def is_trusted(signer: str | None, settings: Settings) -> bool:
    """Whether it is this installation's own key, or one that its operator has named."""
    return signer is not None and signer in {load(settings).fingerprint, *settings.trusted_fingerprints}


def in_words(signer: str | None, settings: Settings) -> str:
    """What a fingerprint, or that there is none, means here."""
    if signer is None:
        return "It is not signed, so nothing proves which studio it comes from."
    if signer == load(settings).fingerprint:
        return "It was signed by this studio."
    if signer in settings.trusted_fingerprints:
        return f"It was signed by a key that this studio trusts: {signer}."
    return f"It was signed by a key that this studio does not know. Compare its fingerprint with its owner: {signer}."


def _make(path: Path) -> None:
    """A new key, for this account alone. Whoever comes second leaves the first one's alone."""
    stored = Ed25519PrivateKey.generate().private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
    path.parent.mkdir(parents=True, exist_ok=True)
    descriptor, draft = tempfile.mkstemp(dir=path.parent, prefix=".signing-")  # made with mode 600
    try:
        with os.fdopen(descriptor, "wb") as stream:
            stream.write(stored)
            stream.flush()
            os.fsync(stream.fileno())
        with suppress(FileExistsError):
            os.link(draft, path)
    finally:
        Path(draft).unlink(missing_ok=True)
