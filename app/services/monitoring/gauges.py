"""What whoever watches many machines asks of one: counted from the rows, as the dashboard does."""

import shutil
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from app.db import now, sqlite
from app.domain.models import Run, RunStatus, WorkerPresence
from app.domain.preferences import LabelEvent
from app.domain.studies import Participant, Study
from app.falls import noted
from app.storage import ArtefactStore


@dataclass(frozen=True)
class Gauge:
    """A number of this moment; several of one name differ in their labels."""

    name: str
    help: str
    value: float
    labels: dict[str, str] = field(default_factory=dict)


def of_machine(data_dir: Path, database_url: str, store: ArtefactStore) -> Iterator[Gauge]:
    """Disk, files and programs: known even when the database is not."""
    yield Gauge("studio_disk_free_bytes", "Free space where the data are.", shutil.disk_usage(data_dir).free)
    database = sqlite.file_of(database_url)
    if database is not None and database.exists():
        yield Gauge("studio_database_bytes", "Size of the SQLite database.", database.stat().st_size)
    lost = len(store.lost())
    yield Gauge("studio_files_damaged", "Stored files found damaged or missing, and not made again.", lost)
    falls = {each.program: each.count for each in noted(data_dir)}
    for program in ("web", "worker"):
        yield Gauge(
            "studio_falls",
            "How often a program has stopped by itself of late.",
            falls.get(program, 0),
            {"program": program},
        )


def of_studies(session: Session) -> Iterator[Gauge]:
    """People, answers and work, of all studies together."""
    kept = select(Study.id).where(Study.deleted_at.is_(None))
    people = session.scalar(select(func.count(Participant.id)).where(Participant.study_id.in_(kept)))
    yield Gauge("studio_participants", "Participants of all studies.", people or 0)
    answers = session.scalar(select(func.count(LabelEvent.id)))
    yield Gauge("studio_answers", "Answers to pairs, changes of mind included.", answers or 0)
    runs = session.execute(select(Run.kind, Run.status, func.count()).group_by(Run.kind, Run.status))
    for kind, status, count in runs:
        yield Gauge("studio_runs", "Runs of the worker by kind and state.", count, {"kind": kind, "status": status})
    silent = select(func.min(Run.heartbeat_at)).where(Run.status == RunStatus.RUNNING)
    oldest = session.scalar(silent)
    yield Gauge(
        "studio_run_silence_seconds",
        "Longest time since a run that is under way has given a sign of life.",
        (now() - oldest).total_seconds() if oldest else 0.0,
    )
    for name, seen_at in session.execute(select(WorkerPresence.name, WorkerPresence.last_seen_at)):
        silence_s = (now() - seen_at).total_seconds()
        yield Gauge(
            "studio_worker_silence_seconds", "Time since a worker's last sign of life.", silence_s, {"worker": name}
        )
