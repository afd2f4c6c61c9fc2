"""Stored files that turned out to be damaged or missing: what they were, what uses them, and what helps."""

from collections import defaultdict
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from sqlalchemy import ColumnElement, Select, select
from sqlalchemy.orm import InstrumentedAttribute, Session

from app.domain.clips import Clip, Rollout
from app.domain.evaluation import Film
from app.domain.models import Bundle, Export, Report
from app.domain.studies import Participant, Study
from app.services.participants.withdrawal import ARTEFACT_COLUMNS
from app.storage import ArtefactStore


class Remedy(StrEnum):
    """What helps."""

    WORKER = "the worker makes it again"
    REPORT = "the next report brings it"
    REQUEST = "ask for it again"
    BACKUP = "restore it from a backup"


@dataclass(frozen=True)
class Use:
    """One row that names a stored file."""

    sha256: str
    what: str
    study: str
    remedy: Remedy


@dataclass(frozen=True)
class Damage:
    """All that is wrong with stored files of some studies at this moment, as far as anybody has noticed."""

    mending: int
    """so many are made again without anybody's doing"""
    others: Sequence[Use]

    @property
    def count(self) -> int:
        """How many files there are to speak of."""
        return self.mending + len(self.others)


def standing(session: Session, store: ArtefactStore, theirs: ColumnElement[bool]) -> Damage:
    """What was found and is not back yet; costs a look into a folder that is usually empty."""
    lost = store.lost()
    named = set(session.scalars(select(Study.slug).where(theirs))) if lost else set()
    found = [use for use in uses(session, lost) if use.study in named] if lost else []
    return Damage(
        mending=sum(use.remedy is Remedy.WORKER for use in found),
        others=[use for use in found if use.remedy is not Remedy.WORKER],
    )


def uses(session: Session, artefacts: Collection[str] | None = None) -> Iterator[Use]:
    """Which rows name these artefacts, or any."""
    studies = {study.id: study for study in session.scalars(select(Study))}
    people = {person.id: person for person in session.scalars(select(Participant))}
    for column in ARTEFACT_COLUMNS:
        named = column.is_not(None) if artefacts is None else column.in_(artefacts)
        for row, study_id in session.execute(_with_study(column).where(named)):
            study = studies[study_id]
            person = people.get(getattr(row, "participant_id", 0))
            whose = f" of {person.code}" if person else ""
            what = f"{_WORDS[column.class_.__name__]} {_name(row)}{whose}"
            yield Use(getattr(row, column.key), f"{what}, {_FILES[column.key]}", study.slug, _remedy(column, study))
    for report in session.scalars(select(Report)):
        for name, formats in report.figures.items():
            for kind, sha256 in formats.items():
                if artefacts is None or sha256 in artefacts:
                    yield Use(sha256, f"figure {name}.{kind}", studies[report.study_id].slug, Remedy.REPORT)


def scrub(session: Session, store: ArtefactStore) -> dict[str, list[Use]]:
    """Read every stored file that any row names; what is damaged or missing, by study."""
    whole: dict[str, bool] = {}
    broken: dict[str, list[Use]] = defaultdict(list)
    for use in uses(session):
        if use.sha256 not in whole:
            whole[use.sha256] = store.scrub(use.sha256)
        if not whole[use.sha256]:
            broken[use.study].append(use)
    return broken


_WORDS = {
    "Rollout": "rollout",
    "Clip": "clip",
    "Film": "film",
    "PreviewFilm": "preview film",
    "Controller": "controller",
    "Model": "model",
    "Bundle": "bundle",
    "Export": "export",
}
_FILES = {
    "trajectory_sha256": "trajectory",
    "video_sha256": "video",
    "poster_sha256": "first picture",
    "artefact_sha256": "file",
}


def _with_study(column: InstrumentedAttribute[Any]) -> Select[Any, int]:
    """Rows of the column's table with the id of their study."""
    table = column.class_
    if table is Clip:
        return select(Clip, Rollout.study_id).join(Rollout)
    if hasattr(table, "study_id"):
        return select(table, table.study_id)
    return select(table, Participant.study_id).join(Participant, Participant.id == table.participant_id)


def _name(row: Any) -> str:
    return f"v{row.version}" if isinstance(row, Bundle) else str(row.id)


def _remedy(column: InstrumentedAttribute[Any], study: Study) -> Remedy:
    if column.class_ is Export:
        return Remedy.REQUEST
    simulated = study.material is None
    again = column.class_ in (Rollout, Clip) or column in (Film.video_sha256, Film.poster_sha256)
    return Remedy.WORKER if simulated and again else Remedy.BACKUP
