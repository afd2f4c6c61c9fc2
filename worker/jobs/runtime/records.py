"""What the worker writes to the database: runs and their progress, clips, queries, models, bundles.

Every function is one short step inside a transaction of its caller; none computes.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any

from sqlalchemy import func, select, update
from sqlalchemy.orm import Session, joinedload
from sqlalchemy.sql.base import ExecutableOption

from app.db import now
from app.domain import run_keys
from app.domain.clips import Clip, Rollout
from app.domain.models import Bundle, Model, ModelKind, Run, RunKind, RunStatus, WorkerPresence
from app.domain.preferences import LabelEvent, Purpose, Query
from app.domain.run_keys import RunKey
from app.domain.studies import Participant
from app.domain.study_settings import StudySettings

ATTEMPTS = 3
"""How often a failing run is tried before somebody has to look."""

QUERIES_AHEAD = 12
"""Unanswered queries each participant has waiting."""

LIES_OPEN = timedelta(minutes=10)
"""So long a pair that was shown may still be in front of somebody."""

LEASE = timedelta(seconds=45)
"""A running run that has not been heard of for this long belongs to nobody: within a minute somebody takes it over."""


@dataclass(frozen=True)
class Job:
    """One piece of work that is due, in one study."""

    about: RunKey
    study_id: int

    @property
    def key(self) -> str:
        """Under which there is at most one run."""
        return str(self.about)

    @property
    def kind(self) -> RunKind:
        """Which kind of work it is."""
        return self.about.kind

    @property
    def participant_id(self) -> int | None:
        """The participant the run is for; None when it is for the whole study."""
        return self.about.participant_id

    @property
    def participant(self) -> int:
        """The participant the run is for. Raises ValueError for work that is for a whole study."""
        if self.participant_id is None:
            raise ValueError(f"{self.key} is not about one participant.")
        return self.participant_id

    @property
    def number(self) -> int:
        """What the subject is about: a scenario or a row. Raises ValueError for work that has none."""
        if self.about.number is None:
            raise ValueError(f"{self.key} has no number.")
        return self.about.number


def as_arguments(job: Job) -> dict[str, Any]:
    """The job as plain values, which is what the engine stores."""
    return {"key": job.key, "study_id": job.study_id}


def from_arguments(arguments: Mapping[str, Any]) -> Job:
    """Read what as_arguments() made, or earlier versions, where the key was a finding. Raises ValueError."""
    key = run_keys.read(str(arguments.get("key", arguments.get("finding"))))
    if key is None:
        raise ValueError(f"No job of this studio: {arguments}")
    return Job(key, int(arguments["study_id"]))


def begin_run(session: Session, job: Job, seed: int) -> int:
    """The id of the run of this key: a new one, or the earlier one set to running again."""
    run = session.scalar(select(Run).where(Run.workflow_id == job.key))
    if run is None:
        run = Run(workflow_id=job.key, kind=job.kind, study_id=job.study_id)
        session.add(run)
    run.participant_id = job.participant_id
    run.label_count, run.label_hash = job.about.labels, None
    run.status, run.error, run.finished_at = RunStatus.RUNNING, None, None
    run.seed, run.heartbeat_at = seed, now()
    session.flush()
    return run.id


def has_succeeded(session: Session, key: str) -> bool:
    """Whether there is nothing left to be done under this key."""
    done = select(Run.id).where(Run.workflow_id == key, Run.status == RunStatus.SUCCEEDED)
    return session.scalar(done) is not None


def report(session: Session, run_id: int, stage: str, progress: float) -> None:
    """Say where the run is: a few words and a share between 0 and 1."""
    run = session.get_one(Run, run_id)
    run.stage, run.progress, run.heartbeat_at = stage, progress, now()


def beat(session: Session, run_id: int) -> None:
    """Say that somebody is still working on the run."""
    session.get_one(Run, run_id).heartbeat_at = now()


def beat_all(session: Session, keys: Collection[str]) -> None:
    """Say so of everything that one worker is at, whether it computes, writes a file, or waits for a process."""
    at_work = update(Run).where(Run.workflow_id.in_(keys), Run.status == RunStatus.RUNNING)
    session.execute(at_work.values(heartbeat_at=now()))


def finish_run(session: Session, run_id: int) -> None:
    """Mark the run as done."""
    run = session.get_one(Run, run_id)
    run.status, run.stage, run.progress, run.finished_at = RunStatus.SUCCEEDED, "done", 1.0, now()


def fail_run(session: Session, key: str, error: str, counts: bool = True) -> None:
    """Keep what went wrong; the run is tried again until its attempts are used up.

    What is no fault of the work (a full disk) does not count as an attempt: it is tried until it succeeds.
    """
    run = session.scalar(select(Run).where(Run.workflow_id == key))
    if run is not None:
        run.status, run.error, run.finished_at = RunStatus.FAILED, error, now()
        run.attempt += counts


def save_clip(session: Session, study_id: int, rollout: dict[str, Any], clip: dict[str, Any]) -> None:
    """Record a rendered rollout; doing it twice changes nothing."""
    place = (Rollout.study_id == study_id, Rollout.scenario == rollout["scenario"])
    known = session.scalar(select(Rollout).where(*place, Rollout.behaviour == rollout["behaviour"]))
    if known is None:
        known = Rollout(study_id=study_id, **rollout)
        session.add(known)
        session.flush()
    stretch = (Clip.first_step == clip["first_step"], Clip.step_count == clip["step_count"])
    if session.scalar(select(Clip.id).where(Clip.rollout_id == known.id, *stretch)) is None:
        session.add(Clip(rollout_id=known.id, **clip))


def rollouts_of(session: Session, study_id: int, scenario: int, behaviours: Sequence[int]) -> Sequence[Rollout]:
    """What was recorded of these behaviours of a scenario, in their order."""
    mine = select(Rollout).where(Rollout.study_id == study_id, Rollout.scenario == scenario)
    return session.scalars(mine.where(Rollout.behaviour.in_(behaviours)).order_by(Rollout.behaviour)).all()


def save_model(session: Session, run_id: int, kind: ModelKind, artefact_sha256: str, metrics: dict[str, Any]) -> Model:
    """Record the result of a run; a repeat returns the model that is already there."""
    known = session.scalar(select(Model).where(Model.run_id == run_id))
    if known is not None:
        return known
    run = session.get_one(Run, run_id)
    model = Model(
        run_id=run_id,
        participant_id=run.participant_id,
        kind=kind,
        artefact_sha256=artefact_sha256,
        label_count=run.label_count,
        label_hash=run.label_hash,
        seed=run.seed,
        metrics=metrics,
    )
    session.add(model)
    session.flush()
    return model


@dataclass(frozen=True)
class SeenLabels:
    """Which labels a run has seen."""

    label_count: int
    label_hash: str
    started_at: datetime


def seen_labels(session: Session, run_id: int) -> SeenLabels:
    """What set_labels() noted. Raises ValueError when nothing was."""
    run = session.get_one(Run, run_id)
    if run.label_count is None or run.label_hash is None:
        raise ValueError(f"{run.workflow_id} has seen no labels yet.")
    return SeenLabels(run.label_count, run.label_hash, run.started_at)


def next_version(session: Session, participant_id: int) -> int:
    """The version the participant's next bundle will have."""
    newest = session.scalar(select(func.max(Bundle.version)).where(Bundle.participant_id == participant_id))
    return (newest or 0) + 1


def save_bundle(session: Session, model: Model, version: int, artefact_sha256: str, byte_count: int) -> None:
    """Publish the export of a filter; doing it twice changes nothing."""
    if session.scalar(select(Bundle.id).where(Bundle.model_id == model.id)) is None:
        session.add(
            Bundle(
                participant_id=model.participant_id,
                version=version,
                model_id=model.id,
                artefact_sha256=artefact_sha256,
                byte_count=byte_count,
            )
        )


def unanswered(session: Session, participant_id: int, *options: ExecutableOption) -> Sequence[Query]:
    """Queries that have never been answered, in their order; ``options`` say what to load with each."""
    answered = select(LabelEvent.query_id).where(LabelEvent.query_id == Query.id).exists()
    mine = select(Query).where(Query.participant_id == participant_id, ~answered)
    return session.scalars(mine.order_by(Query.ordinal).options(*options)).all()


def next_queries(session: Session, participant_id: int, settings: StudySettings) -> tuple[int, int]:
    """The next free ordinal, and how many queries to make so that the participant neither waits nor gets too many."""
    free = free_ordinals(session, participant_id, settings)
    return (free[0] if free else settings.practice_pairs + settings.question_count + 1), len(free)


def free_ordinals(session: Session, participant_id: int, settings: StudySettings) -> list[int]:
    """The next places in the participant's plan without a query, as many as should be waiting."""
    taken = set(session.scalars(select(Query.ordinal).where(Query.participant_id == participant_id)))
    places = range(1, settings.practice_pairs + settings.question_count + 1)
    if len(taken) >= len(places):
        return []
    room = QUERIES_AHEAD - len(unanswered(session, participant_id))
    return [place for place in places if place not in taken][: max(0, room)]


def save_queries(session: Session, participant_id: int, rows: list[dict[str, Any]]) -> None:
    """Add queries at ordinals that are still free: somebody else may have been faster.

    A row with ``repeats_ordinal`` asks the query of that place again, which is there or in an earlier row; if it has
    gone meanwhile, this row and those after it are left to the next round.
    """
    known = dict(session.execute(select(Query.ordinal, Query.id).where(Query.participant_id == participant_id)).all())
    for row in rows:
        if row["ordinal"] in known:
            continue
        columns = {name: value for name, value in row.items() if name != "repeats_ordinal"}
        asked_again = row.get("repeats_ordinal")
        if asked_again is not None:
            if asked_again not in known:
                return
            columns["repeats_query_id"] = known[asked_again]
        query = Query(participant_id=participant_id, **columns)
        session.add(query)
        session.flush()
        known[query.ordinal] = query.id


def drop_unseen_queries(session: Session, participant_id: int, keep: int) -> None:
    """Forget pairs nobody has seen, the next few excepted, so that a newer model can choose others for their places.

    Their repetitions go with them; practice, introduction and catch pairs were not chosen by a model and stay.
    """
    later = unanswered(session, participant_id)[keep:]
    held = {query.repeats_query_id for query in later if query.served_at is not None}
    chosen = [
        query
        for query in later
        if query.served_at is None and query.purpose == Purpose.PREFERENCE and query.id not in held
    ]
    gone = {query.id for query in chosen}
    for query in later:
        if query.repeats_query_id in gone:
            session.delete(query)
    session.flush()  # what refers to others goes first
    for query in chosen:
        session.delete(query)


def drop_lost_queries(session: Session, participant_id: int, lost: Collection[str]) -> None:
    """Forget pairs that cannot be shown, so that others take their places; one that lies open may still be answered."""
    waiting = unanswered(session, participant_id, joinedload(Query.left_clip), joinedload(Query.right_clip))
    gone = {query.id for query in waiting if _is_lost(query, lost) and not _lies_open(query)}
    asked_again = {query.repeats_query_id for query in waiting if query.id not in gone}
    for query in reversed(waiting):  # what repeats others goes first
        if query.id in gone - asked_again:
            session.delete(query)
            session.flush()


def _is_lost(query: Query, lost: Collection[str]) -> bool:
    clips = (query.left_clip, query.right_clip)
    return any(sha256 in lost for clip in clips for sha256 in (clip.video_sha256, clip.poster_sha256))


def _lies_open(query: Query) -> bool:
    return query.served_at is not None and now() - query.served_at < LIES_OPEN


def save_predictions(session: Session, model_id: int, probabilities: dict[int, float]) -> None:
    """Write P(right preferred) to queries, by id, unless they have been answered in the meantime."""
    answered = set(session.scalars(select(LabelEvent.query_id).where(LabelEvent.query_id.in_(probabilities))))
    for query_id in probabilities.keys() - answered:
        query = session.get(Query, query_id)
        if query is not None:
            query.predicted_right, query.predicted_by_model_id = probabilities[query_id], model_id


def set_labels(session: Session, run_id: int, label_count: int, label_hash: str) -> None:
    """Note which labels the run has really seen; there may be more than were due."""
    run = session.get_one(Run, run_id)
    run.label_count, run.label_hash = label_count, label_hash


def newest_model(session: Session, participant_id: int, kind: ModelKind) -> Model | None:
    """The model with the most labels behind it, the newest of equals."""
    return session.scalar(
        select(Model)
        .where(Model.participant_id == participant_id, Model.kind == kind)
        .order_by(Model.label_count.desc(), Model.id.desc())
        .limit(1)
    )


def models_of(session: Session, participant_id: int, kind: ModelKind) -> Sequence[Model]:
    """Every model of a kind, the one with the most labels behind it first, the newest of equals before the others."""
    theirs = select(Model).where(Model.participant_id == participant_id, Model.kind == kind)
    return session.scalars(theirs.order_by(Model.label_count.desc(), Model.id.desc())).all()


def models_of_others(
    session: Session, participant_id: int, kind: ModelKind, at_least_labels: int, most: int
) -> Sequence[Model]:
    """The newest model of every other participant of the study with enough labels behind it, in order of joining.

    Of more than ``most`` people those who joined last.
    """
    study = select(Participant.study_id).where(Participant.id == participant_id).scalar_subquery()
    others = session.scalars(
        select(Participant.id)
        .where(Participant.study_id == study, Participant.id != participant_id, Participant.is_preview.is_(False))
        .order_by(Participant.id)
    )
    newest = [newest_model(session, other, kind) for other in others]
    enough = [model for model in newest if model is not None and (model.label_count or 0) >= at_least_labels]
    return enough[-most:]


def withdrawn_ids(session: Session, study_id: int) -> Collection[int]:
    """Who has withdrawn from the study."""
    people = select(Participant.id).where(Participant.study_id == study_id, Participant.withdrawn_at.is_not(None))
    return set(session.scalars(people))


def sign_presence(session: Session, name: str, moment: datetime) -> None:
    """Say that this worker lives."""
    presence = session.get(WorkerPresence, name)
    if presence is None:
        session.add(WorkerPresence(name=name, last_seen_at=moment))
    else:
        presence.last_seen_at = moment
