"""A whole study as one file that another installation imports: rows, files, and the hashes of all of them.

    manifest.json          format, version, and what every other file must hash to
    rows/<table>.jsonl     rows with the ids they had; of links of participants and of joining nothing
    rows/<table>.sealed    instead, for what says which letter hides which method, while a study is blinded
    files/<sha256>         artefacts under the hash of their content

Tables are found by their foreign keys, so a new one belongs to it by itself. On import ids are given anew, everything
is checked before anything is kept, and participants get new links. What can be made again (reports, exports) is not in
it, and neither are browsers' sessions, previews and the audit log of the installation.
"""

import base64
import hashlib
import json
import re
import uuid
import zipfile
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from http import HTTPStatus
from pathlib import Path
from typing import IO, Any

from sqlalchemy import ColumnElement, Table, and_, insert, or_, select, update
from sqlalchemy.orm import Session

from app.db import Base, UtcDateTime, now
from app.domain.models import Export, Report, Run, RunKind, RunStatus
from app.domain.people import BrowserSession
from app.domain.studies import Participant, Study, StudySettings
from app.errors import AppError
from app.services import audit, enrolment, exporting, studies, unblinding
from app.services.withdrawal import ARTEFACT_COLUMNS, in_use
from app.storage import ArtefactStore

FORMAT, VERSION = "pbarl-studio-archive", 1
LEFT_OUT = {each.__tablename__ for each in (BrowserSession, Report, Export)}
SECRETS = {"study": {"join_token"}, "participant": {"token_sha256"}}
"""Columns that never leave: with them somebody could answer in somebody else's name."""
KEY_TABLES = {"assignment", "trial"}
"""Letters with their methods, and with their films."""
_REMADE = (RunKind.REPORT, RunKind.EXPORT)
_PLACES = {"participant": "participant", "study": "study", "answer": "label_event", "exclusion": "exclusion"}
"""What the numbers in names of runs are ids of: reward/participant-12/labels-200/answer-345-exclusion-6."""
_SHA256 = re.compile(r"[0-9a-f]{64}")


class ArchiveInvalid(AppError):
    """This file is not an archive of a study, or it is damaged. Nothing was imported."""

    status = HTTPStatus.UNPROCESSABLE_ENTITY


@dataclass(frozen=True)
class Imported:
    """A study that has arrived, and the new personal links' tokens by participant code."""

    study: Study
    tokens: Sequence[tuple[str, str]]


@dataclass(frozen=True)
class Unpacked:
    """An archive that was found to be whole; its files are in the store already."""

    rows: Mapping[str, Sequence[dict[str, Any]]]
    put: Sequence[str]
    """hashes of files that were not in the store before"""


# --- out ---


def write(session: Session, store: ArtefactStore, study: Study, path: Path) -> None:
    """Write the study to a zip file."""
    tables: dict[str, dict[str, Any]] = {}
    files: dict[str, int] = {}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for table, condition in _tables_of(study.id):
            rows = [_as_stored(table, row) for row in session.execute(_select(table, condition)).mappings()]
            content = "".join(json.dumps(row, ensure_ascii=False) + "\n" for row in rows).encode()
            sealed = table.name in KEY_TABLES and unblinding.is_blinded(study)
            archive.writestr(_place(table.name, sealed), _seal(content) if sealed else content)
            tables[table.name] = {"rows": len(rows), "sha256": hashlib.sha256(content).hexdigest(), "sealed": sealed}
            for sha256 in sorted(set(_artefacts(table.name, rows)) - files.keys()):
                if store.has(sha256):  # what was lost long ago must not keep the rest from being saved
                    stored = store.read(sha256)
                    archive.writestr(zipfile.ZipInfo(f"files/{sha256}"), stored)  # videos do not get any smaller
                    files[sha256] = len(stored)
        manifest = {
            "format": FORMAT,
            "version": VERSION,
            "software_version": exporting.software_version(),
            "written_at": now().isoformat(),
            "study": study.slug,
            "lock_hash": study.lock_hash,
            "tables": tables,
            "files": files,
        }
        archive.writestr("manifest.json", json.dumps(manifest, indent=2))


def _place(table_name: str, sealed: bool) -> str:
    return f"rows/{table_name}.{'sealed' if sealed else 'jsonl'}"


def _seal(content: bytes) -> bytes:
    """Nobody reads this by accident, nor finds it by searching. It is no secret from those who want to know."""
    return base64.b64encode(zlib.compress(content))


def _unseal(content: bytes) -> bytes:
    try:
        return zlib.decompress(base64.b64decode(content, validate=True))
    except zlib.error as error:
        raise ArchiveInvalid from error


def _tables_of(study_id: int) -> Iterator[tuple[Table, ColumnElement[bool]]]:
    """Every table with rows of the study, parents first, and which rows those are."""
    root = Base.metadata.tables[Study.__tablename__]
    found: dict[Table, ColumnElement[bool]] = {root: root.c.id == study_id}
    yield root, found[root]
    for table in Base.metadata.sorted_tables:
        keys = [key for key in table.foreign_keys if key.column.table in found and key.column.table is not table]
        if not keys or table.name in LEFT_OUT:
            continue
        inside = [key.parent.in_(select(key.column).where(found[key.column.table])) for key in keys]
        # A row belongs to the study when one of its keys does, and none leads to a row that is left out.
        belongs = [or_(key.parent.is_(None), each) for key, each in zip(keys, inside, strict=True)]
        found[table] = and_(or_(*inside), *belongs, *_not_left_out(table))
        yield table, found[table]


def _not_left_out(table: Table) -> list[ColumnElement[bool]]:
    if table.name == Participant.__tablename__:
        return [table.c.is_preview.is_(False)]
    return [table.c.kind.not_in(_REMADE)] if table.name == Run.__tablename__ else []


def _select(table: Table, condition: ColumnElement[bool]) -> Any:
    return select(table).where(condition).order_by(table.c.id)


def _as_stored(table: Table, row: Mapping[Any, Any]) -> dict[str, Any]:
    secret = SECRETS.get(table.name, set())
    return {
        name: value.isoformat() if isinstance(value, datetime) else value
        for name, value in row.items()
        if name not in secret
    }


def _artefacts(table_name: str, rows: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    names = [column.key for column in ARTEFACT_COLUMNS if column.class_.__tablename__ == table_name]
    yield from (row[name] for row in rows for name in names if row.get(name))


# --- in ---


def read(session: Session, store: ArtefactStore, source: Path | IO[bytes], actor: str) -> Imported:
    """Import what write() has written, completely or not at all. Raises ArchiveInvalid."""
    return bring_in(session, store, unpack(store, source), actor)


def unpack(store: ArtefactStore, source: Path | IO[bytes]) -> Unpacked:
    """Check everything and store the files: what takes time and needs no database. Raises ArchiveInvalid."""
    try:
        with zipfile.ZipFile(source) as archive:
            manifest = _manifest(archive)
            rows = {name: _rows(archive, name, manifest) for name in manifest["tables"]}
            _check(rows, manifest)
            return Unpacked(rows, _put_files(archive, store, manifest))
    except (zipfile.BadZipFile, KeyError, TypeError, ValueError, EOFError) as error:
        raise ArchiveInvalid from error


def bring_in(session: Session, store: ArtefactStore, unpacked: Unpacked, actor: str) -> Imported:
    """Add the rows; if that fails, the files go as well. Raises ArchiveInvalid."""
    try:
        with session.begin_nested():
            return _insert(session, unpacked.rows, actor)
    except Exception as error:
        for sha256 in set(unpacked.put) - in_use(session, unpacked.put):
            store.delete(sha256)
        if isinstance(error, AppError):
            raise
        raise ArchiveInvalid(
            f"The rows of this archive do not fit together ({type(error).__name__}). Nothing was imported."
        ) from error


def _manifest(archive: zipfile.ZipFile) -> dict[str, Any]:
    manifest: dict[str, Any] = json.loads(archive.read("manifest.json"))
    if manifest.get("format") != FORMAT:
        raise ArchiveInvalid
    if manifest["version"] != VERSION:
        raise ArchiveInvalid(
            f"This archive has version {manifest['version']}, and this installation reads version {VERSION}. "
            "Update the older of the two installations."
        )
    return manifest


def _rows(archive: zipfile.ZipFile, name: str, manifest: Mapping[str, Any]) -> list[dict[str, Any]]:
    table = Base.metadata.tables.get(name)
    if table is None or name in LEFT_OUT:
        raise ArchiveInvalid(f"This archive holds a table that this version does not know: {name[:40]}.")
    sealed = bool(manifest["tables"][name].get("sealed"))
    content = archive.read(_place(name, sealed))
    content = _unseal(content) if sealed else content
    if hashlib.sha256(content).hexdigest() != manifest["tables"][name]["sha256"]:
        raise ArchiveInvalid(f"The table {name} in this archive is damaged. Nothing was imported.")
    rows = [json.loads(line) for line in content.decode().splitlines()]
    unknown = {column for row in rows for column in row} - {column.name for column in table.columns}
    if unknown:
        raise ArchiveInvalid(f"The table {name} has columns that this version does not know: {min(unknown)[:40]}.")
    return [_from_stored(table, row) for row in rows]


def _from_stored(table: Table, row: Mapping[str, Any]) -> dict[str, Any]:
    return {
        name: datetime.fromisoformat(value) if value is not None and _is_time(table, name) else value
        for name, value in row.items()
    }


def _is_time(table: Table, name: str) -> bool:
    return isinstance(table.c[name].type, UtcDateTime)


def _check(rows: Mapping[str, Sequence[Mapping[str, Any]]], manifest: Mapping[str, Any]) -> None:
    """One study, its settings readable, and every file that rows name in the archive."""
    (study,) = rows["study"]
    StudySettings.model_validate(study["stored_settings"])
    named = {sha256 for name, each in rows.items() for sha256 in _artefacts(name, each)}
    if not all(isinstance(each, str) and _SHA256.fullmatch(each) for each in (*named, *manifest["files"])):
        raise ArchiveInvalid


def _put_files(archive: zipfile.ZipFile, store: ArtefactStore, manifest: Mapping[str, Any]) -> list[str]:
    """Store every file; those that were not there before are returned. Raises ArchiveInvalid when one is damaged."""
    put: list[str] = []
    try:
        for sha256, size in manifest["files"].items():
            if archive.getinfo(f"files/{sha256}").file_size != size:
                raise ArchiveInvalid("A file in this archive is damaged. Nothing was imported.")
            if store.has(sha256):
                continue
            content = archive.read(f"files/{sha256}")
            if hashlib.sha256(content).hexdigest() != sha256:
                raise ArchiveInvalid("A file in this archive is damaged. Nothing was imported.")
            put.append(store.put(content))
    except BaseException:
        for sha256 in put:
            store.delete(sha256)
        raise
    return put


def _insert(session: Session, rows: Mapping[str, Sequence[dict[str, Any]]], actor: str) -> Imported:
    ids: dict[str, dict[int, int]] = {}
    for table in Base.metadata.sorted_tables:
        if table.name not in rows:
            continue
        prepared = [_prepared(session, table, dict(row), ids) for row in rows[table.name]]
        ids[table.name] = _insert_rows(session, table, rows[table.name], prepared, ids)
    session.expire_all()
    _name_runs(session, rows.get("run", ()), ids)
    study = session.get_one(Study, next(iter(ids["study"].values())))
    audit.record(session, actor, "study imported", study.slug)
    return Imported(study, _new_links(session, study, actor))


def _prepared(
    session: Session, table: Table, row: dict[str, Any], ids: Mapping[str, Mapping[int, int]]
) -> dict[str, Any]:
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
    if "client_uuid" in row and _is_taken(session, table, row["client_uuid"]):
        row["client_uuid"] = str(uuid.uuid4())
    return row


def _is_taken(session: Session, table: Table, client_uuid: str) -> bool:
    return session.execute(select(table.c.id).where(table.c.client_uuid == client_uuid)).first() is not None


def _insert_rows(
    session: Session,
    table: Table,
    rows: Sequence[Mapping[str, Any]],
    prepared: list[dict[str, Any]],
    ids: Mapping[str, Mapping[int, int]],
) -> dict[int, int]:
    """New ids by old ones. Keys to the same table are set afterwards, when both ends are there."""
    own = [key.parent.name for key in table.foreign_keys if key.column.table is table]
    later = [{name: row.pop(name, None) for name in own} for row in prepared]
    if not prepared:
        return {}
    names = sorted(set().union(*prepared))  # one statement for all rows, so all have the same columns
    complete = [{name: row.get(name) for name in names} for row in prepared]
    given = session.scalars(insert(table).returning(table.c.id, sort_by_parameter_order=True), complete).all()
    new = {row["id"]: number for row, number in zip(rows, given, strict=True)}
    for number, keys in zip(given, later, strict=True):
        values = {name: new[value] for name, value in keys.items() if value is not None}
        if values:
            session.execute(update(table).where(table.c.id == number).values(values))
    return new


def _name_runs(session: Session, runs: Sequence[Mapping[str, Any]], ids: Mapping[str, Mapping[int, int]]) -> None:
    """Runs keep their names with new numbers, so that the worker finds done what was done."""

    def renumbered(match: re.Match[str]) -> str:
        known = ids.get(_PLACES[match[1]], {})
        return f"{match[1]}-{known.get(int(match[2]), 0)}"

    for run in runs:
        name = re.sub(rf"\b({'|'.join(_PLACES)})-(\d+)", renumbered, run["workflow_id"])
        if session.scalar(select(Run.id).where(Run.workflow_id == name)) is not None:
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
