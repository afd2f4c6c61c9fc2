"""What keeps the studio from its work, or soon will, in words for whoever operates it.

They leave the house by mail or webhook, so they say nothing about people and nothing that a study calls itself.
"""

import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import timedelta

from sqlalchemy import func, select, true
from sqlalchemy.orm import Session

from app.db import now
from app.domain.models import WorkerPresence
from app.domain.studies import Study
from app.falls import noted
from app.services.backups import schedule
from app.services.monitoring import damage
from app.services.monitoring.dashboard import DISK_LOW_BYTES
from app.services.runs import run_list
from app.settings import Settings
from app.storage import ArtefactStore

WORKER_SILENCE = timedelta(minutes=2)
FALLS = 3
"""So often in a row is no accident."""


@dataclass(frozen=True)
class Trouble:
    """One thing that is wrong."""

    key: str
    """stays the same while the trouble lasts"""
    words: str
    """what is wrong and what to do"""


def of_machine(settings: Settings) -> Iterator[Trouble]:
    """Disk, programs and backups: known even when the database is not."""
    for key, folder in (("disk", settings.data_dir), ("backup disk", settings.backup_dir)):
        if folder is not None and folder.exists() and (free := shutil.disk_usage(folder).free) < DISK_LOW_BYTES:
            yield Trouble(key, f"Only {free / 1e9:.1f} GB are free on the disk of {folder}. Free some space.")
    for fall in noted(settings.data_dir):
        if fall.count >= FALLS:
            yield Trouble(
                f"falls of {fall.program}", f"The {fall.program} program stops by itself again and again. See its log."
            )
    backups = schedule.standing(settings.data_dir)
    if backups is not None and backups.failed_at is not None:
        yield Trouble("backup", "The last scheduled backup failed. The list of studies says why.")
    elif backups is not None and backups.late:
        yield Trouble("backup", "The newest backup is older than it should be. Is a worker running?")


def of_studies(session: Session, settings: Settings, store: ArtefactStore) -> Iterator[Trouble]:
    """What the database knows: a worker that is missing, work that failed, files that are damaged."""
    at_work = Study.deleted_at.is_(None), Study.put_away_at.is_(None)
    studies = session.scalars(select(Study.id).where(*at_work)).all()
    seen_at = session.scalar(select(func.max(WorkerPresence.last_seen_at)))
    if studies and (seen_at is None or now() - seen_at > WORKER_SILENCE):
        yield Trouble("worker", "No worker gives a sign of life. Answers are kept; nobody's model is made. Start one.")
    for study_id in sorted({run.study_id for run in run_list.failures(session)} & {*studies}):
        yield Trouble(
            f"failed work of study {study_id}",
            f"Work has failed and waits for somebody. Its study says which: {settings.base_url}/studies",
        )
    if words := store.trouble():
        yield Trouble("storage", words)
    if lost := len(damage.standing(session, store, true()).others):
        yield Trouble("damage", f"Stored files are damaged: {lost}. To see which: python -m app scrub")
