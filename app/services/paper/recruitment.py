"""Who came, who was sent back, who stayed: the numbers of a CONSORT diagram, and who these people were.

Previews are nobody. Of somebody who has withdrawn only that is known: when, and nothing they did.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime

from sqlalchemy import select
from sqlalchemy.orm import Session

from app.domain.designs import Ending
from app.domain.studies import Participant, Study
from app.services.evaluation import unblinding


@dataclass(frozen=True)
class Flow:
    """Numbers of people; those who withdrew are counted in ``withdrawn`` alone."""

    invited: int
    """All: everybody who got a link or came by the open address."""
    withdrawn: int
    not_consented: int
    consented: int
    ended: Mapping[Ending, int]
    """Sent back before the end, by reason."""
    unfinished: int
    """Consented, not sent back, and not at the end: dropped out, or still on their way."""
    completed: int
    scripted: int
    """Of all, those whom a program played."""
    from_panel: int
    first_consent: datetime | None
    last_completion: datetime | None


def flow_of(session: Session, study: Study) -> Flow:
    """Of the whole study."""
    return _flow(_people(session, study))


def flow_by_arm(session: Session, study: Study) -> Mapping[str, Flow]:
    """Of every arm, in the order of the settings; empty within subjects, and while the study is blinded."""
    if unblinding.is_blinded(study):
        return {}
    people = _people(session, study)
    return {arm.name: _flow([each for each in people if each.arm == arm.name]) for arm in study.settings.arms}


def _people(session: Session, study: Study) -> Sequence[Participant]:
    people = select(Participant).where(Participant.study_id == study.id, Participant.is_preview.is_(False))
    return session.scalars(people.order_by(Participant.number)).all()


def _flow(people: Sequence[Participant]) -> Flow:
    present = [each for each in people if each.withdrawn_at is None]
    consented = [each for each in present if each.consented_at is not None]
    ended = Counter(Ending(each.ended_as) for each in consented if each.ended_as and each.completed_at is None)
    completed = [each for each in consented if each.completed_at is not None]
    return Flow(
        invited=len(people),
        withdrawn=len(people) - len(present),
        not_consented=len(present) - len(consented),
        consented=len(consented),
        ended={ending: ended[ending] for ending in Ending},
        unfinished=len(consented) - len(completed) - ended.total(),
        completed=len(completed),
        scripted=sum(each.scripted_as is not None for each in people),
        from_panel=sum(each.panel_id is not None for each in present),
        first_consent=min((each.consented_at for each in consented if each.consented_at), default=None),
        last_completion=max((each.completed_at for each in completed if each.completed_at), default=None),
    )
