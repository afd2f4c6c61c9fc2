"""Asking for files that the worker makes: the whole data of a study, or an archive of it."""

from collections.abc import Sequence
from enum import StrEnum
from http import HTTPStatus

from sqlalchemy import select
from sqlalchemy.orm import Session

from app.domain.models import Export, Run, RunKind, RunStatus
from app.domain.run_keys import RunKey
from app.domain.studies import Study
from app.errors import AppError
from app.services import audit
from app.storage import ArtefactStore


class ExportKind(StrEnum):
    """What can be asked for."""

    DATA = "data"
    """Tables, figures and arrays, for analysis."""
    LEROBOT = "lerobot"
    """Clips, trajectories and preferences as a LeRobotDataset, which is a dataset folder of Hugging Face as well."""
    ARCHIVE = "archive"
    """The study itself, for another installation."""


class ExportNotFound(AppError):
    """There is no such file, it is not finished yet, or somebody in it has withdrawn. Look at the page of exports."""

    status = HTTPStatus.NOT_FOUND


def request(session: Session, study: Study, kind: ExportKind, actor: str) -> Export:
    """Ask for a file; while one of the kind is being made, that is the one."""
    waiting = select(Export).where(Export.study_id == study.id, Export.kind == kind, Export.finished_at.is_(None))
    known = session.scalar(waiting.limit(1))
    if known is not None:
        return known
    export = Export(study_id=study.id, kind=kind, requested_by=actor)
    session.add(export)
    session.flush()
    audit.record(session, actor, f"{kind} export requested", study.slug, study=study)
    return export


def of_study(session: Session, study: Study) -> Sequence[Export]:
    """Every file that was asked for, the newest first."""
    return session.scalars(select(Export).where(Export.study_id == study.id).order_by(Export.id.desc())).all()


def key_of(export: Export) -> RunKey:
    """The key of the run that makes the file."""
    return RunKey(RunKind.EXPORT, export.study_id, subject=export.kind, number=export.id)


def run_of(session: Session, export: Export) -> Run | None:
    """The run that makes the file, while it works or after it failed."""
    run = session.scalar(select(Run).where(Run.kind == RunKind.EXPORT, Run.workflow_id == str(key_of(export))))
    return run if run is not None and run.status != RunStatus.SUCCEEDED else None


def find(session: Session, store: ArtefactStore, study: Study, export_id: int) -> Export:
    """A finished file of this study. Raises ExportNotFound."""
    export = session.scalar(select(Export).where(Export.id == export_id, Export.study_id == study.id))
    if export is None or export.artefact_sha256 is None or not store.has(export.artefact_sha256):
        raise ExportNotFound
    return export
