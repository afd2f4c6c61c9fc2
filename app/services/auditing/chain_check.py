"""Checks the audit log: every row against its own hash, the hash of the row before it, and the receipts of erasures.

What can be found without anything from outside: rows that were edited, removed, inserted or put in another order, and
subjects that were erased without a receipt. Who may write to the database can also remove the newest rows, or make the
whole chain anew; that is found by whoever noted an earlier head elsewhere.
"""

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session

from app.domain.people import AuditEvent, ErasureReceipt
from app.services import audit
from app.services.audit import BEGINNING, Head
from app.services.auditing import receipts

_RECEIPT = re.compile(r"receipt (\d+): ([0-9a-f]{64})")
_ROWS_AT_ONCE = 1000


@dataclass
class Outcome:
    """What was found."""

    rows: int = 0
    head: Head = Head(0, BEGINNING)  # noqa: RUF009  (a tuple)
    erased: int = 0
    """Rows whose subject was erased."""
    faults: list[str] = field(default_factory=list)
    """In words, each with the row it is about."""
    noted: Head | None = None
    """The row whose hash is the head that was noted elsewhere; None: not asked for, or there is no such row."""


def check(session: Session, noted_hash: str | None = None) -> Outcome:
    """Everything in the database. ``noted_hash``: the head at some earlier time, from elsewhere."""
    rows = session.scalars(
        select(AuditEvent).order_by(AuditEvent.id).execution_options(yield_per=_ROWS_AT_ONCE, populate_existing=True)
    )
    kept = {each.id: each.contents for each in session.scalars(select(ErasureReceipt))}
    return check_rows(rows, kept, noted_hash)


def check_rows(
    rows: Iterable[AuditEvent], kept: Mapping[int, Mapping[str, Any]], noted_hash: str | None = None
) -> Outcome:
    """The same for rows in their order, and the contents of receipts by their numbers."""
    outcome, erased, chained = Outcome(), list[int](), dict[int, str]()
    for row in rows:
        outcome.faults += _faults_of(row, outcome.head)
        if row.subject is None:
            erased.append(row.id)
        elif row.action == audit.ERASED and (named := _RECEIPT.fullmatch(row.subject)):
            chained[int(named[1])] = named[2]
        outcome.rows, outcome.head = outcome.rows + 1, Head(row.id, row.row_hash)
        if row.row_hash == noted_hash:
            outcome.noted = outcome.head
    outcome.erased = len(erased)
    outcome.faults += _faults_of_receipts(kept, chained)
    outcome.faults += _erased_without_receipt(erased, [kept[each] for each in kept if each in chained])
    if noted_hash is not None and noted_hash != BEGINNING and outcome.noted is None:
        outcome.faults.append(
            "No row has the hash that was noted: rows up to it were removed or edited, or the chain was made anew."
        )
    return outcome


def _faults_of(row: AuditEvent, before: Head) -> Iterator[str]:
    if row.previous_hash != before.hash:
        yield (
            f"Row {row.id} does not follow {f'row {before.row}' if before.row else 'the beginning'}: "
            "rows between them were removed, inserted, put in another order, or edited."
        )
    if row.row_hash != audit.hash_of_row(row):
        yield f"Row {row.id} was edited: it is not what its hash says."
    if row.subject is None:
        if row.subject_salt is not None or row.participant_id is not None:
            yield f"Row {row.id} was edited: its subject is gone, and not all that an erasure takes with it."
    elif row.subject_hash != audit.hash_of_subject(row.subject_salt or "", row.subject, row.participant_id):
        yield f"Row {row.id} was edited: its subject is not what its hash says."


def _faults_of_receipts(kept: Mapping[int, Mapping[str, Any]], chained: Mapping[int, str]) -> Iterator[str]:
    for number in sorted(kept.keys() | chained.keys()):
        if number not in kept:
            yield f"Receipt {number} was removed: the audit log says that there was one."
        elif number not in chained:
            yield f"Receipt {number} was inserted: the audit log does not say that there was one."
        elif receipts.hash_of(kept[number]) != chained[number]:
            yield f"Receipt {number} was edited: it is not what the audit log says."


def _erased_without_receipt(erased: Iterable[int], kept: Iterable[Mapping[str, Any]]) -> Iterator[str]:
    covered = list[tuple[int, int]]()
    for contents in kept:
        try:
            covered += receipts.from_ranges(str(contents.get("audit_rows", "")))
        except ValueError:  # edited, which its hash says
            continue
    covered.sort()
    place = 0
    for row in erased:
        while place < len(covered) and covered[place][1] < row:
            place += 1
        if place == len(covered) or row < covered[place][0]:
            yield f"The subject of row {row} was erased without a receipt."
