"""How long a participant still needs for everything that comes: pairs, breaks, robots, last questions, debrief.

Pairs at the person's own pace; what comes after by the median of those who went before in the same study.
"""

import time
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from statistics import median

from sqlalchemy import bindparam, select
from sqlalchemy.orm import Session

from app.domain.participation import ParticipantEvent, StageRecord
from app.domain.protocol import Stage
from app.domain.studies import Participant, Study
from app.domain.study_settings import StudySettings
from app.installed_tasks.by_name import control_rate_hz
from app.services.answers.next_query import LONGEST_PAUSE, PairProgress
from app.services.participant_events import EventKind
from app.services.participants import stages

LEAST_PEOPLE = 3
"""Who must have gone before so that a stage's time is known."""
RECENT = 90
"""Rows looked at, the newest."""
KNOWN_FOR_S = 30.0
_AFTER_PAIRS = (Stage.SELF_SETTING, Stage.EVALUATION, Stage.QUESTIONNAIRE, Stage.DEBRIEF)


_BREAKS = (
    select(ParticipantEvent.participant_id, ParticipantEvent.kind, ParticipantEvent.at, ParticipantEvent.detail)
    .join(Participant)
    .where(
        Participant.study_id == bindparam("study_id"),
        ParticipantEvent.kind.in_((EventKind.BREAK_BEGUN, EventKind.BREAK_OVER)),
    )
    .order_by(ParticipantEvent.id.desc())
    .limit(RECENT)
)
_THROUGH = (
    select(StageRecord.stage, StageRecord.entered_at, StageRecord.finished_at)
    .join(Participant)
    .where(
        Participant.study_id == bindparam("study_id"),
        Participant.is_preview.is_(False),
        StageRecord.stage.in_(_AFTER_PAIRS),
        StageRecord.finished_at.is_not(None),
    )
    .order_by(StageRecord.id.desc())
    .limit(RECENT)
)


@dataclass(frozen=True)
class TimeLeft:
    """What is known of the time that is left."""

    seconds: int
    is_all: bool
    """False: only of the comparing; nobody knows yet how long what comes afterwards takes."""


@dataclass(frozen=True)
class Usual:
    """What went before in a study usually took."""

    break_s: float | None
    """None while nobody has taken one"""
    stages_s: Mapping[Stage, float]
    """Of the stages after the pairs that enough people are through with."""


class UsualTimes:
    """What stages and breaks usually take, by study: every answer needs it, and it changes with people. Any thread."""

    def __init__(self) -> None:
        self._known: dict[int, tuple[float, Usual]] = {}

    def of(self, session: Session, study_id: int) -> Usual:
        """Asked of the database when it was not known of late."""
        known = self._known.get(study_id)
        if known is None or time.monotonic() - known[0] > KNOWN_FOR_S:
            known = self._known[study_id] = (
                time.monotonic(),
                Usual(_usual_break_s(session, study_id), _usual_stages_s(session, study_id)),
            )
        return known[1]


def time_left(
    session: Session, participant: Participant, progress: PairProgress, usual_times: UsualTimes
) -> TimeLeft | None:
    """None while the person's pace is not known. The study is loaded."""
    if progress.pace_s is None:
        return None
    study, usual = participant.study, usual_times.of(session, participant.study_id)
    settings = study.settings
    seconds = _pairs_s(progress, study)
    seconds += _breaks_coming(progress, settings) * (usual.break_s or 0.0)
    later = [stage for stage in stages.stages_of(settings) if stage in _AFTER_PAIRS]
    known = all(stage in usual.stages_s for stage in later)
    return TimeLeft(round(seconds + (sum(usual.stages_s[stage] for stage in later) if known else 0.0)), known)


def _pairs_s(progress: PairProgress, study: Study) -> float:
    """Whole episodes come first and play longer than what follows; the pace is that of what was answered last."""
    settings = study.settings
    pace_s, left = progress.pace_s or 0.0, progress.wanted - progress.answered
    whole = max(0, settings.introduction_count - progress.answered)
    steps = (study.whole_clip_steps or settings.clip_steps) - settings.clip_steps
    shorter_s = steps / control_rate_hz(study.task)
    after_s = pace_s - shorter_s if whole and pace_s > shorter_s else pace_s
    return whole * pace_s + (left - whole) * after_s


def _breaks_coming(progress: PairProgress, settings: StudySettings) -> int:
    every = settings.break_every
    return max(0, (progress.wanted - 1) // every - progress.answered // every) if every else 0


def _usual_break_s(session: Session, study_id: int) -> float | None:
    """The median of the breaks that this study's participants took, the longest cut off."""
    events = session.execute(_BREAKS, {"study_id": study_id}).all()
    begun = {
        (row.participant_id, row.detail.get("answered")): row.at for row in events if row.kind == EventKind.BREAK_BEGUN
    }
    taken = [
        (row.at - begun[row.participant_id, row.detail.get("answered")]).total_seconds()
        for row in events
        if row.kind == EventKind.BREAK_OVER and (row.participant_id, row.detail.get("answered")) in begun
    ]
    return min(median(taken), LONGEST_PAUSE.total_seconds()) if taken else None


def _usual_stages_s(session: Session, study_id: int) -> Mapping[Stage, float]:
    """Median seconds of each stage after the pairs, of those stages that enough people are through with."""
    seconds: dict[Stage, list[float]] = defaultdict(list)
    for row in session.execute(_THROUGH, {"study_id": study_id}):
        seconds[Stage(row.stage)].append((row.finished_at - row.entered_at).total_seconds())
    return {stage: median(each) for stage, each in seconds.items() if len(each) >= LEAST_PEOPLE}
