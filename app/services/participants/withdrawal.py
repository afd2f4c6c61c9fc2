"""Withdrawing: everything about a person is erased, rows and files; a tombstone says that, and not what.

What the worker keeps for itself (its engine's notes, results of work that was still running) it erases when it finds
``withdrawn_at`` without ``erased_at``.
"""

from collections.abc import Collection, Iterable, Iterator, Mapping
from typing import Any

from sqlalchemy import ColumnElement, Table, delete, func, select, update
from sqlalchemy.orm import InstrumentedAttribute, Session

from app.db import Base, now
from app.domain import participation, preferences  # noqa: F401  (their tables belong to what is erased)
from app.domain.clips import Clip, Rollout
from app.domain.evaluation import Controller, Film, SharedFilter
from app.domain.models import Bundle, Export, Model, Report, Run, RunKind
from app.domain.self_setting import PreviewFilm
from app.domain.studies import Participant, Study
from app.domain.study_settings import StudySettings
from app.services import audit
from app.services.auditing import receipts
from app.services.auditing.receipts import ROWS_AND_FILES, Erased
from app.services.evaluation import donors
from app.services.participants import visits
from app.storage import ArtefactStore

ARTEFACT_COLUMNS: tuple[InstrumentedAttribute[Any], ...] = (
    Rollout.trajectory_sha256,
    Clip.video_sha256,
    Clip.poster_sha256,
    Film.trajectory_sha256,
    Film.video_sha256,
    Film.poster_sha256,
    PreviewFilm.video_sha256,
    PreviewFilm.poster_sha256,
    Controller.artefact_sha256,
    SharedFilter.artefact_sha256,
    Model.artefact_sha256,
    Bundle.artefact_sha256,
    Export.artefact_sha256,
)
"""Every column that names a file of the artefact store. Report.figures does so too, inside its JSON."""

KEPT_COLUMNS = frozenset(
    {"id", "study_id", "number", "token_sha256", "seed", "created_at", "is_preview", "scripted_as", "visit"}
    | {"withdrawn_at", "erased_at"}
)
"""Of the tombstone: what makes the code, and what lets the old link end at a page that says what happened."""
_NOT_EMPTIED = frozenset({"created_at", "deleted_at", "erased_at"})


def withdraw(session: Session, store: ArtefactStore, participant: Participant, actor: str) -> None:
    """Erase everything about the participant, now and for good. ``actor``: the person, or who erases at their request.

    Every visit of theirs, for what they said at one of them was learned from at the next. Files go before the
    transaction ends: should it fail, the person is asked to do it again, and nothing is left over.
    """
    for each in visits.everyone_they_were(session, participant):
        study = session.get_one(Study, each.study_id)
        if each.withdrawn_at is None:
            each.withdrawn_at = now()
            audit.record(session, actor, "participant withdrew", study.slug, study=study)
        erase(session, store, each)


def erase(session: Session, store: ArtefactStore, participant: Participant) -> None:
    """Erase rows and files of somebody who has withdrawn. Doing it again erases what has come in since."""
    for column in Participant.__table__.columns:
        if column.name not in KEPT_COLUMNS:
            setattr(participant, column.name, None)
    session.flush()
    artefacts = set(_artefacts(session, participant))
    erased = Erased(audit_rows=audit.forget(session, participant_id=participant.id))
    _erase_made_of_everybody(session, participant.study_id)
    lent, files = donors.release(session, participant)
    artefacts |= files
    _erase_rows(session, personal_rows(participant.id), erased)
    for table, count in lent.items():
        erased.rows[table] = erased.rows.get(table, 0) + count
    session.expire_all()  # what the session remembers of those rows is gone as well
    _erase_files(session, store, artefacts, erased)
    store.unfinished.forget(store.unfinished.folder(participant.id))
    if erased or not receipts.are_there(session, participant):
        receipts.add(session, participant, ROWS_AND_FILES, erased)


def erase_study(session: Session, store: ArtefactStore, study: Study) -> None:
    """Erase everything of a study that is deleted, and everybody in it. Doing it again erases what has come in since.

    Links of participants go on leading to a page that says what happened, so tombstones of them and of the study stay.
    """
    rows = dict(_rows_below(Study.__tablename__, study.id))
    artefacts = set(_artefacts_in(session, rows))
    people = rows.pop(Base.metadata.tables[Participant.__tablename__])
    erased = Erased(audit_rows=audit.forget(session, study_id=study.id))
    _erase_rows(session, rows.items(), erased)
    nothing = {column.name: None for column in Participant.__table__.columns if column.name not in KEPT_COLUMNS}
    withdrawn_at = func.coalesce(Participant.withdrawn_at, study.deleted_at)
    session.execute(update(Participant).where(people).values(nothing | {"withdrawn_at": withdrawn_at}))
    for column in Study.__table__.columns:
        if column.nullable and column.name not in _NOT_EMPTIED:
            setattr(study, column.name, None)
    study.slug, study.name, study.key_secret = f"deleted-{study.id}", "", ""
    study.stored_settings = StudySettings(language=study.settings.language).model_dump(mode="json")
    session.flush()
    session.expire_all()
    _erase_files(session, store, artefacts, erased)
    for participant_id in session.scalars(select(Participant.id).where(Participant.study_id == study.id)):
        store.unfinished.forget(store.unfinished.folder(participant_id))
    if erased or not receipts.are_there(session, study):
        receipts.add(session, study, ROWS_AND_FILES, erased)


def _erase_rows(session: Session, found: Iterable[tuple[Table, ColumnElement[bool]]], erased: Erased) -> None:
    for table, theirs in reversed(list(found)):
        count = session.execute(delete(table).where(theirs)).rowcount  # type: ignore[attr-defined]
        erased.rows[table.name] = count


def _erase_files(session: Session, store: ArtefactStore, artefacts: Collection[str], erased: Erased) -> None:
    for sha256 in set(artefacts) - in_use(session, artefacts):
        store.delete(sha256)
        erased.files += 1


def personal_rows(participant_id: int) -> Iterator[tuple[Table, ColumnElement[bool]]]:
    """Every table that holds something about participants, with which rows are this one's; parents first."""
    return _rows_below(Participant.__tablename__, participant_id)


def _rows_below(root_name: str, root_id: int) -> Iterator[tuple[Table, ColumnElement[bool]]]:
    """Every table with rows that belong to one row, and which those are; parents first.

    Read from the schema, so that a new table belongs to it by its foreign key.
    """
    root = Base.metadata.tables[root_name]
    found: dict[Table, ColumnElement[bool]] = {root: root.c.id == root_id}
    depth = {root: 0}
    for table in Base.metadata.sorted_tables:
        if table is root:
            continue
        parents = [key for key in table.foreign_keys if key.column.table in found and key.column.table is not table]
        direct = [key for key in parents if key.column.table is root]
        # The schema's own order is by chance, and a key that may be empty leads to some of the rows only. The shortest
        # way: SQLite gives up on statements within statements that are six deep.
        parents.sort(key=lambda key: (bool(key.parent.nullable), depth[key.column.table], key.parent.name))
        for key in direct or parents[:1]:
            found[table] = key.parent.in_(select(key.column).where(found[key.column.table]))
            depth[table] = depth[key.column.table] + 1
            yield table, found[table]


def in_use(session: Session, artefacts: Collection[str]) -> set[str]:
    """Which of these artefacts some row still refers to."""
    used: set[str] = set()
    for column in ARTEFACT_COLUMNS:
        used |= {sha256 for sha256 in session.scalars(select(column).distinct()) if sha256 in artefacts}
    for figures in session.scalars(select(Report.figures)):
        used |= _hashes(figures) & set(artefacts)
    return used


def _erase_made_of_everybody(session: Session, study_id: int) -> None:
    """Reports and exports hold something of each participant; new ones are made without this one.

    That an export was asked for is kept: a finished one is taken back, one that is waiting is made without this person.
    """
    session.execute(delete(Report).where(Report.study_id == study_id))
    session.execute(delete(Run).where(Run.study_id == study_id, Run.kind == RunKind.REPORT))
    finished = update(Export).where(Export.study_id == study_id, Export.finished_at.is_not(None))
    session.execute(finished.values(artefact_sha256=None, byte_count=None, missing=None))
    runs = update(Run).where(Run.study_id == study_id, Run.kind == RunKind.EXPORT)
    session.execute(runs.values(stage=""))
    session.execute(runs.where(Run.error.is_not(None)).values(error="It failed before somebody withdrew."))


def _artefacts(session: Session, participant: Participant) -> Iterator[str]:
    """What rows of this person, and everything that was made of the whole study, refer to."""
    yield from _artefacts_in(session, dict(personal_rows(participant.id)))
    exports = select(Export.artefact_sha256).where(Export.study_id == participant.study_id)
    yield from (sha256 for sha256 in session.scalars(exports) if sha256 is not None)
    for figures in session.scalars(select(Report.figures).where(Report.study_id == participant.study_id)):
        yield from _hashes(figures)


def _artefacts_in(session: Session, rows: Mapping[Table, ColumnElement[bool]]) -> Iterator[str]:
    """What these rows refer to."""
    for column in ARTEFACT_COLUMNS:
        table = column.class_.__table__
        if table in rows:
            yield from session.scalars(select(column).where(rows[table], column.is_not(None)))
    reports = Base.metadata.tables[Report.__tablename__]
    if reports in rows:
        for figures in session.scalars(select(Report.figures).where(rows[reports])):
            yield from _hashes(figures)


def _hashes(figures: dict[str, Any]) -> set[str]:
    return {sha256 for formats in figures.values() for sha256 in formats.values()}
