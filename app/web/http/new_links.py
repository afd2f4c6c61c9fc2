"""Hands new personal links to the experimenter who asked for them, whichever web server shows the page.

The database keeps them sealed for ten minutes; the key is part of the page's address, and never stored.
"""

import base64
import hashlib
import json
import secrets
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import timedelta

from cryptography.fernet import Fernet
from sqlalchemy import delete, select
from sqlalchemy.orm import Session

from app.db import now
from app.domain import people

KEPT_FOR = timedelta(minutes=10)


@dataclass(frozen=True)
class NewLink:
    """A participant's code and personal link."""

    code: str
    url: str


def leave(session: Session, experimenter_id: int, links: Sequence[NewLink]) -> str:
    """Keep the links for their experimenter; returns the key that picks them up."""
    session.execute(delete(people.NewLinks).where(people.NewLinks.expires_at < now()))
    key = secrets.token_urlsafe(24)
    sealed = _seal(key).encrypt(json.dumps([asdict(link) for link in links]).encode()).decode()
    row = people.NewLinks(
        key_sha256=_hash(key), experimenter_id=experimenter_id, sealed=sealed, expires_at=now() + KEPT_FOR
    )
    session.add(row)
    return key


def pick_up(session: Session, experimenter_id: int, key: str) -> Sequence[NewLink]:
    """The links left under this key; nothing for others, and nothing after ten minutes."""
    left = select(people.NewLinks).where(people.NewLinks.key_sha256 == _hash(key), people.NewLinks.expires_at > now())
    row = session.scalar(left.where(people.NewLinks.experimenter_id == experimenter_id))
    return [NewLink(**link) for link in json.loads(_seal(key).decrypt(row.sealed))] if row else ()


def _hash(key: str) -> str:
    return hashlib.sha256(f"place of {key}".encode()).hexdigest()


def _seal(key: str) -> Fernet:
    return Fernet(base64.urlsafe_b64encode(hashlib.sha256(f"seal of {key}".encode()).digest()))
