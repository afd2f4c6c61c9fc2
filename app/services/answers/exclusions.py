"""Answers that are left out of learning and statistics, each with a reason.

Nothing is deleted by that: the answer stays in every export with the reason beside it, and can be taken in again.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from http import HTTPStatus

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from app.domain.preferences import Exclusion, LabelEvent, Query, is_excluded
from app.domain.studies import Participant, Study
from app.errors import AppError
from app.services import audit
from app.services.answers import answers

LONGEST_REASON = 500


class ExclusionReasonMissing(AppError):
    """Say why this answer is left out: the reason stands beside it in every export. Nothing was changed."""

    status = HTTPStatus.UNPROCESSABLE_ENTITY


@dataclass(frozen=True)
class Changed:
    """An answer that is left out now and was not at some moment, or the other way round."""

    participant: Participant
    word: Exclusion
    """By which it is as it is now."""


def exclude(session: Session, study: Study, query_id: int, reason: str, actor: str) -> None:
    """Leave an answer out. Doing it again changes nothing. Raises AnswerNotFound and ReasonMissing."""
    event = answers.counting_event(session, study, query_id)
    if not reason.strip():
        raise ExclusionReasonMissing
    _say(session, study, event, excluded=True, reason=reason.strip()[:LONGEST_REASON], actor=actor)


def include(session: Session, study: Study, query_id: int, actor: str) -> None:
    """Take an answer in again. Doing it again changes nothing. Raises AnswerNotFound."""
    event = answers.counting_event(session, study, query_id)
    _say(session, study, event, excluded=False, reason="", actor=actor)


def count(session: Session, study: Study) -> int:
    """How many answers of the study are left out."""
    left_out = select(func.count(LabelEvent.id)).where(LabelEvent.id.in_(answers.counting_ids(study)), is_excluded())
    return session.scalar(left_out) or 0


def changed_since(session: Session, study: Study, moment: datetime) -> Sequence[Changed]:
    """Answers that are left out now and were not then, or were and are not, in the order in which that was said."""
    rows = session.execute(
        select(Exclusion, Participant)
        .join(LabelEvent, LabelEvent.id == Exclusion.label_event_id)
        .join(Query, Query.id == LabelEvent.query_id)
        .join(Participant, Participant.id == Query.participant_id)
        .where(LabelEvent.id.in_(answers.counting_ids(study)))
        .order_by(Exclusion.id)
    )
    was_left_out: dict[int, bool] = {}
    newest: dict[int, Changed] = {}
    for word, participant in rows:
        if word.at <= moment:
            was_left_out[word.label_event_id] = word.excluded
        newest[word.label_event_id] = Changed(participant, word)
    changed = [each for event_id, each in newest.items() if each.word.excluded != was_left_out.get(event_id, False)]
    return sorted(changed, key=lambda each: each.word.id)


def _say(session: Session, study: Study, event: LabelEvent, *, excluded: bool, reason: str, actor: str) -> None:
    query = session.scalars(select(Query).where(Query.id == event.query_id).with_for_update()).one()  # one at a time
    known = session.scalar(
        select(Exclusion).where(Exclusion.label_event_id == event.id).order_by(Exclusion.id.desc()).limit(1)
    )
    if (known is not None and known.excluded) == excluded:
        return
    session.add(Exclusion(label_event_id=event.id, excluded=excluded, reason=reason, actor=actor))
    person = session.get_one(Participant, query.participant_id)
    action = "answer excluded" if excluded else "answer taken in again"
    audit.record(session, actor, action, f"{study.slug}/{person.code}/{query.ordinal}", participant=person)
