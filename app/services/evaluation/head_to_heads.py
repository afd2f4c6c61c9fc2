"""Head-to-heads: two robots side by side. Each is answered exactly once, and only when both were shown."""

from collections.abc import Sequence
from http import HTTPStatus
from uuid import UUID

from sqlalchemy import select
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session, joinedload

from app.domain.evaluation import HeadToHead, HeadToHeadAnswer, HeadToHeadResponse, Trial
from app.domain.studies import Participant
from app.errors import AppError


class HeadToHeadNotFound(AppError):
    """There are no such two robots for you to compare. Please go on with those you are shown."""

    status = HTTPStatus.NOT_FOUND


class HeadToHeadNotShown(AppError):
    """You have not seen these two robots yet. Please go on with those you are shown."""

    status = HTTPStatus.CONFLICT


class ComparedAlready(AppError):
    """You have answered about these two robots already, and that answer counts. The last one can still be changed."""

    status = HTTPStatus.CONFLICT


class ChangeTooLate(AppError):
    """Only the last answer can be changed, and this is an earlier one."""

    status = HTTPStatus.CONFLICT


class TiesNotAllowed(AppError):
    """In this study one of the two robots has to be chosen. Please choose left or right."""

    status = HTTPStatus.UNPROCESSABLE_ENTITY


class AnswerForOthers(AppError):
    """This answer was already given to two other robots. Please reload the page and answer again."""

    status = HTTPStatus.CONFLICT


def of_participant(session: Session, participant_id: int) -> Sequence[HeadToHead]:
    """The participant's head-to-heads in their order, with trials and films."""
    theirs = select(HeadToHead).where(HeadToHead.participant_id == participant_id).order_by(HeadToHead.ordinal)
    sides = (HeadToHead.left_trial, HeadToHead.right_trial)
    return session.scalars(theirs.options(*(joinedload(side).joinedload(Trial.film) for side in sides))).all()


def answers_of(session: Session, participant_id: int) -> dict[int, HeadToHeadAnswer]:
    """The answer that counts of each that has one, by the id of the head-to-head."""
    theirs = select(HeadToHeadAnswer).join(HeadToHead).where(HeadToHead.participant_id == participant_id)
    return {each.head_to_head_id: each for each in session.scalars(theirs.order_by(HeadToHeadAnswer.revision))}


def answer(
    session: Session,
    participant: Participant,
    head_to_head_id: int,
    response: HeadToHeadResponse,
    client_uuid: UUID,
    *,
    reason: str | None = None,
    corrects: int = 0,
    response_time_ms: int | None = None,
    by_script: bool = False,
) -> None:
    """Store one answer; sent again, it is the same one. The study is loaded.

    ``corrects``: how many answers there were on the page that is sent: 0 for a first one, else this is a correction.
    Raises HeadToHeadNotFound, HeadToHeadNotShown, ComparedAlready (another click was first, or an old page was sent
    again with another answer), ChangeTooLate, TiesNotAllowed and AnswerForOthers.
    """
    asked = _own(session, participant, head_to_head_id)
    settings = participant.study.settings.evaluation
    given = _given(session, asked)
    if _was_sent(session, asked, response, client_uuid):
        return
    if asked.shown_at is None:
        raise HeadToHeadNotShown
    if len(given) != corrects:
        raise ComparedAlready
    if given and not is_last(session, asked):
        raise ChangeTooLate
    if response is HeadToHeadResponse.EQUAL and settings is not None and not settings.head_to_head_ties:
        raise TiesNotAllowed
    row = HeadToHeadAnswer(
        head_to_head_id=asked.id,
        revision=corrects + 1,
        response=response,
        reason=reason if settings is not None and settings.ask_reasons else None,
        client_uuid=str(client_uuid),
        response_time_ms=response_time_ms,
        by_script=by_script,
    )
    try:
        with session.begin_nested():
            session.add(row)
    except IntegrityError as error:  # the unique constraints are the last judge
        if not _was_sent(session, asked, response, client_uuid):
            raise ComparedAlready from error


def find_answered(session: Session, participant: Participant, head_to_head_id: int) -> HeadToHeadAnswer:
    """The answer that counts, to be corrected. Raises HeadToHeadNotFound when there is none, and ChangeTooLate."""
    asked = _own(session, participant, head_to_head_id)
    given = _given(session, asked)
    if not given:
        raise HeadToHeadNotFound
    if not is_last(session, asked):
        raise ChangeTooLate
    return given[-1]


def is_last(session: Session, asked: HeadToHead) -> bool:
    """Whether no later one has an answer."""
    later = select(HeadToHeadAnswer.id).join(HeadToHead)
    later = later.where(HeadToHead.participant_id == asked.participant_id, HeadToHead.ordinal > asked.ordinal)
    return session.scalar(later.limit(1)) is None


def have_begun(session: Session, participant_id: int) -> bool:
    """Whether the participant has answered any, so that ratings are as they are."""
    given = select(HeadToHeadAnswer.id).join(HeadToHead).where(HeadToHead.participant_id == participant_id)
    return session.scalar(given.limit(1)) is not None


def _own(session: Session, participant: Participant, head_to_head_id: int) -> HeadToHead:
    mine = select(HeadToHead).where(HeadToHead.id == head_to_head_id, HeadToHead.participant_id == participant.id)
    asked = session.scalar(mine.with_for_update())  # SQLite: the whole database is already ours
    if asked is None:
        raise HeadToHeadNotFound
    return asked


def _given(session: Session, asked: HeadToHead) -> Sequence[HeadToHeadAnswer]:
    theirs = select(HeadToHeadAnswer).where(HeadToHeadAnswer.head_to_head_id == asked.id)
    return session.scalars(theirs.order_by(HeadToHeadAnswer.revision)).all()


def _was_sent(session: Session, asked: HeadToHead, response: HeadToHeadResponse, client_uuid: UUID) -> bool:
    """Whether this client's answer is stored already. Raises AnswerForOthers, and ComparedAlready if it was another."""
    known = session.scalar(select(HeadToHeadAnswer).where(HeadToHeadAnswer.client_uuid == str(client_uuid)))
    if known is None:
        return False
    if known.head_to_head_id != asked.id:
        raise AnswerForOthers
    if known.response != response:
        raise ComparedAlready
    return True
