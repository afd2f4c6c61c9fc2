"""Answers to the questions of forms and standard questionnaires: append-only, the newest of a question counts."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from sqlalchemy import ColumnElement, select, true
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


@dataclass(frozen=True)
class FilledIn:
    """One standard questionnaire as one person has filled it in, about one robot or about none."""

    instrument: Instrument
    letter: str | None
    answers: Mapping[str, float | None]
    """By item, as they were given; None: left out."""

    @property
    def scores(self) -> Mapping[str, float | None]:
        """By name, by the scoring key; None where too much was left out."""
        return {each.name: self.instrument.score(each, self.answers) for each in self.instrument.scores}


def filled_in(session: Session, participant_id: int, which: ColumnElement[bool] | None = None) -> Sequence[FilledIn]:
    """Every standard questionnaire that somebody has sent, in a fixed order. ``which``: of these rows only."""
    rows = select(FormAnswer).where(
        FormAnswer.participant_id == participant_id,
        true() if which is None else which,
        FormAnswer.form.in_(library.every()),
    )
    found: dict[tuple[str, str], dict[str, float | None]] = {}
    for row in session.scalars(rows.order_by(FormAnswer.id)):
        possible = row.value in library.every()[row.form].answers.points
        found.setdefault((row.letter or "", row.form), {})[row.item] = float(row.value or 0) if possible else None
    return [
        FilledIn(library.every()[form], letter or None, answers)
        for (letter, form), answers in sorted(found.items(), key=lambda each: each[0])
    ]


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
