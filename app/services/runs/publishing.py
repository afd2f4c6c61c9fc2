"""Finding what was published, and asking for failed work again."""

from collections.abc import Sequence
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


def newest_bundles(
    session: Session, store: ArtefactStore, people: Sequence[Participant]
) -> Sequence[tuple[Participant, Bundle]]:
    """The newest bundle of each of these people that is there, in their order."""
    theirs = select(Bundle).where(Bundle.participant_id.in_([each.id for each in people])).order_by(Bundle.version)
    newest = {bundle.participant_id: bundle for bundle in session.scalars(theirs) if store.has(bundle.artefact_sha256)}
    return [(each, newest[each.id]) for each in people if each.id in newest]


def retry_run(session: Session, study: Study, run_id: int, actor: str) -> Run:
    """Ask for another attempt at a failed run; on a run that has not failed this does nothing. Raises RunNotFound."""
    run = session.scalar(select(Run).where(Run.id == run_id, Run.study_id == study.id).with_for_update())
    if run is None:
        raise RunNotFound
    if run.status == RunStatus.FAILED:
        run.status = RunStatus.RETRY
        whose = session.get(Participant, run.participant_id) if run.participant_id is not None else None
        audit.record(session, actor, "run retried", run.workflow_id, study=study, participant=whose)
    return run
