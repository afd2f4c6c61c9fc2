"""How every study is going, in one word, for the list of studies."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from app.domain.participation import StageRecord
from app.domain.protocol import Stage
from app.domain.studies import Participant
from app.services.monitoring.dashboard import StudySummary


class StudyState(StrEnum):
    """The first that is true."""

    ATTENTION = "attention"
    """Work for it has failed for good."""
    PREPARING = "preparing"
    """Nobody has begun, and clips are still being made."""
    WAITING = "waiting"
    """Everything is ready, and nobody has begun."""
    FINISHED = "finished"
    EVALUATING = "evaluating"
    """Whoever has begun and is not through rates robots."""
    RUNNING = "running"


@dataclass(frozen=True)
class StudyStanding:
    """The state of a study with its numbers; who has withdrawn is in none of them."""

    state: StudyState
    finished: int
    people: int


def standings(session: Session, lines: Sequence[StudySummary]) -> Mapping[int, StudyStanding]:
    """By the study's id; a few queries for all studies together."""
    present = Participant.is_preview.is_(False) & Participant.withdrawn_at.is_(None)
    counted = session.execute(
        select(Participant.study_id, func.count(), func.count(Participant.consented_at))
        .where(present)
        .group_by(Participant.study_id)
    )
    people = {study_id: (count, begun) for study_id, count, begun in counted}
    rating = session.execute(
        select(Participant.study_id, func.count())
        .join(StageRecord, StageRecord.participant_id == Participant.id)
        .where(present, StageRecord.stage == Stage.EVALUATION, StageRecord.finished_at.is_(None))
        .group_by(Participant.study_id)
    )
    at_robots = dict(rating.all())
    return {
        line.study.id: _standing(line, *people.get(line.study.id, (0, 0)), at_robots.get(line.study.id, 0))
        for line in lines
    }


def _standing(line: StudySummary, people: int, begun: int, rating: int) -> StudyStanding:
    if line.failed:
        state = StudyState.ATTENTION
    elif not begun:
        state = StudyState.PREPARING if line.clips < line.clips_wanted else StudyState.WAITING
    elif line.finished >= people:
        state = StudyState.FINISHED
    elif rating and rating + line.finished >= begun:
        state = StudyState.EVALUATING
    else:
        state = StudyState.RUNNING
    return StudyStanding(state, line.finished, people)
