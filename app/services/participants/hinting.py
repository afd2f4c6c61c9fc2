"""Keeping the hints that participants give beside their answers, each set exactly once."""

from collections.abc import Collection
from http import HTTPStatus
from uuid import UUID

from sqlalchemy import select
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from app.domain.hints import HintEvent, newest_hints
from app.domain.protocol import Stage
from app.domain.studies import Participant
from app.errors import AppError
from app.services.answers import hint_offers, next_query
from app.services.participants import stages

MOST_REVISIONS = 100
"""Of one participant; a browser gone wild is stopped there."""


class HintsRefused(AppError):
    """These hints cannot be kept. Please reload the page and choose again."""

    status = HTTPStatus.UNPROCESSABLE_ENTITY


class HintsOver(AppError):
    """You have compared all pairs, so hints change nothing any more. Please go on with what you are shown."""

    status = HTTPStatus.CONFLICT


class HintsChangedTooOften(AppError):
    """Your hints were changed so often that no more is saved. Please go on with those you gave last."""

    status = HTTPStatus.CONFLICT


def save(session: Session, participant: Participant, given: Collection[str], client_uuid: UUID) -> None:
    """Keep these hints in the place of earlier ones; none: nothing special. Sent again, it is the same set.

    The study is loaded. Raises HintsRefused (unknown ones, too many, or two that contradict each other), HintsOver and
    HintsChangedTooOften.
    """
    session.scalar(select(Participant.id).where(Participant.id == participant.id).with_for_update())  # one at a time
    if _was_sent(session, participant, client_uuid):
        return
    shown = hint_offers.offered(participant)
    if not hint_offers.asks(participant.study) or not set(given) <= set(shown):
        raise HintsRefused
    if hint_offers.problem_of(participant, given) is not None:
        raise HintsRefused
    if stages.current_stage(session, participant) is not Stage.PAIRS:
        raise HintsOver
    newest = newest_hints(session, participant.id)
    revision = newest.revision + 1 if newest else 1
    if revision > MOST_REVISIONS:
        raise HintsChangedTooOften
    row = HintEvent(
        participant_id=participant.id,
        revision=revision,
        hints=" ".join(name for name in shown if name in given),
        offered=" ".join(shown),
        answered=next_query.answers_given(session, participant).count,
        client_uuid=str(client_uuid),
    )
    try:
        with session.begin_nested():
            session.add(row)
    except IntegrityError as error:  # the unique constraints are the last judge
        if not _was_sent(session, participant, client_uuid):
            raise HintsRefused from error


def _was_sent(session: Session, participant: Participant, client_uuid: UUID) -> bool:
    """Whether this very set is stored already. Raises HintsRefused for somebody else's."""
    known = session.scalar(select(HintEvent).where(HintEvent.client_uuid == str(client_uuid)))
    if known is not None and known.participant_id != participant.id:
        raise HintsRefused
    return known is not None
