"""Finding what was published, and asking for failed work again."""

from http import HTTPStatus

from sqlalchemy import select
from sqlalchemy.orm import Session

from app.domain.models import Bundle, Run, RunStatus
from app.domain.studies import Participant, Study
from app.errors import AppError
from app.services import audit
from app.storage import ArtefactStore


class BundleNotFound(AppError):
    """There is no such bundle, or its file is missing from the data directory."""

    status = HTTPStatus.NOT_FOUND


class RunNotFound(AppError):
    """There is no such run in this study."""

    status = HTTPStatus.NOT_FOUND


def find_bundle(session: Session, store: ArtefactStore, participant: Participant, version: int) -> Bundle:
    """This version of the participant's bundle, its file present. Raises BundleNotFound."""
    bundle = session.scalar(select(Bundle).where(Bundle.participant_id == participant.id, Bundle.version == version))
    if bundle is None or not store.has(bundle.artefact_sha256):
        raise BundleNotFound
    return bundle


def retry_run(session: Session, study: Study, run_id: int, actor: str) -> Run:
    """Ask for another attempt at a failed run; on a run that has not failed this does nothing. Raises RunNotFound."""
    run = session.scalar(select(Run).where(Run.id == run_id, Run.study_id == study.id).with_for_update())
    if run is None:
        raise RunNotFound
    if run.status == RunStatus.FAILED:
        run.status = RunStatus.RETRY
        audit.record(session, actor, "run retried", run.workflow_id)
    return run
