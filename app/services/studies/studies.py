"""Studies: making one, finding one."""

import re
import secrets
import unicodedata
from http import HTTPStatus
from typing import TypeVar

from sqlalchemy import ColumnElement, func, select
from sqlalchemy.orm import Session

from app.db import Base
from app.domain.clips import Clip, Rollout
from app.domain.studies import SEED_LIMIT, Study
from app.domain.study_settings import StudySettings
from app.errors import AppError
from app.installed_tasks import catalogue
from app.services import audit
from app.services.studies import task_limits

_Row = TypeVar("_Row", bound=Base)


class StudyNotFound(AppError):
    """There is no such study. It may have been renamed; the list of studies shows what there is."""

    status = HTTPStatus.NOT_FOUND


def create_study(
    session: Session,
    name: str,
    settings: StudySettings,
    seed: int | None = None,
    actor: str = audit.SYSTEM,
    task: str | None = None,
    like: Study | None = None,
) -> Study:
    """Open a study; the worker finds it and begins to fill its pool. Without a seed one is drawn and kept.

    Without a task it is the usual one. ``like``: a study whose recordings it shows, too, if it has any.
    Raises TaskCannot.
    """
    task = task or catalogue.usual()
    task_limits.require(task, settings, recorded=like is not None and like.material is not None)
    study = Study(
        slug=free_slug(session, name),
        name=name,
        task=task,
        stored_settings=settings.model_dump(mode="json"),
        seed=new_seed() if seed is None else seed,
    )
    session.add(study)
    session.flush()
    audit.record(session, actor, "study created", study.slug, study=study)
    if like is not None:
        copy_material(session, like, study)
    return study


def find_study(session: Session, slug: str) -> Study:
    """The study of that slug. Raises StudyNotFound."""
    study = session.scalar(select(Study).where(Study.slug == slug, Study.deleted_at.is_(None)))
    if study is None:
        raise StudyNotFound
    return study


def others_named(session: Session, name: str, theirs: ColumnElement[bool], study: Study | None = None) -> bool:
    """Whether another one of ``theirs``, studies somebody may see, has this name, however it is capitalised."""
    known = session.execute(select(Study.id, Study.name).where(Study.deleted_at.is_(None), theirs))
    return any(other != (study.id if study else None) and each.casefold() == name.casefold() for other, each in known)


def count_put_away(session: Session, theirs: ColumnElement[bool]) -> int:
    """How many of these studies are put away."""
    away = select(func.count(Study.id)).where(Study.put_away_at.is_not(None), Study.deleted_at.is_(None), theirs)
    return session.scalar(away) or 0


def copy_material(session: Session, source: Study, study: Study) -> None:
    """Give a study the clips of another one that were made elsewhere; clips that are simulated it makes itself."""
    study.material = source.material
    if source.material is None:
        return
    for rollout in session.scalars(select(Rollout).where(Rollout.study_id == source.id).order_by(Rollout.id)).all():
        clips = session.scalars(select(Clip).where(Clip.rollout_id == rollout.id).order_by(Clip.id)).all()
        copy = _copied(rollout, study_id=study.id)
        session.add(copy)
        session.flush()
        session.add_all(_copied(clip, rollout_id=copy.id) for clip in clips)
    session.flush()


def _copied(row: _Row, **columns: object) -> _Row:
    """A new row like this one, but for these columns."""
    names = [column.key for column in row.__table__.columns if column.key != "id"]
    return type(row)(**{name: getattr(row, name) for name in names} | columns)


def new_seed() -> int:
    """A seed for a study, drawn."""
    return secrets.randbelow(SEED_LIMIT)


def free_slug(session: Session, name: str) -> str:
    """A readable address made of the name, with a number behind it when it is taken."""
    plain = unicodedata.normalize("NFKD", name).encode("ascii", "ignore").decode().lower()
    base = re.sub(r"[^a-z0-9]+", "-", plain).strip("-")[:60] or "study"
    taken = set(session.scalars(select(Study.slug).where(Study.slug.startswith(base, autoescape=True))))
    reserved = {"new", "live", "texts"}  # our own addresses
    number, slug = 1, base
    while slug in taken | reserved:
        number += 1
        slug = f"{base}-{number}"
    return slug
