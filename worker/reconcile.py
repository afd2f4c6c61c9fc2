"""What is missing or stale, asked of the database again and again: the answer is always the whole truth.

Nothing here is remembered between two rounds, so a lost message, a killed worker or a second worker cannot leave
anything undone or do it twice: each finding has one name, and work is started under that name at most once.
"""

from collections.abc import Collection, Iterator
from datetime import datetime, timedelta
from typing import NamedTuple

from sqlalchemy import Select, func, select
from sqlalchemy.orm import Session

from app.db import now
from app.domain.clips import Clip, Rollout
from app.domain.models import Run, RunKind, RunStatus
from app.domain.preferences import LEARNED_FROM, LabelEvent, Query, count_labels
from app.domain.studies import Participant, Study, StudySettings
from worker import export_work, film_work, method_work, report_work
from worker.clip_work import WHOLE
from worker.records import ATTEMPTS, LEASE, Job, next_queries

CLIPS_AHEAD = 2
"""Scenarios per study in the making at a time: enough to keep busy, few enough that studies share fairly."""

RETRY_AFTER = timedelta(seconds=10)


class _Attempted(NamedTuple):
    """What is to be known of a run here. Whole ones take their time to load, and there are thousands of them."""

    status: str
    attempt: int
    finished_at: datetime | None


def findings(session: Session) -> Iterator[tuple[Job, int]]:
    """Every run that should exist and does not, or must be tried again, with the number of its attempt."""
    known = session.execute(select(Run.workflow_id, Run.status, Run.attempt, Run.finished_at))
    runs = {name: _Attempted(status, attempt, finished) for name, status, attempt, finished in known}
    succeeded = {name for name, run in runs.items() if run.status == RunStatus.SUCCEEDED}
    for study in session.scalars(select(Study).order_by(Study.id)).all():
        jobs = (*_missing_clips(session, study), *_stale_models(session, study, succeeded))
        for job in (*jobs, *report_work.due(session, study), *export_work.due(session, study)):
            attempt = _attempt_due(runs.get(job.finding), now())
            if attempt is not None:
                yield job, attempt


def abandoned(session: Session, in_hand: Collection[str]) -> list[tuple[Job, int]]:
    """Runs that some worker began and of which nothing has been heard since, with the number of the attempt.

    ``in_hand``: findings that this worker is busy with itself; a machine under load may be late with a sign of life.
    """
    lost = select(Run).where(Run.status == RunStatus.RUNNING, Run.heartbeat_at < now() - LEASE)
    return [(job_of(run), run.attempt) for run in session.scalars(lost) if run.workflow_id not in in_hand]


def job_of(run: Run) -> Job:
    """What the run was begun for."""
    return Job(run.workflow_id, RunKind(run.kind), run.study_id, run.participant_id, run.label_count, run.label_hash)


def workflow_name(finding: str, attempt: int) -> str:
    """The engine's name for one attempt at a finding."""
    return f"{finding}#{attempt}"


def studies_with_answers(session: Session) -> list[Study]:
    """The simulated studies in which somebody has answered: their first retraining is not far."""
    answered = select(Participant.study_id).join(Query).join(LabelEvent)
    found = session.scalars(select(Study).where(Study.id.in_(answered)).order_by(Study.id))
    return [study for study in found if study.material is None]


def short_of_queries(session: Session) -> list[int]:
    """Participants who could soon run out of queries."""
    return [
        participant_id
        for study in session.scalars(select(Study)).all()
        for participant_id in _without_all_queries(session, study)
        if next_queries(session, participant_id, study.settings)[1] > 0
    ]


def _without_all_queries(session: Session, study: Study) -> list[int]:
    """Everybody who has not yet been given all their queries: in a study that is over, nobody."""
    settings = study.settings
    counted = _present_ids(study).outerjoin(Query).group_by(Participant.id)
    short = counted.having(func.count(Query.id) < settings.practice_pairs + settings.question_count)
    return list(session.scalars(short.order_by(Participant.id)))


def _present_ids(study: Study) -> Select[int]:
    """Everybody in the study who has not withdrawn."""
    return select(Participant.id).where(Participant.study_id == study.id, Participant.withdrawn_at.is_(None))


def _attempt_due(run: _Attempted | None, moment: datetime) -> int | None:
    if run is None:
        return 1
    if run.status == RunStatus.RETRY:
        return run.attempt
    failed_since = moment - (run.finished_at or moment)
    pause = RETRY_AFTER * max(1, run.attempt - 1)
    if run.status == RunStatus.FAILED and run.attempt <= ATTEMPTS and failed_since > pause:
        return run.attempt
    return None


def _missing_clips(session: Session, study: Study) -> list[Job]:
    """Clips of every scenario; of the first ones also whole episodes, as soon as they were rolled out."""
    if study.material is not None:
        return []  # brought along by the study
    settings, jobs = study.settings, []
    clips = _clips_by_scenario(session, study, settings.clip_steps)
    whole = _clips_by_scenario(session, study, study.whole_clip_steps)
    for index in range(settings.pool_scenarios):
        seed = scenario_seed(study.seed, index)
        if clips.get(seed, 0) < settings.behaviours_per_scenario:
            jobs.append(Job(f"clips/study-{study.id}/scenario-{seed}", RunKind.CLIPS, study.id))
        elif index < settings.introduction_scenarios and whole.get(seed, 0) < settings.behaviours_per_scenario:
            jobs.append(Job(f"clips/study-{study.id}/{WHOLE}-{seed}", RunKind.CLIPS, study.id))
    return jobs[:CLIPS_AHEAD]


def _clips_by_scenario(session: Session, study: Study, step_count: int | None) -> dict[int, int]:
    """How many clips of this length there are of each scenario."""
    counted = (
        select(Rollout.scenario, func.count(Clip.id))
        .join(Clip)
        .where(Rollout.study_id == study.id, Clip.step_count == step_count)
        .group_by(Rollout.scenario)
    )
    return dict(session.execute(counted).all())


def scenario_seed(study_seed: int, index: int) -> int:
    """The scenario at one place of a study's pool; far from those that filters are trained and evaluated on."""
    return 10_000_000 + study_seed % 90_000 * 1_000 + index


def _stale_models(session: Session, study: Study, succeeded: Collection[str]) -> list[Job]:
    jobs, settings = [], study.settings
    last_answers = _last_answers(session, study)
    for participant_id, count in sorted(count_labels(session, _present_ids(study)).items()):
        # A last answer that is changed afterwards makes the last model's name new.
        suffix = f"/answer-{last_answers[participant_id]}" if count >= settings.labels_per_participant else ""
        reward = reward_due(settings, count)
        if reward:
            name = f"reward/participant-{participant_id}/labels-{reward}{suffix}"
            jobs.append(Job(name, RunKind.REWARD, study.id, participant_id, reward))
            milestone = filter_due(settings, count)
            if milestone and name in succeeded and study.material is None:  # no simulator, no filter
                ending = suffix if milestone == settings.labels_per_participant else ""
                name = f"filter/participant-{participant_id}/labels-{milestone}{ending}"
                jobs.append(Job(name, RunKind.FILTER, study.id, participant_id, milestone))
        if suffix and study.material is None:
            jobs += _missing_from_evaluation(study, participant_id, f"labels-{reward}{suffix}", succeeded)
    return jobs


def _missing_from_evaluation(study: Study, participant_id: int, ending: str, succeeded: Collection[str]) -> list[Job]:
    """What is to be trained, filmed or packed for somebody who has given all labels."""
    if f"reward/participant-{participant_id}/{ending}" not in succeeded:
        return []
    jobs = method_work.due(study, participant_id, ending)
    if f"filter/participant-{participant_id}/{ending}" in succeeded:
        jobs += film_work.due(study, participant_id, ending, succeeded)
    return jobs


def reward_due(settings: StudySettings, answered: int) -> int:
    """The number of labels the newest reward model should have seen; 0 while there is nothing to learn from."""
    if answered >= settings.labels_per_participant:
        return settings.labels_per_participant
    return answered // settings.retrain_every_labels * settings.retrain_every_labels


def filter_due(settings: StudySettings, answered: int) -> int:
    """The newest milestone that has been passed; 0 before the first. Milestones passed in the meantime are skipped."""
    return max((milestone for milestone in settings.milestones if milestone <= answered), default=0)


def _last_answers(session: Session, study: Study) -> dict[int, int]:
    """The number of everybody's last answer that is learned from."""
    events = select(Query.participant_id, func.max(LabelEvent.id)).join(LabelEvent)
    events = events.where(Query.participant_id.in_(_present_ids(study)), Query.purpose.in_(LEARNED_FROM))
    return dict(session.execute(events.group_by(Query.participant_id)).all())
