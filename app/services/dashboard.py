"""What the experimenter sees: counted from the rows each time, never stored, so it cannot disagree with them."""

import shutil
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from app.db import now
from app.domain.clips import Clip, Rollout
from app.domain.evaluation import Film, Rating, Trial
from app.domain.models import Bundle, Model, ModelKind, Run, RunKind, RunStatus, WorkerPresence
from app.domain.participation import StageRecord
from app.domain.preferences import LEARNED_FROM, Exclusion, LabelEvent, Query, Response, is_excluded
from app.domain.protocol import Stage
from app.domain.studies import Participant, Strategy, Study
from app.services import accuracy, results, stages, watching

WORKER_SILENCE = timedelta(seconds=15)
DISK_LOW_BYTES = 2 * 1024**3
RECENT_CLIPS = 8
ACTIVE_WITHIN = timedelta(seconds=60)


@dataclass(frozen=True)
class Machine:
    """Whether anybody computes, and whether there is room for the results."""

    worker_seen_at: datetime | None
    worker_alive: bool
    disk_free_bytes: int
    disk_low: bool


@dataclass(frozen=True)
class Job:
    """A run that deserves a line: at work, about to be tried again, or failed and not made good since."""

    run: Run
    code: str | None
    """Whom it is for; None: the whole study."""


@dataclass(frozen=True)
class Pool:
    """The clips of a study."""

    made: int
    wanted: int
    recent: Sequence[Clip]
    run: Run | None
    """The run that fills it, while it works or after it failed."""


@dataclass(frozen=True)
class ParticipantRow:
    """One participant in one line."""

    participant: Participant
    stage: str
    """In words, see watching."""
    active: bool
    answered: int
    wanted: int
    counts: Mapping[Response, int]
    """Answers by kind."""
    curve: accuracy.Curve
    run: Run | None
    """What the worker is doing for them, or what failed; None when nothing is to be said."""
    newest_filter: results.FilterVersion | None
    watched: watching.Watched


@dataclass(frozen=True)
class StudyLine:
    """One study in one line."""

    study: Study
    participants: int
    finished: int
    labels: int
    labels_wanted: int
    clips: int
    clips_wanted: int
    failed: int
    """Runs that failed and wait for somebody."""


@dataclass(frozen=True)
class StudyOverview:
    """One study with everybody in it."""

    study: Study
    pool: Pool
    rows: Sequence[ParticipantRow]
    stage_counts: Sequence[tuple[str, int]]
    jobs: Sequence[Job]
    """Failures first, then the newest first."""
    answers_today: int
    disk_use_bytes: int


@dataclass(frozen=True)
class ParticipantDetail:
    """Everything about one participant."""

    study: Study
    row: ParticipantRow
    median_response_ms: int | None
    versions: Sequence[results.FilterVersion]
    """The newest first."""
    weights: Sequence[results.Weight]
    taste: results.Taste | None
    runs: Sequence[Run]
    """The newest first."""
    liked: watching.Liked | None
    stage_times: Sequence[watching.StageTime]


@dataclass(frozen=True)
class _Answer:
    response: Response
    predicted_right: float | None
    response_time_ms: int | None
    drawn_at_random: bool
    excluded: bool
    """By an experimenter: it was given, and nothing is concluded from it."""


def machine(session: Session, data_dir: Path) -> Machine:
    """The state of the worker and of the disk."""
    seen_at = session.scalar(select(WorkerPresence.last_seen_at).order_by(WorkerPresence.last_seen_at.desc()).limit(1))
    free = shutil.disk_usage(data_dir).free
    alive = seen_at is not None and now() - seen_at <= WORKER_SILENCE
    return Machine(seen_at, alive, free, free < DISK_LOW_BYTES)


def fingerprint(session: Session) -> str:
    """Changes whenever a page of the dashboard would: one cheap query instead of drawing everything again."""
    newest = (
        select(func.max(LabelEvent.id)).scalar_subquery(),
        select(func.max(Exclusion.id)).scalar_subquery(),
        select(func.max(Model.id)).scalar_subquery(),
        select(func.max(Bundle.id)).scalar_subquery(),
        select(func.max(Clip.id)).scalar_subquery(),
        select(func.max(Participant.last_seen_at)).scalar_subquery(),
        select(func.max(Participant.id)).scalar_subquery(),
        select(func.max(Participant.instructed_at)).scalar_subquery(),
        select(func.max(Run.heartbeat_at)).scalar_subquery(),
        select(func.max(Run.finished_at)).scalar_subquery(),
        select(func.count(Run.id)).where(Run.status == RunStatus.RETRY).scalar_subquery(),
        select(func.max(Study.id)).scalar_subquery(),
        select(func.max(Study.deleted_at)).scalar_subquery(),
        select(func.count(Study.put_away_at)).scalar_subquery(),
        select(func.max(StageRecord.id)).scalar_subquery(),
        select(func.max(StageRecord.finished_at)).scalar_subquery(),
        select(func.max(Participant.completed_at)).scalar_subquery(),
        select(func.max(Participant.withdrawn_at)).scalar_subquery(),
        select(func.max(Rating.id)).scalar_subquery(),
        select(func.max(Trial.shown_at)).scalar_subquery(),
        select(func.max(Trial.started_at)).scalar_subquery(),
        select(func.max(Trial.finished_at)).scalar_subquery(),
        select(func.max(Film.id)).scalar_subquery(),
    )
    return repr(tuple(session.execute(select(*newest)).one()))


def study_lines(session: Session, *, put_away: bool = False) -> Sequence[StudyLine]:
    """Every study that is at work, or every one that is put away; the newest first."""
    counted = session.execute(select(Rollout.study_id, func.count(Clip.id)).join(Clip).group_by(Rollout.study_id))
    clips = {study_id: count for study_id, count in counted}  # noqa: C416  (a typed row is not a typed pair)
    people: dict[int, list[Participant]] = defaultdict(list)
    for participant in session.scalars(select(Participant).where(Participant.is_preview.is_(False))):
        people[participant.study_id].append(participant)
    lines = []
    kept = Study.put_away_at.is_not(None) if put_away else Study.put_away_at.is_(None)
    for study in session.scalars(select(Study).where(Study.deleted_at.is_(None), kept).order_by(Study.id.desc())):
        answers = _answers(session, [person.id for person in people[study.id]])
        given = [len(answers[person.id]) for person in people[study.id]]
        wanted = study.settings.labels_per_participant
        lines.append(
            StudyLine(
                study=study,
                participants=len(given),
                finished=_finished(study, people[study.id], given),
                labels=sum(given),
                labels_wanted=wanted * len(given),
                clips=clips.get(study.id, 0),
                clips_wanted=_clips_wanted(study),
                failed=sum(job.run.status == RunStatus.FAILED for job in _jobs(session, study)),
            )
        )
    return lines


def _finished(study: Study, people: Sequence[Participant], given: Sequence[int]) -> int:
    """How many are through with everything; where comparing is all, with comparing."""
    settings = study.settings
    comparing_is_all = stages.stages_of(settings)[-1] is Stage.PAIRS
    return sum(
        person.completed_at is not None or (comparing_is_all and count >= settings.labels_per_participant)
        for person, count in zip(people, given, strict=True)
    )


def study_overview(session: Session, study: Study) -> StudyOverview:
    """One study: its pool and a row per participant."""
    everybody = select(Participant).where(Participant.study_id == study.id, Participant.is_preview.is_(False))
    people = session.scalars(everybody.order_by(Participant.number)).all()
    rows = _rows(session, study, people)
    return StudyOverview(
        study,
        _pool(session, study),
        rows,
        watching.stage_counts({row.participant.id: row.stage for row in rows}),
        _jobs(session, study),
        watching.answers_today(session, study),
        watching.disk_use(session, study),
    )


def participant_detail(session: Session, study: Study, participant: Participant) -> ParticipantDetail:
    """One participant: answers, models, filters, runs."""
    answers = _answers(session, [participant.id])[participant.id]
    counting = [answer for answer in answers if not answer.excluded]
    times = sorted(answer.response_time_ms for answer in counting if answer.response_time_ms is not None)
    model = _newest_reward_model(session, participant)
    return ParticipantDetail(
        study=study,
        row=_rows(session, study, [participant])[0],
        median_response_ms=times[len(times) // 2] if times else None,
        versions=_versions(session, [participant.id])[participant.id],
        weights=results.learned_weights(model),
        taste=results.taste(model),
        runs=session.scalars(select(Run).where(Run.participant_id == participant.id).order_by(Run.id.desc())).all(),
        liked=watching.liked_clips(session, study, model),
        stage_times=watching.stage_times(session, participant),
    )


def _rows(session: Session, study: Study, people: Sequence[Participant]) -> Sequence[ParticipantRow]:
    ids = [person.id for person in people]
    answers, versions, runs = _answers(session, ids), _versions(session, ids), _noteworthy_runs(session, ids)
    settings = study.settings
    given = {person: len(theirs) for person, theirs in answers.items()}
    where, wanted = watching.where_they_are(session, settings, people, given), settings.labels_per_participant
    return [
        ParticipantRow(
            participant=person,
            stage=where[person.id],
            active=person.last_seen_at is not None and now() - person.last_seen_at < ACTIVE_WITHIN,
            answered=len(answers[person.id]),
            wanted=wanted,
            counts=_counts(answers[person.id]),
            curve=accuracy.curve(_hits(answers[person.id])),
            run=runs.get(person.id),
            newest_filter=versions[person.id][0] if versions[person.id] else None,
            watched=watching.watched(session, person.id),
        )
        for person in people
    ]


def _counts(answers: Iterable[_Answer]) -> Mapping[Response, int]:
    counted = Counter(answer.response for answer in answers)
    return {response: counted[response] for response in Response}


def _hits(answers: Iterable[_Answer]) -> Sequence[bool]:
    """Whether each predicted answer that prefers a side was foreseen; only on pairs that were drawn at random.

    What a model chose to ask is where it is worst: on that, every way of choosing well would look bad.
    """
    decided = [
        answer
        for answer in answers
        if answer.drawn_at_random and not answer.excluded and answer.response in (Response.LEFT, Response.RIGHT)
    ]
    return [
        (answer.predicted_right > 0.5) == (answer.response is Response.RIGHT)
        for answer in decided
        if answer.predicted_right is not None
    ]


def _answers(session: Session, participant_ids: Sequence[int]) -> dict[int, list[_Answer]]:
    """The labels that count, by participant, in the order of the queries."""
    newest = (
        select(LabelEvent.query_id, func.max(LabelEvent.revision).label("revision"))
        .join(Query, Query.id == LabelEvent.query_id)
        .where(Query.participant_id.in_(participant_ids))
        .group_by(LabelEvent.query_id)
        .subquery()
    )
    rows = session.execute(
        select(
            Query.participant_id,
            LabelEvent.response,
            Query.predicted_right,
            LabelEvent.response_time_ms,
            Query.strategy == Strategy.UNIFORM,
            is_excluded(),
        )
        .join(LabelEvent, LabelEvent.query_id == Query.id)
        .join(newest, (newest.c.query_id == LabelEvent.query_id) & (newest.c.revision == LabelEvent.revision))
        .where(Query.purpose.in_(LEARNED_FROM))
        .order_by(Query.participant_id, Query.ordinal)
    )
    answers: dict[int, list[_Answer]] = defaultdict(list)
    for participant_id, response, predicted_right, response_time_ms, at_random, excluded in rows:
        if response is None:  # taken back
            continue
        said = _Answer(Response(response), predicted_right, response_time_ms, at_random, excluded)
        answers[participant_id].append(said)
    return answers


def _versions(session: Session, participant_ids: Sequence[int]) -> dict[int, list[results.FilterVersion]]:
    """Every filter of these participants, the newest first."""
    rows = session.execute(
        select(Model, Bundle)
        .outerjoin(Bundle, Bundle.model_id == Model.id)
        .where(Model.participant_id.in_(participant_ids), Model.kind == ModelKind.FILTER)
        .order_by(Model.label_count.desc(), Model.id.desc())
    )
    versions: dict[int, list[results.FilterVersion]] = defaultdict(list)
    for model, bundle in rows:
        versions[model.participant_id].append(results.filter_version(model, bundle))
    return versions


def _noteworthy_runs(session: Session, participant_ids: Sequence[int]) -> dict[int, Run]:
    """Per participant the newest run at work; where none is, the newest failure that no later success has made good."""
    runs = session.scalars(select(Run).where(Run.participant_id.in_(participant_ids)).order_by(Run.id))
    by_person: dict[int, list[Run]] = defaultdict(list)
    for run in runs:
        if run.participant_id is not None:
            by_person[run.participant_id].append(run)
    chosen = {person: _noteworthy(theirs) for person, theirs in by_person.items()}
    return {person: run for person, run in chosen.items() if run is not None}


def _noteworthy(runs: Sequence[Run]) -> Run | None:
    """Of runs in their order: one at work, else a failure that still stands."""
    working = [run for run in runs if run.status in (RunStatus.RUNNING, RunStatus.RETRY)]
    if working:
        return working[-1]
    newest = {_work_of(run): run for run in runs}
    return next((run for run in newest.values() if run.status == RunStatus.FAILED), None)


def _jobs(session: Session, study: Study) -> Sequence[Job]:
    """Of everybody still in the study, and of the study itself."""
    runs = session.execute(
        select(Run, Participant)
        .outerjoin(Participant, Participant.id == Run.participant_id)
        .where(Run.study_id == study.id, Participant.is_preview.is_not(True), Participant.withdrawn_at.is_(None))
        .order_by(Run.id)
    )
    newest: dict[tuple[str, str | None], Job] = {}
    working: list[Job] = []
    for run, participant in runs:
        job = Job(run, participant.code if participant is not None else None)
        newest[_work_of(run), job.code] = job
        if run.status in (RunStatus.RUNNING, RunStatus.RETRY):
            working.append(job)
    failed = [job for job in newest.values() if job.run.status == RunStatus.FAILED]
    return [*sorted(failed, key=lambda job: -job.run.id), *reversed(working)]


def _work_of(run: Run) -> str:
    """What a later run of the same work makes good: of films and methods each has its own, and so has every export."""
    if run.kind in (RunKind.METHOD, RunKind.FILMS):
        return run.workflow_id.rpartition("/")[0]
    return run.workflow_id if run.kind == RunKind.EXPORT else run.kind


def _pool(session: Session, study: Study) -> Pool:
    clips = select(Clip).join(Rollout).where(Rollout.study_id == study.id)
    runs = session.scalars(
        select(Run).where(Run.study_id == study.id, Run.kind == RunKind.CLIPS).order_by(Run.id)
    ).all()
    return Pool(
        made=session.scalar(select(func.count()).select_from(clips.subquery())) or 0,
        wanted=_clips_wanted(study),
        recent=session.scalars(clips.order_by(Clip.id.desc()).limit(RECENT_CLIPS)).all(),
        run=_noteworthy(runs),
    )


def _clips_wanted(study: Study) -> int:
    """Clips of every scenario, and of the first ones whole episodes for the introduction."""
    settings = study.settings
    whole = 0 if study.whole_clip_steps in (None, settings.clip_steps) else settings.introduction_scenarios
    return (settings.pool_scenarios + whole) * settings.behaviours_per_scenario


def _newest_reward_model(session: Session, participant: Participant) -> Model | None:
    return session.scalar(
        select(Model)
        .where(Model.participant_id == participant.id, Model.kind == ModelKind.REWARD)
        .order_by(Model.label_count.desc(), Model.id.desc())
        .limit(1)
    )
