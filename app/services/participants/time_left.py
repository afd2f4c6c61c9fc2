"""How long a participant still needs for everything that comes: pairs, breaks, robots, last questions, debrief.

Pairs at the person's own pace; what comes after by the median of those who went before in the same study.
"""

from collections import defaultdict
from dataclasses import dataclass
from statistics import median

from sqlalchemy import select
from sqlalchemy.orm import Session

from app.domain.participation import ParticipantEvent, StageRecord
from app.domain.protocol import Stage
from app.domain.studies import Participant
from app.domain.study_settings import StudySettings
from app.services.answers.next_query import LONGEST_PAUSE, PairProgress
from app.services.participant_events import EventKind
from app.services.participants import stages

LEAST_PEOPLE = 3
"""Who must have gone before so that a stage's time is known."""
RECENT = 90
"""Rows looked at, the newest."""
_AFTER_PAIRS = (Stage.EVALUATION, Stage.QUESTIONNAIRE, Stage.DEBRIEF)
CONTROL_RATE_HZ = 10


@dataclass(frozen=True)
class TimeLeft:
    """What is known of the time that is left."""

    seconds: int
    is_all: bool
    """False: only of the comparing; nobody knows yet how long what comes afterwards takes."""


def time_left(session: Session, participant: Participant, progress: PairProgress) -> TimeLeft | None:
    """None while the person's pace is not known. The study is loaded."""
    if progress.pace_s is None:
        return None
    study = participant.study
    pairs_s = _pairs_s(progress, study.settings, study.whole_clip_steps) + _breaks_s(session, participant, progress)
    later = [stage for stage in stages.stages_of(study.settings) if stage in _AFTER_PAIRS]
    usual = _usual_s(session, participant) if later else {}
    known = all(stage in usual for stage in later)
    return TimeLeft(round(pairs_s + (sum(usual[stage] for stage in later) if known else 0.0)), known)


def _pairs_s(progress: PairProgress, settings: StudySettings, whole_clip_steps: int | None) -> float:
    """Whole episodes come first and play longer than what follows; the pace is that of what was answered last."""
    pace_s, left = progress.pace_s or 0.0, progress.wanted - progress.answered
    whole = max(0, settings.introduction_count - progress.answered)
    shorter_s = ((whole_clip_steps or settings.clip_steps) - settings.clip_steps) / CONTROL_RATE_HZ
    after_s = pace_s - shorter_s if whole and pace_s > shorter_s else pace_s
    return whole * pace_s + (left - whole) * after_s


def _breaks_s(session: Session, participant: Participant, progress: PairProgress) -> float:
    """Breaks still to come, at the median of those that this study's participants took; nothing while none is known."""
    every = participant.study.settings.break_every
    coming = (progress.wanted - 1) // every - progress.answered // every if every else 0
    if coming < 1:
        return 0.0
    events = session.execute(
        select(ParticipantEvent.participant_id, ParticipantEvent.kind, ParticipantEvent.at, ParticipantEvent.detail)
        .join(Participant)
        .where(
            Participant.study_id == participant.study_id,
            ParticipantEvent.kind.in_((EventKind.BREAK_BEGUN, EventKind.BREAK_OVER)),
        )
        .order_by(ParticipantEvent.id.desc())
        .limit(RECENT)
    ).all()
    begun = {
        (row.participant_id, row.detail.get("answered")): row.at for row in events if row.kind == EventKind.BREAK_BEGUN
    }
    taken = [
        (row.at - begun[row.participant_id, row.detail.get("answered")]).total_seconds()
        for row in events
        if row.kind == EventKind.BREAK_OVER and (row.participant_id, row.detail.get("answered")) in begun
    ]
    return coming * min(median(taken), LONGEST_PAUSE.total_seconds()) if taken else 0.0


def _usual_s(session: Session, participant: Participant) -> dict[Stage, float]:
    """Median seconds of each stage after the pairs, of those stages that enough others are through with."""
    through = (
        select(StageRecord.stage, StageRecord.entered_at, StageRecord.finished_at)
        .join(Participant)
        .where(
            Participant.study_id == participant.study_id,
            Participant.id != participant.id,
            Participant.is_preview.is_(False),
            StageRecord.stage.in_(_AFTER_PAIRS),
            StageRecord.finished_at.is_not(None),
        )
    )
    seconds: dict[Stage, list[float]] = defaultdict(list)
    for row in session.execute(through.order_by(StageRecord.id.desc()).limit(RECENT)):
        seconds[Stage(row.stage)].append((row.finished_at - row.entered_at).total_seconds())
    return {stage: median(each) for stage, each in seconds.items() if len(each) >= LEAST_PEOPLE}
