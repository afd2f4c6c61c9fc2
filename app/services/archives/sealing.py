"""Files that only somebody with a study's seal key can read: archives of studies that are still blinded.

The key is made of the study's secret and tells nothing about it, so all archives of a study have the same one. A sealed
file is encrypted and authenticated in pieces (ChaCha20-Poly1305; the piece's number and whether it is the last are its
nonce, so nothing can be cut, moved or left out), and is as long as a whole number of pieces: its length says how much
there is to the nearest megabyte, and nothing else about it can be seen.
"""

import base64
import hashlib
import hmac
import secrets
from collections.abc import Iterator
from typing import IO

from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives.ciphers.aead import ChaCha20Poly1305
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.kdf.hkdf import HKDF

from app.domain.studies import Study

_PIECE = 1 << 20
_TAG, _SALT, _LENGTH = 16, 16, 8
_KEY_CHARACTERS = 32


class SealBroken(ValueError):
    """The key does not open it, or it is damaged: nobody can tell which."""


def key_of(study: Study) -> str:
    """The study's seal key: 32 letters and digits in groups of four."""
    made = hmac.new(study.key_secret.encode(), b"seal of archives", hashlib.sha256).digest()[:20]
    text = base64.b32encode(made).decode()
    return "-".join(text[place : place + 4] for place in range(0, len(text), 4))


def seal(source: IO[bytes], length: int, target: IO[bytes], key: str) -> None:
    """Write what the source holds, ``length`` bytes, so that only the key opens it."""
    salt = secrets.token_bytes(_SALT)
    cipher = _cipher(key, salt)
    target.write(salt)
    for number, last, piece in _pieces(source, length):
        target.write(cipher.encrypt(_nonce(number, last), piece, None))


def unseal(source: IO[bytes], target: IO[bytes], key: str) -> None:
    """Write what was sealed. Raises SealBroken; what was written until then is to be thrown away."""
    cipher, number, left = _cipher(key, source.read(_SALT)), 0, 0
    piece = source.read(_PIECE + _TAG)
    while piece:
        following = source.read(_PIECE + _TAG)
        try:
            opened = cipher.decrypt(_nonce(number, not following), piece, None)
        except InvalidTag as error:
            raise SealBroken from error
        if number == 0:
            left, opened = int.from_bytes(opened[:_LENGTH]), opened[_LENGTH:]
        target.write(opened[:left])
        left, number, piece = left - min(left, len(opened)), number + 1, following
    if left or not number:
        raise SealBroken


def _pieces(source: IO[bytes], length: int) -> Iterator[tuple[int, bool, bytes]]:
    """Pieces of the same length with their numbers, and whether each is the last: the length, the content, noughts."""
    count = -(-(_LENGTH + length) // _PIECE)
    for number in range(count):
        start = length.to_bytes(_LENGTH) if number == 0 else b""
        yield number, number == count - 1, (start + source.read(_PIECE - len(start))).ljust(_PIECE, b"\0")


def _nonce(number: int, last: bool) -> bytes:
    return number.to_bytes(11) + bytes([last])


def _cipher(key: str, salt: bytes) -> ChaCha20Poly1305:
    """Of this file alone. The key may be typed in small letters and with spaces. Raises SealBroken when it is none."""
    typed = "".join(each for each in key.upper() if each.isascii() and each.isalnum())
    if len(typed) != _KEY_CHARACTERS:
        raise SealBroken
    derived = HKDF(algorithm=SHA256(), length=32, salt=salt, info=b"pbarl-studio-archive").derive(typed.encode())
    return ChaCha20Poly1305(derived)
