"""What is missing or stale, asked of the database again and again: the answer is always the whole truth.

Nothing here is remembered between two rounds, so a lost message, a killed worker or a second worker cannot leave
anything undone or do it twice: each run has one key, and work is started under that key at most once.
"""

from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import replace
from datetime import datetime, timedelta
from typing import NamedTuple

from sqlalchemy import ColumnElement, func, or_, select
from sqlalchemy.orm import Session

from app.db import now
from app.domain import run_keys
from app.domain.clips import Clip, Rollout
from app.domain.models import Model, ModelKind, Run, RunKind, RunStatus
from app.domain.preferences import LabelEvent, Query, count_labels
from app.domain.run_keys import AHEAD, SCENARIO, WHOLE, RunKey
from app.domain.studies import Participant, Study
from app.installed_tasks.refinements import answers_ahead
from app.services.evaluation import evaluation_plan, self_setting
from worker.domain import scenarios
from worker.jobs.clips import made_pairs, preview_films, repairs
from worker.jobs.publishing import export_files, power_plans, report_files
from worker.jobs.runtime import due_evaluation, due_lending
from worker.jobs.runtime.due_work import (
    answers_known,
    filter_due,
    gives_way,
    is_refinement_due,
    last_answers,
    last_exclusions,
    people_here,
    present_ids,
    reward_due,
)
from worker.jobs.runtime.records import ATTEMPTS, LEASE, Job, next_queries

CLIPS_AHEAD = 2
"""Scenarios per study in the making at a time: enough to keep busy, few enough that studies share fairly."""

RETRY_AFTER = timedelta(seconds=10)
_ONE_AT_A_TIME = (RunKind.REWARD, RunKind.FILTER, RunKind.CLIPS)
"""Of one participant: the next one waits, and has then seen more."""
_AT_WORK = (Study.deleted_at.is_(None), Study.put_away_at.is_(None))


class _Attempted(NamedTuple):
    """What is to be known of a run here. Whole ones take their time to load, and there are thousands of them."""

    status: str
    attempt: int
    finished_at: datetime | None


def due(session: Session, lost: Mapping[str, int] | None = None) -> Iterator[tuple[Job, int]]:
    """Every run that should exist and does not, or must be tried again, with the number of its attempt.

    ``lost``: stored files that are to be made again, as ArtefactStore.lost() gives them.
    """
    known = session.execute(select(Run.workflow_id, Run.status, Run.attempt, Run.finished_at))
    runs = {name: _Attempted(status, attempt, finished) for name, status, attempt, finished in known}
    learning = select(Run.participant_id, Run.kind).where(Run.kind.in_(_ONE_AT_A_TIME), Run.status == RunStatus.RUNNING)
    learning = learning.where(Run.participant_id.is_not(None))
    at_work = {(person, kind) for person, kind in session.execute(learning.where(~_is_silent()))}
    succeeded = {name for name, run in runs.items() if run.status == RunStatus.SUCCEEDED}
    left_a_method = select(Run.workflow_id).join(Model, Model.run_id == Run.id).where(Model.kind == ModelKind.METHOD)
    trained = set(session.scalars(left_a_method))
    for study in session.scalars(select(Study).where(Study.deleted_at.is_(None)).order_by(Study.id)).all():
        if study.put_away_at is not None:
            jobs: Iterable[Job] = export_files.due(session, study)  # somebody has asked for those
        else:
            jobs = (*repairs.due(session, study, lost or {}), *_all_due(session, study, succeeded, trained))
        for job in jobs:
            attempt = _attempt_due(runs.get(job.key), now())
            free = attempt is not None and (job.participant_id, job.kind) not in at_work
            if attempt is not None and free and not due_lending.is_missing(session, job):
                yield job, attempt


def _all_due(session: Session, study: Study, succeeded: Collection[str], trained: Collection[str]) -> Iterator[Job]:
    yield from preview_films.due_now(session, study)
    yield from _missing_clips(session, study)
    yield from _stale_models(session, study, succeeded, trained)
    yield from due_lending.due(session, study)
    yield from report_files.due(session, study)
    yield from export_files.due(session, study)
    yield from power_plans.due(session, study)


def abandoned(session: Session, in_hand: Collection[str]) -> list[tuple[Job, int]]:
    """Runs that some worker began and of which nothing has been heard since, with the number of the attempt.

    ``in_hand``: keys of runs that this worker is busy with; a machine under load may be late with a sign of life.
    """
    lost = select(Run).where(Run.status == RunStatus.RUNNING, _is_silent())
    left = [(job_of(run), run.attempt) for run in session.scalars(lost) if run.workflow_id not in in_hand]
    return [(job, attempt) for job, attempt in left if job is not None]


def _is_silent() -> ColumnElement[bool]:
    """Nobody has been at a run for a while. A sign from the future is none: the clock has been set back since."""
    moment = now()
    return or_(Run.heartbeat_at < moment - LEASE, Run.heartbeat_at > moment + LEASE)


def job_of(run: Run) -> Job | None:
    """What the run was begun for; None when its key is not one of this studio's."""
    key = run_keys.read(run.workflow_id)
    return None if key is None else Job(key, run.study_id)


def workflow_name(key: str, attempt: int) -> str:
    """The engine's name for one attempt at a run."""
    return f"{key}#{attempt}"


def studies_with_answers(session: Session) -> list[Study]:
    """The simulated studies in which somebody has answered: their first retraining is not far."""
    answered = select(Participant.study_id).join(Query).join(LabelEvent)
    found = session.scalars(select(Study).where(Study.id.in_(answered), *_AT_WORK).order_by(Study.id))
    return [study for study in found if study.material is None]


def short_of_queries(session: Session) -> list[int]:
    """Participants who could soon run out of queries."""
    return [
        participant_id
        for study in session.scalars(select(Study).where(*_AT_WORK)).all()
        for participant_id in _without_all_queries(session, study)
        if next_queries(session, participant_id, study.settings)[1] > 0
    ]


def with_lost_queries(session: Session, lost: Collection[str]) -> list[int]:
    """Participants who wait for pairs that cannot be shown, nor their clips be made again: videos from outside."""
    if not lost:
        return []
    studies = [study.id for study in session.scalars(select(Study)).all() if study.material is not None]
    of_lost = select(Clip.id).where(or_(Clip.video_sha256.in_(lost), Clip.poster_sha256.in_(lost)))
    answered = select(LabelEvent.id).where(LabelEvent.query_id == Query.id).exists()
    waiting = select(Query.participant_id).join(Participant, Participant.id == Query.participant_id)
    waiting = waiting.where(Participant.study_id.in_(studies), ~answered)
    return list(session.scalars(waiting.where(or_(Query.left_clip_id.in_(of_lost), Query.right_clip_id.in_(of_lost)))))


def _without_all_queries(session: Session, study: Study) -> list[int]:
    """Everybody who has not yet been given all their queries: in a study that is over, nobody."""
    settings = study.settings
    counted = present_ids(study).outerjoin(Query).group_by(Participant.id)
    short = counted.having(func.count(Query.id) < settings.practice_pairs + settings.question_count)
    return list(session.scalars(short.order_by(Participant.id)))


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
    """Clips of every scenario; of the first ones also whole episodes, once they were rolled out; then previews."""
    if study.material is not None:
        return []  # brought along by the study
    settings, jobs = study.settings, []
    clips = _clips_by_scenario(session, study, settings.clip_steps)
    whole = _clips_by_scenario(session, study, study.whole_clip_steps)
    for index in range(settings.pool_scenarios):
        seed = scenarios.of_pool(study.seed, index)
        if clips.get(seed, 0) < settings.behaviours_per_scenario:
            jobs.append(Job(RunKey(RunKind.CLIPS, study.id, subject=SCENARIO, number=seed), study.id))
        elif index < settings.introduction_scenarios and whole.get(seed, 0) < settings.behaviours_per_scenario:
            jobs.append(Job(RunKey(RunKind.CLIPS, study.id, subject=WHOLE, number=seed), study.id))
    return jobs[:CLIPS_AHEAD] or preview_films.due_ahead(session, study)


def _clips_by_scenario(session: Session, study: Study, step_count: int | None) -> dict[int, int]:
    """How many clips of this length there are of each scenario."""
    counted = (
        select(Rollout.scenario, func.count(Clip.id))
        .join(Clip)
        .where(Rollout.study_id == study.id, Rollout.participant_id.is_(None), Clip.step_count == step_count)
        .group_by(Rollout.scenario)
    )
    return dict(session.execute(counted).all())


def _stale_models(session: Session, study: Study, succeeded: Collection[str], trained: Collection[str]) -> list[Job]:
    jobs, settings = [], study.settings
    answers, exclusions = last_answers(session, present_ids(study)), last_exclusions(session, present_ids(study))
    begun, rating = evaluation_plan.begun(session, study), _rating(session, study)
    have_set = self_setting.who_have_set(session, study) if self_setting.is_set(study) else set()
    given_pairs = select(Query.id).where(Query.participant_id == Participant.id).exists()
    returned = set(session.scalars(present_ids(study).where(Participant.earlier_id.is_not(None), given_pairs)))
    counts = dict.fromkeys(returned, 0) | count_labels(session, present_ids(study))
    here, first = set(session.scalars(people_here(study))), answers_ahead(settings.labels_per_participant)
    for participant_id, count in sorted(counts.items()):
        known = answers_known(settings, count, answers.get(participant_id, 0), exclusions.get(participant_id))
        labels = reward_due(settings, count)
        ahead = RunKey(RunKind.REFINEMENT, participant_id=participant_id, subject=AHEAD, labels=first)
        reward = RunKey(RunKind.REWARD, participant_id=participant_id, labels=labels, answers=known)
        if labels or participant_id in returned:  # who comes back is known before the first answer
            jobs.append(Job(reward, study.id))
            milestone = filter_due(settings, count)
            waits = gives_way(settings, count) and participant_id in here and str(ahead) not in succeeded
            is_next = str(reward) in succeeded and not waits
            if milestone and is_next and study.material is None:  # no simulator, no filter
                jobs.append(Job(replace(reward, kind=RunKind.FILTER, labels=milestone), study.id))
        if is_refinement_due(settings, count):
            jobs.append(Job(ahead, study.id))
        if not labels or study.material is not None or participant_id not in rating:
            continue
        arm, shown = rating[participant_id], participant_id in begun
        if count < settings.labels_per_participant:
            jobs += due_evaluation.due_ahead(study, participant_id, arm)
            jobs += due_lending.films_ahead(session, study, participant_id, arm)
            jobs += made_pairs.due(session, study, reward) if str(reward) in succeeded else []
        else:
            has_set = participant_id in have_set
            jobs += due_evaluation.due(study, reward, succeeded, trained, shown, arm, has_set=has_set)
    return jobs


def _rating(session: Session, study: Study) -> dict[int, str | None]:
    """The arm of everybody who was not sent away before the evaluation."""
    going_on = select(Participant.id, Participant.arm).where(Participant.study_id == study.id)
    return dict(session.execute(going_on.where(Participant.ended_as.is_(None))).all())
