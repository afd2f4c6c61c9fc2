"""The newest report of a study, as the worker has left it."""

from http import HTTPStatus

from sqlalchemy import select
from sqlalchemy.orm import Session

from app.domain.models import Report, Run, RunKind, RunStatus
from app.domain.preferences import LabelEvent, Query
from app.domain.studies import Participant, Study
from app.errors import AppError
from app.storage import ArtefactStore

VERSION = 11
"""Of the contents of a report. An older one is not shown but made again: numbers in it were computed otherwise."""

FORMATS = {"svg": "image/svg+xml", "png": "image/png"}


class FigureNotFound(AppError):
    """There is no such figure. A newer report may have replaced it; the page of results shows what there is."""

    status = HTTPStatus.NOT_FOUND


def newest(session: Session, study: Study) -> Report | None:
    """The report to show; None before the first of this version."""
    report = _last(session, study)
    return report if report is not None and _is_current(report) else None


def is_outdated(session: Session, study: Study) -> bool:
    """Whether there is a report, but of an earlier version."""
    report = _last(session, study)
    return report is not None and not _is_current(report)


def is_awaited(session: Session, study: Study) -> bool:
    """Whether the first report, or the first of this version, is on its way: there are answers, and nothing failed."""
    people = select(Participant.id).where(Participant.study_id == study.id, Participant.is_preview.is_(False))
    answered = select(LabelEvent.id).join(Query).where(Query.participant_id.in_(people)).limit(1)
    run = run_in_hand(session, study)
    failed = run is not None and run.status == RunStatus.FAILED
    if failed or study.put_away_at is not None or newest(session, study) is not None:
        return False
    return session.scalar(answered) is not None


def figure(session: Session, store: ArtefactStore, study: Study, name: str, kind: str) -> bytes:
    """One figure of the newest report. Raises FigureNotFound."""
    report = newest(session, study)
    sha256 = report.figures.get(name, {}).get(kind) if report is not None else None
    if sha256 is None or not store.has(sha256):
        raise FigureNotFound
    return store.read(sha256)


def run_in_hand(session: Session, study: Study) -> Run | None:
    """The run that makes a newer report, or the failure that keeps it from being made."""
    run = session.scalar(
        select(Run).where(Run.study_id == study.id, Run.kind == RunKind.REPORT).order_by(Run.id.desc()).limit(1)
    )
    return run if run is not None and run.status != RunStatus.SUCCEEDED else None


def _last(session: Session, study: Study) -> Report | None:
    return session.scalar(select(Report).where(Report.study_id == study.id).order_by(Report.id.desc()).limit(1))


def _is_current(report: Report) -> bool:
    return bool(report.contents.get("version") == VERSION)
