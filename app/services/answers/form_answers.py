"""Answers to the questions of forms and standard questionnaires: append-only, the newest of a question counts."""

from collections.abc import Mapping, Sequence

from sqlalchemy import select
from sqlalchemy.orm import Session

from app.domain.participation import FormAnswer
from app.domain.studies import Participant
from app.questionnaires import library
from app.questionnaires.library import Instrument


def newest(session: Session, participant: Participant, form: str, letter: str | None = None) -> dict[str, str | None]:
    """The newest answer to every question that was put; None where it was left out.

    ``letter``: the robot that it is about, None: about none.
    """
    given = select(FormAnswer).where(
        FormAnswer.participant_id == participant.id, FormAnswer.form == form, FormAnswer.letter == letter
    )
    return {answer.item: answer.value for answer in session.scalars(given.order_by(FormAnswer.id))}


def append(
    session: Session, participant: Participant, form: str, values: Mapping[str, str | None], letter: str | None = None
) -> None:
    """Keep what differs from the answers so far."""
    known = newest(session, participant, form, letter)
    for item, value in values.items():
        if item not in known or known[item] != value:
            session.add(FormAnswer(participant_id=participant.id, form=form, item=item, value=value, letter=letter))
    session.flush()


def is_given(session: Session, participant: Participant, instrument: Instrument, letter: str | None = None) -> bool:
    """Whether a standard questionnaire has been sent; each of its items may have been left out."""
    known = newest(session, participant, instrument.name, letter)
    return all(item.name in known for item in instrument.items)


def first_open(
    session: Session, participant: Participant, names: Sequence[str], letter: str | None = None
) -> Instrument | None:
    """The first of these questionnaires that has not been sent."""
    wanted = (library.every()[name] for name in names)
    return next((each for each in wanted if not is_given(session, participant, each, letter)), None)
