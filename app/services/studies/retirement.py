"""What becomes of a study that is over: put away, taken out again, or deleted for good."""

from http import HTTPStatus

from sqlalchemy.orm import Session

from app.db import now
from app.domain.studies import Study
from app.errors import AppError
from app.services import audit
from app.services.participants import withdrawal
from app.storage import ArtefactStore


class StudyPutAway(AppError):
    """This study is closed at the moment. What you have answered is kept. Please ask the people who invited you."""

    status = HTTPStatus.GONE


class StudyDeleted(AppError):
    """This study is over, and everything about the people who took part has been erased. You can close this page."""

    status = HTTPStatus.GONE


class DeletionNotConfirmed(AppError):
    """What was typed is not the short name of this study. Nothing was deleted."""

    status = HTTPStatus.UNPROCESSABLE_ENTITY


def put_away(session: Session, study: Study, actor: str) -> None:
    """Out of the list and out of work; nothing is deleted. Doing it again changes nothing."""
    if study.put_away_at is None:
        study.put_away_at = now()
        audit.record(session, actor, "study put away", study.slug, study=study)


def take_out(session: Session, study: Study, actor: str) -> None:
    """Back into the list and to work. Doing it again changes nothing."""
    if study.put_away_at is not None:
        study.put_away_at = None
        audit.record(session, actor, "study taken out again", study.slug, study=study)


def delete(session: Session, store: ArtefactStore, study: Study, typed: str, actor: str) -> None:
    """Erase the study and everybody in it, when its short name was typed. Raises NotConfirmed.

    What the worker keeps for itself it erases when it finds ``deleted_at`` without ``erased_at``.
    """
    if typed.strip() != study.slug:
        raise DeletionNotConfirmed
    study.deleted_at = now()
    withdrawal.erase_study(session, store, study)
    audit.record(session, actor, "study deleted", study.slug)  # by now that is its number
