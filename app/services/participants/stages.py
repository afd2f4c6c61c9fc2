"""Where a participant is on their way, and what comes next. Nobody skips ahead, and everybody may come back.

The way is never stored: it follows from what has been done. StageRecord only remembers when.
"""

from collections.abc import Sequence

from sqlalchemy import func, select
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from app.db import now
from app.domain.evaluation import HeadToHead, HeadToHeadAnswer, Rating, Trial
from app.domain.participation import StageRecord
from app.domain.preferences import LabelEvent, Purpose, Query
from app.domain.protocol import LETTERS, Stage
from app.domain.studies import Participant
from app.domain.study_settings import StudySettings
from app.services.answers import form_answers


def stages_of(settings: StudySettings) -> Sequence[Stage]:
    """The stages of a study, in order."""
    asked_for = {
        Stage.DEMOGRAPHICS: bool(settings.demographics),
        Stage.PRACTICE: settings.practice_pairs > 0,
        Stage.SELF_SETTING: settings.evaluation is not None and settings.evaluation.has_sliders,
        Stage.EVALUATION: settings.evaluation is not None,
        Stage.QUESTIONNAIRE: bool(settings.closing_form or settings.instruments),
        Stage.DEBRIEF: settings.debrief,
    }
    return [stage for stage in Stage if asked_for.get(stage, True)]


def current_stage(session: Session, participant: Participant) -> Stage | None:
    """The first stage that is not finished, remembering that it was entered; None when all are. The study is loaded."""
    stages = stages_of(participant.settings)
    records = _records(session, participant)
    current = next((stage for stage in stages if not _is_finished(session, participant, stage, records)), None)
    passed = stages if current is None else stages[: stages.index(current)]
    for stage in passed:
        if stage in records and records[stage].finished_at is None:
            records[stage].finished_at = now()
    if current is not None and current not in records:
        _enter(session, participant, current)
    return current


def reached(session: Session, participant: Participant, stage: Stage) -> bool:
    """Whether the participant is in this stage or through with it, so that its page may be shown (again)."""
    stages = stages_of(participant.settings)
    current = current_stage(session, participant)
    return stage in stages and (current is None or stages.index(stage) <= stages.index(current))


def finish(session: Session, participant: Participant, stage: Stage) -> None:
    """Note that the participant is through with a stage they are in; doing it twice, or too early, changes nothing.

    Stages that are finished by what was given (consent, pairs, ratings) finish by themselves.
    """
    if current_stage(session, participant) != stage:
        return
    if stage is Stage.INSTRUCTIONS:
        participant.instructed_at = now()
    _records(session, participant)[stage].finished_at = now()


def _is_finished(session: Session, participant: Participant, stage: Stage, records: dict[Stage, StageRecord]) -> bool:
    settings = participant.settings
    match stage:
        case Stage.CONSENT:
            agreed = participant.consented_at is not None
            return agreed and participant.consent_version == settings.consent_version
        case Stage.INSTRUCTIONS:
            return participant.instructed_at is not None
        case Stage.PRACTICE:
            return _answered(session, participant, [Purpose.PRACTICE]) >= settings.practice_pairs
        case Stage.PAIRS:
            return _answered(session, participant, set(Purpose) - {Purpose.PRACTICE}) >= settings.question_count
        case Stage.EVALUATION:
            return settings.evaluation is None or (
                _rated(session, participant) >= settings.evaluation.trial_count
                and _compared(session, participant) >= settings.evaluation.head_to_head_count
                and all(
                    form_answers.first_open(session, participant, settings.evaluation.instruments, letter) is None
                    for letter in LETTERS[: len(settings.evaluation.methods)]
                )
            )
        case Stage.DEMOGRAPHICS | Stage.SELF_SETTING | Stage.QUESTIONNAIRE | Stage.DEBRIEF:
            return stage in records and records[stage].finished_at is not None


def _answered(session: Session, participant: Participant, purposes: Sequence[Purpose] | set[Purpose]) -> int:
    """How many pairs have an answer that has not been taken back."""
    newest = (
        select(LabelEvent.response)
        .where(LabelEvent.query_id == Query.id)
        .order_by(LabelEvent.revision.desc())
        .limit(1)
        .scalar_subquery()
    )
    answered = select(func.count(Query.id)).where(
        Query.participant_id == participant.id, Query.purpose.in_(list(purposes)), newest.is_not(None)
    )
    return session.scalar(answered) or 0


def _rated(session: Session, participant: Participant) -> int:
    rated = select(func.count(func.distinct(Rating.trial_id))).join(Trial).where(Trial.participant_id == participant.id)
    return session.scalar(rated) or 0


def _compared(session: Session, participant: Participant) -> int:
    given = select(func.count(func.distinct(HeadToHeadAnswer.head_to_head_id))).join(HeadToHead)
    return session.scalar(given.where(HeadToHead.participant_id == participant.id)) or 0


def _records(session: Session, participant: Participant) -> dict[Stage, StageRecord]:
    theirs = select(StageRecord).where(StageRecord.participant_id == participant.id)
    return {Stage(record.stage): record for record in session.scalars(theirs)}


def _enter(session: Session, participant: Participant, stage: Stage) -> None:
    try:
        with session.begin_nested():
            session.add(StageRecord(participant_id=participant.id, stage=stage))
    except IntegrityError:
        return  # another request of the same person was first
