"""Receipts of erasures: what went, when, and how much of it, for whoever has to show that it went; nothing of whom.

Erasing takes two steps or more: the web erases rows and files at once, the worker what came in late and its own notes.
Each leaves a receipt, whose hash is a row of the audit log.
"""

import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from http import HTTPStatus
from itertools import groupby
from typing import Any

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from app.db import now
from app.domain.people import ErasureReceipt
from app.domain.studies import Participant, Study
from app.errors import AppError
from app.services import audit

FORMAT = "pbarl-studio-erasure-receipt"
ROWS_AND_FILES = "rows and files"
LATE_RESULTS = "results and notes of the worker"
LAST_TRACES = "last traces"
"""Copies made before upgrades, and the bytes of freed pages: after this nothing is left."""


class ReceiptNotFound(AppError):
    """There is no receipt of this number."""

    status = HTTPStatus.NOT_FOUND


@dataclass
class Erased:
    """What one step of erasing has come to."""

    rows: dict[str, int] = field(default_factory=dict)
    """by table"""
    files: int = 0
    audit_rows: list[int] = field(default_factory=list)
    """Rows of the audit log whose subject was erased."""

    def __bool__(self) -> bool:
        return bool(any(self.rows.values()) or self.files or self.audit_rows)


@dataclass(frozen=True)
class Erasure:
    """Everything that is known of the erasing of one person, or of one study."""

    number: int
    steps: Sequence[ErasureReceipt]

    @property
    def rows(self) -> int:
        """Of all tables and steps."""
        return sum(sum(step.contents["rows"].values()) for step in self.steps)

    @property
    def files(self) -> int:
        """Of all steps."""
        return sum(step.contents["files"] for step in self.steps)

    @property
    def is_complete(self) -> bool:
        """Whether the worker has removed the last traces as well."""
        return any(step.contents["step"] == LAST_TRACES for step in self.steps)


def add(session: Session, whom: Study | Participant, step: str, erased: Erased) -> None:
    """Keep the receipt of one step, and chain it."""
    person = whom if isinstance(whom, Participant) else None
    of = "study" if person is None else "preview" if person.is_preview else "participant"
    study_id, participant_id = _ids(whom)
    receipt = ErasureReceipt(at=now(), study_id=study_id, participant_id=participant_id, contents={})
    receipt.contents = {
        "of": of,
        "study": study_id,
        "step": step,
        "at": receipt.at.isoformat(),
        "rows": {table: count for table, count in sorted(erased.rows.items()) if count},
        "files": erased.files,
        "audit_rows": as_ranges(erased.audit_rows),
    }
    session.add(receipt)
    session.flush()
    audit.record(session, audit.SYSTEM, audit.ERASED, f"receipt {receipt.id}: {hash_of(receipt.contents)}")


def are_there(session: Session, whom: Study | Participant) -> bool:
    """Whether anything of them was erased before."""
    return bool(_steps(session, *_ids(whom)))


def hash_of(contents: Mapping[str, Any]) -> str:
    """What the audit log says of a receipt."""
    canonical = json.dumps(contents, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(canonical.encode()).hexdigest()


def erasures(session: Session, most: int | None = None) -> Sequence[Erasure]:
    """The newest first, each under the number of its first step. ``most``: no more than so many."""
    first = func.min(ErasureReceipt.id).label("first")
    whose = (ErasureReceipt.study_id, ErasureReceipt.participant_id)
    found = session.execute(select(*whose, first).group_by(*whose).order_by(first.desc()).limit(most)).all()
    return [Erasure(number, _steps(session, study_id, person_id)) for study_id, person_id, number in found]


def find(session: Session, number: int) -> Erasure:
    """The erasure whose first step has this number. Raises ReceiptNotFound."""
    first = session.get(ErasureReceipt, number)
    if first is None:
        raise ReceiptNotFound
    steps = _steps(session, first.study_id, first.participant_id)
    if steps[0].id != number:
        raise ReceiptNotFound
    return Erasure(number, steps)


def document(session: Session, erasure: Erasure) -> dict[str, Any]:
    """What is handed out, before it is signed: all steps, their hashes, and the head of the audit log by now."""
    head = audit.head(session)
    return {
        "format": FORMAT,
        "version": 1,
        "number": erasure.number,
        "written_at": now().isoformat(),
        "complete": erasure.is_complete,
        "steps": [{"receipt": step.id, "sha256": hash_of(step.contents), **step.contents} for step in erasure.steps],
        "audit_head": {"row": head.row, "hash": head.hash},
    }


def _ids(whom: Study | Participant) -> tuple[int, int | None]:
    return (whom.study_id, whom.id) if isinstance(whom, Participant) else (whom.id, None)


def _steps(session: Session, study_id: int, participant_id: int | None) -> Sequence[ErasureReceipt]:
    same = ErasureReceipt.study_id == study_id, ErasureReceipt.participant_id.is_not_distinct_from(participant_id)
    return session.scalars(select(ErasureReceipt).where(*same).order_by(ErasureReceipt.id)).all()


def as_ranges(numbers: Iterable[int]) -> str:
    """1, 2, 3 and 7 as "1-3,7"."""
    runs = groupby(enumerate(sorted(numbers)), key=lambda each: each[1] - each[0])
    return ",".join(_range([number for _, number in run]) for _, run in runs)


def from_ranges(written: str) -> Iterator[tuple[int, int]]:
    """First and last of every run in what as_ranges() has written. Raises ValueError."""
    for run in written.split(",") if written else ():
        first, _, last = run.partition("-")
        yield int(first), int(last or first)


def _range(run: Sequence[int]) -> str:
    return str(run[0]) if len(run) == 1 else f"{run[0]}-{run[-1]}"
