"""The demo study: what somebody who has just installed the studio finds in it."""

from sqlalchemy.orm import Session

from app.domain.study_settings import StudySettings
from app.errors import AppError
from app.installed_tasks.by_name import usual_behaviours, usual_clip_steps
from app.paths import DEMO_STUDY
from app.services import audit
from app.services.archives import study_import
from app.services.archives.archive import ArchiveInvalid
from app.services.participants import enrolment
from app.services.studies import studies
from app.storage import ArtefactStore

ARCHIVE = DEMO_STUDY
"""A finished study of scripted participants; ``python -m worker demo-study`` makes it anew."""


class DemoMissing(AppError):
    """The demo study that ships with the studio is not there."""


def import_finished(session: Session, store: ArtefactStore) -> str:
    """Import the archive that ships with the studio and add a participant, whose token is returned.

    Raises DemoMissing and ArchiveInvalid; nothing is changed then.
    """
    if not ARCHIVE.is_file():
        raise DemoMissing
    try:
        study = study_import.read(session, store, ARCHIVE, audit.SYSTEM).study
    except OSError as error:
        raise ArchiveInvalid(f"The demo study cannot be imported: {error.strerror}.") from error
    return enrolment.add_participant(session, study)[1]


def make_empty(session: Session, task: str) -> str:
    """Make a study of the task, whose clips have yet to be made, with one participant, whose token is returned."""
    study = studies.create_study(session, f"Demo: {task}", usual_settings(task), task=task)
    return enrolment.add_participant(session, study)[1]


def usual_settings(task: str) -> StudySettings:
    """What suits the task: the length of its clips, and as many ways and situations as it takes."""
    usual = StudySettings()
    ways = usual_behaviours(task, usual.behaviours_per_scenario)
    situations = -(-usual.pool_scenarios * usual.pairs_per_scenario // (ways * (ways - 1) // 2))
    return StudySettings(
        clip_steps=usual_clip_steps(task),
        behaviours_per_scenario=ways,
        pool_scenarios=min(situations, 2 * usual.labels_per_participant),
    )
