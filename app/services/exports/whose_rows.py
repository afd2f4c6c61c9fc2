"""Whose rows there are, in which order: what every table about people has in common."""

from collections.abc import Iterator, Sequence
from typing import TypeVar

from sqlalchemy import select
from sqlalchemy.orm import Session

from app.domain.participation import Allocation, ConsentRecord, ParticipantEvent, StageRecord
from app.domain.studies import Participant, Study
from app.services.exports.paging import EVERYTHING, Window

_OfPerson = TypeVar("_OfPerson", Allocation, ConsentRecord, ParticipantEvent, StageRecord)


def everybody(session: Session, study: Study, window: Window = EVERYTHING) -> Sequence[Participant]:
    """Everybody in the study by number, tombstones included; previews are nobody."""
    people = select(Participant).where(Participant.study_id == study.id, Participant.is_preview.is_(False))
    people = people.where(window.reaches(Participant.number), window.known(Participant))
    return session.scalars(people.order_by(Participant.number)).all()


def present(session: Session, study: Study, window: Window) -> Iterator[tuple[Participant, Window]]:
    """Everybody who has not withdrawn, each with what is wanted of their rows; their number begins their keys."""
    for person in everybody(session, study, window):
        if person.withdrawn_at is None:
            yield person, window.within(person.number)


def rows_of_each(
    session: Session, study: Study, window: Window, table: type[_OfPerson]
) -> Iterator[tuple[Participant, _OfPerson]]:
    """The wanted rows of a table whose rows belong to one person each, in the order in which they came."""
    for person, wanted in present(session, study, window):
        rows = select(table).where(table.participant_id == person.id, wanted.beyond(table.id), wanted.known(table))
        for row in session.scalars(rows.order_by(table.id)):
            yield person, row
