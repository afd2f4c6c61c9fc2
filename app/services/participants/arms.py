"""Arms of a study between subjects: who comes into which, by minimisation on completions.

Somebody who arrives (has agreed, and passed the questions at the start) comes into the open arm with the fewest people
who have completed it or are on their way through it; a lot decides between arms that are level (Pocock and Simon 1975,
Biometrics 31, 103, with the arm alone as factor and certainty for the arm that is behind). Who has been silent for ten
minutes has left in most cases, or comes back another day, and only decides between arms that are level otherwise. Who
has given no sign for as long as the study says is not on their way at all, so that the next one replaces them; should
they come back, they count again. An arm is open unless it has been stopped or as many as its quota have completed it or
are about to. The lot follows from the study's secret and the participant's number, and is kept with the counts, so that
it can be drawn again after unblinding. How far apart completed arms come: docs/results/arms.md.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime, timedelta

from sqlalchemy import case, func, select
from sqlalchemy.orm import Session

from app.db import now
from app.domain.participation import Allocation
from app.domain.studies import Participant, Study
from app.domain.study_settings import StudySettings
from app.services.evaluation import evaluation_plan

SILENT_AFTER = timedelta(minutes=10)
_DIGITS = 13
"""Hexadecimal ones of a lot: all that a float holds."""


@dataclass(frozen=True)
class Load:
    """People of one arm."""

    completed: int
    on_their_way: int
    open: bool
    silent: int = 0
    """of those on their way"""

    @property
    def expected(self) -> int:
        """How many will have completed it if nobody else drops out."""
        return self.completed + self.on_their_way

    @property
    def rank(self) -> tuple[int, int]:
        """The arm with the smallest is next."""
        return self.expected - self.silent, self.silent


def choose(loads: Mapping[str, Load], lot: float) -> str | None:
    """The arm of the next person; None where no arm is open. ``lot`` in [0, 1)."""
    open_arms = {name: load.rank for name, load in loads.items() if load.open}
    behind = [name for name, rank in open_arms.items() if rank == min(open_arms.values())]
    return behind[int(lot * len(behind))] if behind else None


def is_open(settings: StudySettings, name: str, expected: int) -> bool:
    """Whether an arm takes somebody in, with so many who have completed it or are about to."""
    return name not in settings.stopped_arms and (settings.arm_quota == 0 or expected < settings.arm_quota)


def loads(session: Session, study: Study, moment: datetime) -> Mapping[str, Load]:
    """People of every arm, in the order of the settings; previews and those who withdrew are nobody."""
    settings = study.settings
    seen = Participant.last_seen_at > moment - timedelta(minutes=settings.arm_away_minutes)
    done = Participant.completed_at.is_not(None)
    coming = ~done & seen & Participant.ended_as.is_(None)
    silent = coming & (Participant.last_seen_at <= moment - SILENT_AFTER)
    counted = (
        select(Participant.arm, *(func.sum(case((each, 1), else_=0)) for each in (done, coming, silent)))
        .where(Participant.study_id == study.id, Participant.is_preview.is_(False), Participant.withdrawn_at.is_(None))
        .group_by(Participant.arm)
    )
    found = {arm: numbers for arm, *numbers in session.execute(counted)}
    counts = {each.name: found.get(each.name, (0, 0, 0)) for each in settings.arms}
    return {
        name: Load(completed, coming, is_open(settings, name, completed + coming), silent)
        for name, (completed, coming, silent) in counts.items()
    }


def lot_of(study: Study, number: int) -> float:
    """What decides for the participant of this number where arms are level, in [0, 1)."""
    drawn = int(evaluation_plan.mark(study.key_secret, "arm", number)[:_DIGITS], 16)
    return float(drawn / 16**_DIGITS)


def allocate(session: Session, study: Study, participant: Participant) -> bool:
    """Give the participant an arm, for good; False where none is open. Doing it again changes nothing."""
    session.scalar(select(Study.id).where(Study.id == study.id).with_for_update())  # one at a time
    session.refresh(participant, ["arm"])
    if participant.arm is not None:
        return True
    found, lot = loads(session, study, now()), lot_of(study, participant.number)
    arm = choose(found, lot)
    if arm is None:
        return False
    same = Participant.study_id == study.id, Participant.arm == arm, Participant.is_preview.is_(participant.is_preview)
    places = select(func.max(Allocation.place)).join(Participant, Participant.id == Allocation.participant_id)
    considered = {name: {**vars(load)} for name, load in found.items()}
    place = (session.scalar(places.where(*same)) or 0) + 1
    session.add(Allocation(participant_id=participant.id, place=place, lot=lot, considered=considered))
    participant.arm = arm
    session.flush()
    return True
