"""Bringing in an archive of a study: completely or not at all, with new ids and links, and nothing of other studies."""

import hashlib
import tempfile
import uuid
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import IO, Any

from sqlalchemy import Table, insert, select, update
from sqlalchemy.orm import Session

from app.domain import run_keys
from app.domain.models import Run, RunStatus
from app.domain.people import AuditEvent
from app.domain.studies import Participant, Study
from app.errors import AppError
from app.services import audit
from app.services.archives import archive_reading
from app.services.archives.archive import ArchiveInvalid, tables_of
from app.services.archives.archive_reading import Checked
from app.services.participants import enrolment
from app.services.participants.withdrawal import in_use
from app.services.studies import studies
from app.storage import ArtefactStore

SIGNATURE_CHECKED, NOT_SIGNED = "signature of archive checked", "not signed"
_ROWS_AT_ONCE = 500
Ids = dict[str, dict[int, int]]
"""By table the new id of every old one."""


@dataclass(frozen=True)
class Imported:
    """A study that has arrived, and the new personal links' tokens by participant code."""

    study: Study
    tokens: Sequence[tuple[str, str]]
    signer: str | None
    """The fingerprint of the key that had signed the archive; None: it was not signed."""


@dataclass(frozen=True)
class Unpacked:
    """An archive that was found to be whole; its files are in the store already."""

    checked: Checked
    put: Sequence[str]
    """hashes of files that were not in the store before"""


def read(session: Session, store: ArtefactStore, source: Path | IO[bytes], actor: str, seal_key: str = "") -> Imported:
    """Import what archive.write() has written, completely or not at all. Raises ArchiveInvalid."""
    with unpack(store, source, seal_key) as unpacked:
        return bring_in(session, store, unpacked, actor)


@contextmanager
def unpack(store: ArtefactStore, source: Path | IO[bytes], seal_key: str = "") -> Iterator[Unpacked]:
    """Check everything and store the files: what takes time and needs no database. Raises ArchiveInvalid."""
    shelf = _Shelf(store)
    with ExitStack() as kept:
        try:
            reading = archive_reading.checked(source, shelf.workspace, seal_key, shelf.take, store.holds)
            checked = kept.enter_context(reading)
        except BaseException:
            shelf.clear()
            raise
        yield Unpacked(checked, shelf.put)


class _Shelf:
    """Stores files, and knows which were not there before."""

    def __init__(self, store: ArtefactStore) -> None:
        self._store = store
        self.workspace = store.unfinished.root
        self.put: list[str] = []

    def take(self, sha256: str, pieces: Iterator[bytes]) -> None:
        """Store a file. One that is here already is written anew: it may have been damaged, and this one is not."""
        known, digest = self._store.holds(sha256), hashlib.sha256()
        with tempfile.TemporaryDirectory(dir=self.workspace, prefix="import-") as folder:
            path = Path(folder) / sha256
            with path.open("wb") as target:
                for piece in pieces:
                    digest.update(piece)
                    target.write(piece)
            if digest.hexdigest() != sha256:
                raise ArchiveInvalid("A file in this archive is damaged. Nothing was imported.")
            self._store.take(path)
        if not known:
            self.put.append(sha256)

    def clear(self) -> None:
        """Remove what was not there before."""
        for sha256 in self.put:
            self._store.delete(sha256)


def bring_in(session: Session, store: ArtefactStore, unpacked: Unpacked, actor: str) -> Imported:
    """Add the rows; if that fails, the files go as well. Raises ArchiveInvalid."""
    try:
        with session.begin_nested():
            if not all(store.holds(sha256) for sha256 in unpacked.checked.manifest.files):
                raise ArchiveInvalid("A file was removed while the archive was read. Import it again.")
            return _insert(session, unpacked.checked, actor)
    except Exception as error:  # whatever a stranger's rows break, the files that came with them go
        for sha256 in set(unpacked.put) - in_use(session, unpacked.put):
            store.delete(sha256)
        if isinstance(error, AppError):
            raise
        raise ArchiveInvalid(
            f"The rows of this archive do not fit together ({type(error).__name__}). Nothing was imported."
        ) from error


def _insert(session: Session, checked: Checked, actor: str) -> Imported:
    ids: Ids = {}
    for table, _ in tables_of(0):
        ids[table.name] = {}
        rows = checked.rows(table.name)
        later: list[tuple[int, dict[str, int]]] = []
        while some := list(islice(rows, _ROWS_AT_ONCE)):
            later += _insert_rows(session, table, some, ids)
        for number, keys in later:
            known = {name: ids[table.name][value] for name, value in keys.items()}
            session.execute(update(table).where(table.c.id == number).values(known))
    session.expire_all()
    _name_runs(session, checked.rows(Run.__tablename__), ids)
    study = session.get_one(Study, next(iter(ids["study"].values())))
    locked = f" (locked, hash {study.lock_hash} recomputed)" if study.lock_hash else ""
    audit.record(session, actor, "study imported", f"{study.slug}{locked}", study=study)
    signer = checked.manifest.signer
    audit.record(session, actor, SIGNATURE_CHECKED, f"{study.slug}: {signer or NOT_SIGNED}", study=study)
    return Imported(study, _new_links(session, study, actor), signer)


def signer_of(session: Session, study: Study) -> tuple[bool, str | None]:
    """Whether the study was imported since signatures are checked, and who had signed its archive."""
    checks = select(AuditEvent.subject).where(AuditEvent.study_id == study.id, AuditEvent.action == SIGNATURE_CHECKED)
    subject = session.scalar(checks.limit(1)) or ""
    signer = subject.rpartition(": ")[2]
    return bool(subject), None if signer == NOT_SIGNED else signer


def _insert_rows(
    session: Session, table: Table, rows: Sequence[dict[str, Any]], ids: Ids
) -> Iterator[tuple[int, dict[str, int]]]:
    """New ids of rows with keys to the same table, and those keys as they were: set when both ends are there."""
    taken = _taken(session, table, rows)
    prepared = [_prepared(session, table, dict(row), ids, taken) for row in rows]
    own = [key.parent.name for key in table.foreign_keys if key.column.table is table]
    later = [{name: value for name in own if (value := row.pop(name, None)) is not None} for row in prepared]
    names = sorted(set().union(*prepared))  # one statement for all rows, so all have the same columns
    complete = [{name: row.get(name) for name in names} for row in prepared]
    given = session.scalars(insert(table).returning(table.c.id, sort_by_parameter_order=True), complete).all()
    ids[table.name].update((row["id"], number) for row, number in zip(rows, given, strict=True))
    return ((number, keys) for number, keys in zip(given, later, strict=True) if keys)


def _prepared(session: Session, table: Table, row: dict[str, Any], ids: Ids, taken: set[str]) -> dict[str, Any]:
    """The row with new ids of what it refers to, and with new values of what must be unique here."""
    del row["id"]
    for key in table.foreign_keys:
        name, parents = key.parent.name, key.column.table.name
        if row.get(name) is not None and parents != table.name:
            row[name] = ids[parents][row[name]]
    if table.name == Study.__tablename__:
        row["slug"] = studies.free_slug(session, row["slug"])
    elif table.name == Participant.__tablename__:
        row["token_sha256"] = _unguessable()  # a hash of nothing that anybody knows: no link leads here
    elif table.name == Run.__tablename__:
        row["workflow_id"] = f"importing/{uuid.uuid4()}"  # until all ids in it are known
        if row["status"] in (RunStatus.RUNNING, RunStatus.RETRY):
            row |= {"status": RunStatus.FAILED, "error": "This run was at work when the study was archived."}
    if row.get("client_uuid") in taken:
        row["client_uuid"] = str(uuid.uuid4())
    return row


def _taken(session: Session, table: Table, rows: Sequence[Mapping[str, Any]]) -> set[str]:
    """Which of the marks that clients gave their answers are used here already."""
    if "client_uuid" not in table.c:
        return set()
    wanted = [row["client_uuid"] for row in rows]
    return set(session.scalars(select(table.c.client_uuid).where(table.c.client_uuid.in_(wanted))))


def _name_runs(session: Session, runs: Iterator[Mapping[str, Any]], ids: Ids) -> None:
    """Runs keep their keys with new numbers, so that the worker finds done what was done."""
    for run in runs:
        key = run_keys.read(run["workflow_id"])
        moved = run_keys.renumbered(key, lambda table, old: ids.get(table, {}).get(old, 0)) if key else None
        name = str(moved or run["workflow_id"])
        if not key or session.scalar(select(Run.id).where(Run.workflow_id == name)) is not None:
            name += f"/imported-{uuid.uuid4()}"
        session.get_one(Run, ids["run"][run["id"]]).workflow_id = name


def _new_links(session: Session, study: Study, actor: str) -> list[tuple[str, str]]:
    people = select(Participant).where(Participant.study_id == study.id, Participant.withdrawn_at.is_(None))
    return [
        (person.code, enrolment.renew_link(session, study, person, actor))
        for person in session.scalars(people.order_by(Participant.number))
    ]


def _unguessable() -> str:
    return hashlib.sha256(uuid.uuid4().bytes + uuid.uuid4().bytes).hexdigest()
