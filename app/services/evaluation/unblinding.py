"""Who may know which letter hides which method: nobody, until somebody unblinds the study on purpose."""

from collections.abc import Sequence
from dataclasses import dataclass
from http import HTTPStatus

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from app.db import now
from app.domain.evaluation import Assignment, HeadToHead, HeadToHeadAnswer, Rating, Trial
from app.domain.protocol import EvaluatedMethod
from app.domain.studies import Participant, Study
from app.errors import AppError
from app.services import audit

NAMES = {
    EvaluatedMethod.REFERENCE: "pre-trained policy",
    EvaluatedMethod.PREFFT: "PrefFT",
    EvaluatedMethod.PREFFT_ANCHORED: "PrefFT, anchored",
    EvaluatedMethod.PBARL: "PbARL",
    EvaluatedMethod.PBARL_PRINTED: "PbARL as printed",
    EvaluatedMethod.SOMEBODY_ELSE: "somebody else's filter",
    EvaluatedMethod.AVERAGE: "average filter",
    EvaluatedMethod.SELF_SET: "set by the person",
}
"""What people call the methods, once they may know."""


class ConfirmationDiffers(AppError):
    """What you typed is not the short name of the study. Nothing was unblinded."""

    status = HTTPStatus.UNPROCESSABLE_ENTITY


class NothingToUnblind(AppError):
    """This study has no blinded evaluation."""

    status = HTTPStatus.NOT_FOUND


class StillBlinded(AppError):
    """This study is blinded: which letter is which method is shown after somebody has unblinded it."""

    status = HTTPStatus.FORBIDDEN


def is_blinded(study: Study) -> bool:
    """Whether letters must stand for methods wherever people look."""
    return study.settings.evaluation is not None and study.unblinded_at is None


def unblind(session: Session, study: Study, typed: str, actor: str) -> None:
    """Unblind for good; ``typed`` must be the study's slug. Doing it again changes nothing.

    Raises NothingToUnblind and ConfirmationDiffers.
    """
    if study.settings.evaluation is None:
        raise NothingToUnblind
    if typed.strip() != study.slug:
        raise ConfirmationDiffers
    if study.unblinded_at is None:
        study.unblinded_at = now()
        there_are = ", ".join(map(str, answers(session, study)))
        audit.record(session, actor, "study unblinded", f"{study.slug} ({there_are or 'nobody there'})", study=study)


@dataclass(frozen=True)
class Answers:
    """How many answers about blinded robots there are, of how many: what unblinding too early would spoil."""

    given: int
    wanted: int
    what: str

    def __str__(self) -> str:
        return f"{self.given} of {self.wanted} {self.what}"


def answers(session: Session, study: Study) -> Sequence[Answers]:
    """Of trials and, where there are any, of head-to-heads."""
    settings = study.settings
    those = (
        Participant.study_id == study.id,
        Participant.is_preview.is_(False),
        Participant.withdrawn_at.is_(None),
        Participant.ended_as.is_(None),
    )
    arms = session.execute(select(Participant.arm, func.count(Participant.id)).where(*those).group_by(Participant.arm))
    meant = [(people, each) for arm, people in arms if (each := settings.in_arm(arm).evaluation)]
    rated = select(func.count(func.distinct(Rating.trial_id))).join(Trial)
    rated = rated.join(Participant, Participant.id == Trial.participant_id).where(*those)
    compared = select(func.count(func.distinct(HeadToHeadAnswer.head_to_head_id))).join(HeadToHead)
    compared = compared.join(Participant, Participant.id == HeadToHead.participant_id).where(*those)
    found = (
        (rated, sum(people * each.trial_count for people, each in meant), "trials rated"),
        (compared, sum(people * each.head_to_head_count for people, each in meant), "head-to-heads answered"),
    )
    return [Answers(session.scalar(given) or 0, wanted, what) for given, wanted, what in found if wanted]


def methods_by_letter(session: Session, study: Study) -> dict[tuple[int, str], str]:
    """Method by participant id and letter. Raises StillBlinded before the study is unblinded."""
    if is_blinded(study):
        raise StillBlinded
    return {(each.participant_id, each.letter): each.method for each in _assignments(session, study)}


def key_of(session: Session, study: Study) -> Sequence[tuple[str, dict[str, str]]]:
    """Per participant, by code, the method of each letter. Raises StillBlinded before the study is unblinded."""
    if is_blinded(study):
        raise StillBlinded
    people = select(Participant).where(Participant.study_id == study.id, Participant.is_preview.is_(False))
    people = people.order_by(Participant.number)
    by_person = {person.id: (person.code, dict[str, str]()) for person in session.scalars(people)}
    for each in _assignments(session, study):
        by_person[each.participant_id][1][each.letter] = each.method
    return [(code, dict(sorted(letters.items()))) for code, letters in by_person.values() if letters]


def shown_name(study: Study, assignments: Sequence[Assignment], letter: str) -> str:
    """What to call a robot on an experimenter's page: its letter, with its method once the study is unblinded."""
    if is_blinded(study):
        return letter
    method = next((each.method for each in assignments if each.letter == letter), None)
    return letter if method is None else f"{letter} ({method})"


def _assignments(session: Session, study: Study) -> Sequence[Assignment]:
    theirs = select(Assignment).join(Participant, Participant.id == Assignment.participant_id)
    return session.scalars(theirs.where(Participant.study_id == study.id, Participant.is_preview.is_(False))).all()
