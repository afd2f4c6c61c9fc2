"""Looking things up in the audit log, and all of it as a file."""

import json
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, date, datetime, time, timedelta
from typing import Any

from sqlalchemy import Select, select
from sqlalchemy.orm import Session

from app.domain.people import AuditEvent, ErasureReceipt, Experimenter
from app.domain.studies import Study
from app.errors import AppError
from app.services import audit
from app.services.auditing import chain_check
from app.services.auditing.chain_check import Outcome

PAGE_SIZE = 50
COLUMNS = tuple(column.name for column in AuditEvent.__table__.columns)
_ROWS_AT_ONCE = 1000


class LogUnreadable(AppError):
    """This file is no export of an audit log as JSONL."""


@dataclass(frozen=True)
class Wanted:
    """Which rows; None does not matter."""

    actor: str | None = None
    action: str | None = None
    study: str | None = None
    """by its short name"""
    since: date | None = None
    until: date | None = None
    """the last day, in UTC"""
    below: int | None = None
    """Only rows before this one, the newest first."""
    above: int | None = None
    """Only rows after this one; the page that ends there."""


@dataclass(frozen=True)
class LogPage:
    """Rows, the newest first, and where the neighbouring pages begin."""

    rows: Sequence[AuditEvent]
    newer_above: int | None
    older_below: int | None


def find(session: Session, wanted: Wanted) -> LogPage:
    """One page. It takes as long at the end of a long log as at its beginning."""
    matching = _matching(session, wanted)
    if wanted.above is not None:
        upwards = matching.where(AuditEvent.id > wanted.above).order_by(AuditEvent.id)
        found = session.scalars(upwards.limit(PAGE_SIZE + 1)).all()
        more_above, more_below = len(found) > PAGE_SIZE, True
        rows = list(reversed(found[:PAGE_SIZE]))
    else:
        downwards = matching if wanted.below is None else matching.where(AuditEvent.id < wanted.below)
        found = session.scalars(downwards.order_by(AuditEvent.id.desc()).limit(PAGE_SIZE + 1)).all()
        more_above, more_below = wanted.below is not None, len(found) > PAGE_SIZE
        rows = list(found[:PAGE_SIZE])
    if not rows:
        return LogPage([], None, None)
    return LogPage(rows, rows[0].id if more_above else None, rows[-1].id if more_below else None)


def actors(session: Session) -> Sequence[str]:
    """Everybody who may be in the log."""
    names = session.scalars(select(Experimenter.name).order_by(Experimenter.name)).all()
    return [*names, audit.PARTICIPANT, audit.SYSTEM, audit.STRANGER]


def actions(session: Session) -> Sequence[str]:
    """Every kind of act in the log, each found by one step in the index."""
    found: list[str] = []
    following = select(AuditEvent.action).order_by(AuditEvent.action).limit(1)
    while (action := session.scalar(following.where(AuditEvent.action > (found[-1] if found else "")))) is not None:
        found.append(action)
    return found


def slugs(session: Session) -> dict[int, str]:
    """Short names of studies by their numbers; those of deleted ones say that they are."""
    return {study.id: study.slug for study in session.execute(select(Study.id, Study.slug).order_by(Study.slug))}


def csv_rows(session: Session) -> Iterator[Sequence[Any]]:
    """The whole log for a spreadsheet, the oldest first, with its head."""
    yield COLUMNS
    for each in _all(session):
        yield [value.isoformat() if isinstance(value, datetime) else value for value in _values(each)]


def json_lines(session: Session) -> Iterator[str]:
    """The whole log and all receipts: what check_lines() needs."""
    for each in _all(session):
        yield _line(dict(zip(COLUMNS, _values(each), strict=True)))
    for receipt in session.scalars(select(ErasureReceipt).order_by(ErasureReceipt.id)):
        yield _line({"receipt": receipt.id, "contents": receipt.contents})


def check_lines(lines: Iterable[str], noted_hash: str | None = None) -> Outcome:
    """Check an export without the database. Raises LogUnreadable."""
    kept: dict[int, dict[str, Any]] = {}
    rows: list[AuditEvent] = []
    try:
        for line in lines:
            read = json.loads(line)
            if "receipt" in read:
                kept[int(read["receipt"])] = dict(read["contents"])
            else:
                rows.append(AuditEvent(**{**read, "at": datetime.fromisoformat(read["at"])}))
        return chain_check.check_rows(rows, kept, noted_hash)
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise LogUnreadable from error


def on_page(wanted: Wanted, *, below: int | None = None, above: int | None = None) -> Wanted:
    """The same rows on another page."""
    return replace(wanted, below=below, above=above)


def _matching(session: Session, wanted: Wanted) -> Select[AuditEvent]:
    matching = select(AuditEvent)
    if wanted.actor is not None:
        matching = matching.where(AuditEvent.actor == wanted.actor)
    if wanted.action is not None:
        matching = matching.where(AuditEvent.action == wanted.action)
    if wanted.study is not None:
        study_id = session.scalar(select(Study.id).where(Study.slug == wanted.study))
        matching = matching.where(AuditEvent.study_id == (study_id or 0))
    if wanted.since is not None:
        matching = matching.where(AuditEvent.at >= _midnight(wanted.since))
    if wanted.until is not None:
        matching = matching.where(AuditEvent.at < _midnight(wanted.until) + timedelta(days=1))
    return matching


def _midnight(day: date) -> datetime:
    return datetime.combine(day, time(), UTC)


def _all(session: Session) -> Iterator[AuditEvent]:
    yield from session.scalars(select(AuditEvent).order_by(AuditEvent.id).execution_options(yield_per=_ROWS_AT_ONCE))


def _values(row: AuditEvent) -> list[Any]:
    return [getattr(row, name) for name in COLUMNS]


def _line(values: dict[str, Any]) -> str:
    return json.dumps(values, default=datetime.isoformat, ensure_ascii=False) + "\n"
