"""The demo study that the studio imports at its first start: made by a rehearsal, archived as anybody's study is.

Small, because it lies in the repository: few clips of the quick kind, two robots to rate, one trial of each.
"""

from pathlib import Path

from sqlalchemy import select

from app.db import Database
from app.domain.choices import ClipQuality, Strategy
from app.domain.models import Run, RunStatus
from app.domain.protocol import EvaluatedMethod, EvaluationSettings, PlannedTest
from app.domain.studies import Study
from app.domain.study_settings import StudySettings
from app.services.archives import archive, archive_reading, sealing
from app.storage import ArtefactStore
from worker.experiments.benchmark_cell import PAPER_USERS
from worker.jobs import reconcile
from worker.ml.teachers import Manner
from worker.rehearsal.rehearsal import Rehearsal, Rehearsed
from worker.rehearsal.server import PATIENCE_S, OwnStudio, wait_until

NAME = "Demo: feeding, with scripted participants"
"""Stands in every row of every export."""
TASK = "feeding"
SEED = 1
SETTINGS = StudySettings(
    labels_per_participant=24,
    retrain_every_labels=4,
    filter_milestones=(),
    pool_scenarios=3,
    behaviours_per_scenario=5,
    clip_quality=ClipQuality.QUICK,
    strategy=Strategy.UNIFORM,
    practice_pairs=1,
    evaluation=EvaluationSettings(methods=(EvaluatedMethod.REFERENCE, EvaluatedMethod.PBARL), trials=1),
    debrief=True,
    planned_tests=(PlannedTest.PAIRED_T,),
    consent_duration="about ten minutes",
    consent_payment="none",
    consent_ethics="none: this is a demonstration, not research",
    consent_contact="whoever gave you the link.",
    wording={
        "de:fact-duration": "etwa zehn Minuten",
        "de:fact-payment": "keine",
        "de:fact-ethics": "keines: Dies ist eine Vorführung, keine Forschung",
        "de:fact-contact": "die Person, die Ihnen den Link gegeben hat.",
    },
)
"""Pairs are drawn at random, so that every prediction counts and few answers show whether a model has understood."""


def make(path: Path, directory: Path, seed: int = SEED) -> Rehearsed:
    """Rehearse the study in ``directory`` and write its archive to ``path``, once it was read back."""
    with OwnStudio(directory) as studio:
        database = Database(studio.settings.sqlalchemy_url)
        store = ArtefactStore(directory / "artefacts")
        rehearsal = Rehearsal(database, store, studio.settings.base_url, name=NAME, unhurried=True)
        rehearsed = rehearsal.run(TASK, list(PAPER_USERS.values()), SETTINGS, Manner(), seed)
        wait_until(PATIENCE_S, "still work to do", lambda: _has_everything(database))
        archive_study(database, store, path)
        database.dispose()
    return rehearsed


def _has_everything(database: Database) -> bool | None:
    """Whether an imported copy would be left alone by the worker: nothing is missing or stale, nothing at work."""
    with database.reading() as session:
        at_work = session.scalar(select(Run.id).where(Run.status == RunStatus.RUNNING).limit(1))
        return (at_work is None and not list(reconcile.due(session))) or None


def archive_study(database: Database, store: ArtefactStore, path: Path) -> None:
    """Write the only study there is to a file that any installation imports."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with database.reading() as session:
        study = session.scalars(select(Study)).one()
        archive.write(session, store, study, path)
        archive_reading.verify(path, store.root.parent, sealing.key_of(study))
