"""Return visits: one study goes on from another, and whoever has finished that comes back with what they answered.

Each visit is a study with settings, evaluation and results of its own, in which nobody counts twice. The person is a
participant of both, who knows which they were before (Participant.earlier_id): the worker learns from all of it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from http import HTTPStatus

from sqlalchemy import select
from sqlalchemy.orm import Session, joinedload

from app.db import now
from app.domain.people import Experimenter, Role, StudyMember, StudyRole
from app.domain.studies import Participant, Study
from app.errors import AppError
from app.services.participants import enrolment


class NoVisitYet(AppError):
    """There is no further visit for you yet. Please come back later; your answers are kept."""

    status = HTTPStatus.CONFLICT


@dataclass(frozen=True)
class NextVisit:
    """The visit for which somebody may come back."""

    study: Study
    opens_at: datetime

    @property
    def is_open(self) -> bool:
        """Whether they may come now."""
        return self.opens_at <= now()


def earlier_study(session: Session, study: Study) -> Study | None:
    """The study of the visit before; None where there is none, or where this one has no right to its people.

    Settings travel with archives, so the name alone gives nobody a right to another study's people.
    """
    slug = study.settings.goes_on_from
    named = select(Study).where(Study.slug == slug, Study.deleted_at.is_(None), Study.id < study.id)
    earlier = session.scalar(named) if slug else None
    if earlier is None or not fits(earlier, study.task) or study.material is not None:
        return None
    return earlier if _have_same_owners(session, study, earlier) else None


def fits(earlier: Study, task: str) -> bool:
    """Whether a study of this task can go on from it: a model learns from one kind of signals."""
    return earlier.task == task and earlier.material is None


def next_visit(session: Session, participant: Participant) -> NextVisit | None:
    """For what somebody who has finished may come back, now or later; None: for nothing. The study is loaded."""
    if participant.completed_at is None or participant.ended_as is not None or participant.is_preview:
        return None
    later = select(Study).where(Study.id > participant.study_id, Study.deleted_at.is_(None))
    for study in session.scalars(later.where(Study.put_away_at.is_(None)).order_by(Study.id)):
        if study.stored_settings.get("goes_on_from") != participant.study.slug:
            continue
        if earlier_study(session, study) is participant.study:
            pause = timedelta(days=study.settings.days_between_visits)
            return NextVisit(study, participant.completed_at + pause)
    return None


def begin(session: Session, participant: Participant) -> Participant:
    """Come back for the next visit; twice is once. The study is loaded. Raises NoVisitYet."""
    session.scalar(select(Participant.id).where(Participant.id == participant.id).with_for_update())  # one at a time
    known = newest(session, participant)
    if known is not participant:
        return known
    visit = next_visit(session, participant)
    if visit is None or not visit.is_open:
        raise NoVisitYet
    return enrolment.add_returning(session, visit.study, participant)


def newest(session: Session, participant: Participant) -> Participant:
    """Who somebody is at their last visit so far, study loaded."""
    later = select(Participant).where(Participant.earlier_id == participant.id, Participant.withdrawn_at.is_(None))
    found = session.scalar(later.options(joinedload(Participant.study)))
    return participant if found is None else newest(session, found)


def before(session: Session, participant_id: int) -> Sequence[int]:
    """Ids of who somebody was at the visits before, the first one first."""
    earlier = session.scalar(select(Participant.earlier_id).where(Participant.id == participant_id))
    return [] if earlier is None else [*before(session, earlier), earlier]


def everyone_they_were(session: Session, participant: Participant) -> Sequence[Participant]:
    """The same person at every visit, the last one first."""
    last = newest(session, participant)
    return [last, *(session.get_one(Participant, each) for each in reversed(before(session, last.id)))]


def known_to_panel(session: Session, study: Study, panel_id: str) -> Participant | None:
    """Who has finished the visit before under this id of the panel, and has not come back yet. Raises NoVisitYet."""
    earlier = earlier_study(session, study)
    if earlier is None:
        return None
    theirs = select(Participant).where(Participant.study_id == earlier.id, Participant.panel_id == panel_id)
    known = session.scalar(theirs.options(joinedload(Participant.study)))
    if known is None or newest(session, known) is not known:
        return None
    visit = next_visit(session, known)
    if visit is not None and not visit.is_open:
        raise NoVisitYet
    return known if visit is not None and visit.study is study else None


def _have_same_owners(session: Session, study: Study, earlier: Study) -> bool:
    """Whether every owner of a study may change the earlier one, too."""
    owners = select(StudyMember.experimenter_id).where(
        StudyMember.study_id == study.id, StudyMember.role == StudyRole.OWNER
    )
    theirs = select(StudyMember.experimenter_id).where(
        StudyMember.study_id == earlier.id, StudyMember.role.in_([StudyRole.OWNER, StudyRole.EDITOR])
    )
    administrators = select(Experimenter.id).where(Experimenter.role == Role.ADMINISTRATOR)
    strangers = owners.where(
        StudyMember.experimenter_id.not_in(theirs), StudyMember.experimenter_id.not_in(administrators)
    )
    return session.scalar(strangers.limit(1)) is None
