"""What the experimenter sees: counted from the rows each time, never stored, so it cannot disagree with them."""

import shutil
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path

from sqlalchemy import ColumnElement, func, select
from sqlalchemy.orm import Session, joinedload

from app.db import now
from app.domain.clips import Clip, Rollout
from app.domain.evaluation import Film, HeadToHeadAnswer, Rating, Trial
from app.domain.models import Bundle, Model, ModelKind, Run, RunKind, RunStatus, WorkerPresence
from app.domain.participation import StageRecord
from app.domain.people import StudyMember
from app.domain.preferences import Exclusion, LabelEvent, Response, count_labels
from app.domain.protocol import Stage
from app.domain.studies import Awaited, Participant, Study
from app.falls import Falls, noted
from app.services.answers import accuracy
from app.services.backups import schedule
from app.services.evaluation import robot_preparation
from app.services.monitoring import damage, participant_status
from app.services.monitoring.tallies import Tallies
from app.services.participants import stages
from app.services.runs import model_metrics
from app.services.runs import run_list as jobs
from app.storage import ArtefactStore

WORKER_SILENCE = timedelta(seconds=15)
DISK_LOW_BYTES = 2 * 1024**3
RECENT_CLIPS = 8
ACTIVE_WITHIN = timedelta(seconds=60)


@dataclass(frozen=True)
class Machine:
    """Whether anybody computes, and whether there is room for the results, and none of them is lost."""

    worker_seen_at: datetime | None
    worker_alive: bool
    disk_free_bytes: int
    disk_low: bool
    storage_trouble: str | None
    """Why stored files cannot be reached, in words."""
    damage: damage.Damage
    falls: Sequence[Falls]
    """Programs that have stopped by themselves of late."""
    backups: schedule.Standing | None
    """How the scheduled backups do; None without a schedule."""


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
    newest_filter: model_metrics.FilterVersion | None
    preparation: robot_preparation.Preparation | None
    """How far the robots are of somebody who waits for them, here or elsewhere."""
    watched: participant_status.Watched

    @property
    def flags(self) -> Sequence[str]:
        """What deserves a look: of the model first, then of the answers. A program never runs the page's script."""
        guessing, misfit = self.curve.foresight is accuracy.Foresight.GUESSING, self.watched.misfit is not None
        of_model = [name for name, raised in (("guessing", guessing), ("misfit", misfit)) if raised]
        expected = {"without_script"} if self.participant.scripted_as else set()
        return [*of_model, *(flag for flag in self.watched.consistency.flags if flag not in expected)]


@dataclass(frozen=True)
class StudySummary:
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
    scripted: int
    """Participants whom a program plays."""


@dataclass(frozen=True)
class StudyOverview:
    """One study with everybody in it."""

    study: Study
    pool: Pool
    rows: Sequence[ParticipantRow]
    stage_counts: Sequence[tuple[str, int]]
    jobs: Sequence[jobs.NoteworthyRun]
    """Failures first, then the newest first."""
    answers_today: int
    disk_use_bytes: int


@dataclass(frozen=True)
class ParticipantDetail:
    """Everything about one participant."""

    study: Study
    row: ParticipantRow
    versions: Sequence[model_metrics.FilterVersion]
    """The newest first."""
    weights: Sequence[model_metrics.Weight]
    taste: model_metrics.LearnedCosts | None
    runs: Sequence[Run]
    """The newest first."""
    liked: participant_status.Liked | None
    stage_times: Sequence[participant_status.StageTime]


def machine(session: Session, data_dir: Path, store: ArtefactStore, theirs: ColumnElement[bool]) -> Machine:
    """The state of the worker and of the disk, and of the files of these studies."""
    seen_at = session.scalar(select(WorkerPresence.last_seen_at).order_by(WorkerPresence.last_seen_at.desc()).limit(1))
    free = shutil.disk_usage(data_dir).free
    alive = seen_at is not None and now() - seen_at <= WORKER_SILENCE
    broken = damage.standing(session, store, theirs)
    falls, backups = noted(data_dir), schedule.standing(data_dir)
    return Machine(seen_at, alive, free, free < DISK_LOW_BYTES, store.trouble(), broken, falls, backups)


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
        select(func.max(StudyMember.id)).scalar_subquery(),
        select(func.count(StudyMember.id)).scalar_subquery(),
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
        select(func.max(HeadToHeadAnswer.id)).scalar_subquery(),
    )
    return repr(tuple(session.execute(select(*newest)).one()))


def study_lines(session: Session, theirs: ColumnElement[bool], *, put_away: bool = False) -> Sequence[StudySummary]:
    """Of these studies those that are at work, or those that are put away; the newest first."""
    pools = select(Rollout.study_id, func.count(Clip.id)).join(Clip).where(Rollout.participant_id.is_(None))
    clips = dict(session.execute(pools.group_by(Rollout.study_id)).all())
    everybody = select(Participant).where(Participant.is_preview.is_(False))
    people: dict[int, list[Participant]] = defaultdict(list)
    for participant in session.scalars(everybody):
        people[participant.study_id].append(participant)
    labels = count_labels(session, everybody.with_only_columns(Participant.id))
    failed = Counter(run.study_id for run in jobs.failures(session))
    lines = []
    kept = Study.put_away_at.is_not(None) if put_away else Study.put_away_at.is_(None)
    shown = select(Study).where(Study.deleted_at.is_(None), kept, theirs)
    for study in session.scalars(shown.order_by(Study.id.desc())):
        given = [labels.get(person.id, 0) for person in people[study.id]]
        wanted = study.settings.labels_per_participant
        lines.append(
            StudySummary(
                study=study,
                participants=len(given),
                finished=_finished(study, people[study.id], given),
                labels=sum(given),
                labels_wanted=wanted * len(given),
                clips=clips.get(study.id, 0),
                clips_wanted=_clips_wanted(study),
                failed=failed[study.id],
                scripted=sum(person.scripted_as is not None for person in people[study.id]),
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


def study_overview(session: Session, study: Study, tallies: Tallies | None = None) -> StudyOverview:
    """One study: its pool and a row per participant. ``tallies``: what was counted before."""
    everybody = select(Participant).where(Participant.study_id == study.id, Participant.is_preview.is_(False))
    people = session.scalars(everybody.order_by(Participant.number)).all()
    rows = _rows(session, study, people, tallies or Tallies())
    return StudyOverview(
        study,
        _pool(session, study),
        rows,
        participant_status.stage_counts({row.participant.id: row.stage for row in rows}),
        jobs.of_study(session, study),
        participant_status.answers_today(session, study),
        participant_status.disk_use(session, study),
    )


def participant_detail(
    session: Session, study: Study, participant: Participant, tallies: Tallies | None = None
) -> ParticipantDetail:
    """One participant: answers, models, filters, runs."""
    model = _newest_reward_model(session, participant)
    return ParticipantDetail(
        study=study,
        row=_rows(session, study, [participant], tallies or Tallies())[0],
        versions=_versions(session, participant),
        weights=model_metrics.learned_weights(model),
        taste=model_metrics.taste(model),
        runs=session.scalars(select(Run).where(Run.participant_id == participant.id).order_by(Run.id.desc())).all(),
        liked=participant_status.liked_clips(session, study, model),
        stage_times=participant_status.stage_times(session, participant),
    )


def curve_of(session: Session, participant_id: int) -> accuracy.Curve:
    """How well the models of one participant foresaw the answers, up to now."""
    return Tallies().of(session, [participant_id])[participant_id].curve


def _rows(session: Session, study: Study, people: Sequence[Participant], tallies: Tallies) -> Sequence[ParticipantRow]:
    ids = [person.id for person in people]
    told, runs, wanted = tallies.of(session, ids), jobs.of_people(session, ids), study.settings.labels_per_participant
    where = participant_status.where_they_are(
        session, study.settings, people, {each: told[each].answered for each in ids}
    )
    preparations = _preparations(session, ids)
    return [
        ParticipantRow(
            participant=person,
            stage=where[person.id],
            active=person.last_seen_at is not None and now() - person.last_seen_at < ACTIVE_WITHIN,
            answered=told[person.id].answered,
            wanted=wanted,
            counts=told[person.id].counts,
            curve=told[person.id].curve,
            run=runs.get(person.id),
            newest_filter=told[person.id].newest_filter,
            preparation=preparations.get(person.id),
            watched=told[person.id].watched,
        )
        for person in people
    ]


def _preparations(session: Session, ids: Sequence[int]) -> Mapping[int, robot_preparation.Preparation]:
    """By participant id."""
    waiting = select(Participant).where(Participant.id.in_(ids), Participant.waiting_for == Awaited.ROBOTS)
    people = session.scalars(waiting.options(joinedload(Participant.study)))
    return {person.id: robot_preparation.preparation(session, person) for person in people}


def _versions(session: Session, participant: Participant) -> Sequence[model_metrics.FilterVersion]:
    """Every filter of this participant, the newest first."""
    rows = session.execute(
        select(Model, Bundle)
        .outerjoin(Bundle, Bundle.model_id == Model.id)
        .where(Model.participant_id == participant.id, Model.kind == ModelKind.FILTER)
        .order_by(Model.label_count.desc(), Model.id.desc())
    )
    return [model_metrics.filter_version(model, bundle) for model, bundle in rows]


def _pool(session: Session, study: Study) -> Pool:
    clips = select(Clip).join(Rollout).where(Rollout.study_id == study.id, Rollout.participant_id.is_(None))
    runs = session.scalars(
        select(Run).where(Run.study_id == study.id, Run.kind == RunKind.CLIPS).order_by(Run.id)
    ).all()
    return Pool(
        made=session.scalar(select(func.count()).select_from(clips.subquery())) or 0,
        wanted=_clips_wanted(study),
        recent=session.scalars(clips.order_by(Clip.id.desc()).limit(RECENT_CLIPS)).all(),
        run=jobs.noteworthy(runs),
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
