"""A whole study as one file that another installation imports: rows, files, and the hashes of all of them.

    manifest.json          format, version, what every other file must hash to, and a signature (app.signing)
    rows/<table>.jsonl     rows with the ids they had; of links of participants and of joining nothing
    files/<sha256>         artefacts under the hash of their content

While a study is blinded all of that lies in one encrypted file, ``sealed``, beside a manifest that says nothing but
what it is; the study's seal key opens it (app.services.archives.sealing).

Tables are found by their foreign keys, so a new one belongs to it by itself. What can be made again (reports, exports)
is not in it, and neither are browsers' sessions, previews and the audit log of the installation. What must be true of
an archive that comes in is in app.services.archives.archive_reading.
"""

import hashlib
import json
import re
import tempfile
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from datetime import datetime
from http import HTTPStatus
from pathlib import Path
from typing import Any

from pydantic import BaseModel, Field
from sqlalchemy import ColumnElement, Table, and_, or_, select
from sqlalchemy.orm import Session

from app.db import Base, now
from app.domain.evaluation import SharedFilter
from app.domain.models import Export, Report, Run, RunKind
from app.domain.people import ApiToken, BrowserSession, StudyMember
from app.domain.power_plan import PowerPlan
from app.domain.studies import Participant, Study
from app.errors import AppError
from app.services.archives import sealing
from app.services.evaluation import unblinding
from app.services.exports import export_formats
from app.services.participants.withdrawal import ARTEFACT_COLUMNS
from app.signing import SigningKey
from app.storage import ArtefactStore

FORMAT, VERSION = "pbarl-studio-archive", 2
MANIFEST, SEALED = "manifest.json", "sealed"
LARGEST_MANIFEST_BYTES = 8 << 20
LARGEST_ROW_BYTES = 4 << 20
LEFT_OUT = {
    each.__tablename__ for each in (BrowserSession, StudyMember, ApiToken, Report, Export, PowerPlan, SharedFilter)
}
"""Who may come in is a matter of each installation; reports and files are made again."""
SECRETS = {"study": {"join_token"}, "participant": {"token_sha256", "link_revoked_at", "earlier_id"}}
"""Columns that never leave: with them somebody could answer in somebody else's name, and links are new elsewhere; or
they lead to another study, which an archive does not hold."""
REMADE = (RunKind.SHARED, RunKind.REPORT, RunKind.EXPORT, RunKind.POWER)
_ROWS_AT_ONCE = 500
_SHA256 = r"^[0-9a-f]{64}$"


class ArchiveInvalid(AppError):
    """This file is not an archive of a study, or it is damaged. Nothing was imported."""

    status = HTTPStatus.UNPROCESSABLE_ENTITY


class Rows(BaseModel):
    """What the manifest says about one table."""

    rows: int = Field(ge=0)
    sha256: str = Field(pattern=_SHA256)
    sealed: bool = False
    """Version 1: packed so that nobody reads it by accident."""


class Manifest(BaseModel):
    """manifest.json; of a sealed archive the outer one says no more than that it is one."""

    format: str
    version: int
    software_version: str = ""
    written_at: str = ""
    sealed: bool = False
    lock_hash: str | None = None
    tables: dict[str, Rows] = {}
    files: dict[str, int] = {}
    missing: list[str] = []
    """Files that rows name and that could not be put in."""
    signer: str | None = Field(default=None, exclude=True)
    """Whose key has signed this, by its fingerprint; found when it is read, and believed of no file."""


def tables_of(study_id: int) -> Iterator[tuple[Table, ColumnElement[bool]]]:
    """Every table with rows of the study, parents first, and which rows those are."""
    root = Base.metadata.tables[Study.__tablename__]
    found: dict[Table, ColumnElement[bool]] = {root: root.c.id == study_id}
    yield root, found[root]
    for table in Base.metadata.sorted_tables:
        keys = [key for key in table.foreign_keys if key.column.table in found and key.column.table is not table]
        if not keys or table.name in LEFT_OUT:
            continue
        own = [key for key in keys if key.column.table.name == Participant.__tablename__ and not key.parent.nullable]
        if own:  # what else must be there is theirs as well, and SQLite gives up on statements that are nested too deep
            keys = [*own, *(key for key in keys if key.parent.nullable)]
        inside = [key.parent.in_(select(key.column).where(found[key.column.table])) for key in keys]
        # A row belongs to the study when one of its keys does, and none leads to a row that is left out.
        belongs = [or_(key.parent.is_(None), each) for key, each in zip(keys, inside, strict=True)]
        found[table] = and_(or_(*inside), *belongs, *_not_left_out(table))
        yield table, found[table]


def artefacts(table_name: str, row: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """The files that a row names, each with the column that names it."""
    for column in ARTEFACT_COLUMNS:
        if column.class_.__tablename__ == table_name and row.get(column.key):
            yield column.key, row[column.key]


def write(
    session: Session, store: ArtefactStore, study: Study, path: Path, key: SigningKey | None = None
) -> Mapping[str, list[str]]:
    """Write the study to a zip file. Returns the files that are missing or damaged, by what names them.

    ``key``: signs the manifest, and by the hashes in it everything else.
    """
    if not unblinding.is_blinded(study):
        return _write_plain(session, store, study, path, key)
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        plain = Path(folder) / "plain.zip"
        missing = _write_plain(session, store, study, plain, key)
        with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive, plain.open("rb") as source:
            archive.writestr(MANIFEST, _head(sealed=True).model_dump_json(indent=2, include=_OUTSIDE))
            with archive.open(SEALED, "w", force_zip64=True) as target:
                sealing.seal(source, plain.stat().st_size, target, sealing.key_of(study))
    return missing


_OUTSIDE = {"format", "version", "software_version", "written_at", "sealed"}


def _head(**more: Any) -> Manifest:
    moment, software = now().isoformat(), export_formats.software_version()
    return Manifest(format=FORMAT, version=VERSION, software_version=software, written_at=moment, **more)


def _write_plain(
    session: Session, store: ArtefactStore, study: Study, path: Path, key: SigningKey | None
) -> Mapping[str, list[str]]:
    tables: dict[str, Rows] = {}
    named: dict[str, str] = {}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for table, condition in tables_of(study.id):
            tables[table.name] = _write_rows(archive, session, study, table, condition, named)
        files, missing = {}, dict[str, list[str]]()
        for sha256 in sorted(named):
            size = _write_file(archive, store, sha256)
            if size is None:  # what was lost long ago must not keep the rest from being saved
                missing.setdefault(named[sha256], []).append(sha256)
            else:
                files[sha256] = size
        lost = [sha256 for each in missing.values() for sha256 in each]
        manifest = _head(lock_hash=study.lock_hash, tables=tables, files=files, missing=lost)
        document = manifest.model_dump(mode="json")
        archive.writestr(MANIFEST, json.dumps(document if key is None else key.signed(document), indent=2))
    return missing


def _write_rows(
    archive: zipfile.ZipFile,
    session: Session,
    study: Study,
    table: Table,
    condition: ColumnElement[bool],
    named: dict[str, str],
) -> Rows:
    """Write the rows, and note which files they name."""
    count, digest = 0, hashlib.sha256()
    wanted = select(table).where(condition).order_by(table.c.id).execution_options(yield_per=_ROWS_AT_ONCE)
    with (
        session.execute(wanted) as found,
        archive.open(f"rows/{table.name}.jsonl", "w", force_zip64=True) as target,
    ):
        for each in found.mappings():
            row = _as_stored(study, table, each)
            line = json.dumps(row).encode() + b"\n"  # ASCII: no reader can take anything in it for the end of a line
            target.write(line)
            digest.update(line)
            count += 1
            for column, sha256 in artefacts(table.name, row):
                named.setdefault(sha256, f"{table.name}: {column.removesuffix('_sha256')}")
    return Rows(rows=count, sha256=digest.hexdigest())


def _as_stored(study: Study, table: Table, row: Mapping[Any, Any]) -> dict[str, Any]:
    secret = SECRETS.get(table.name, set())
    if table.name == Study.__tablename__ and study.settings.evaluation is None:
        secret = secret | {"key_secret"}  # such an archive is not sealed, and an evaluation may be added later
    return {
        name: value.isoformat() if isinstance(value, datetime) else value
        for name, value in row.items()
        if name not in secret
    }


def _write_file(archive: zipfile.ZipFile, store: ArtefactStore, sha256: str) -> int | None:
    """The size of the file; None when it is missing or damaged."""
    if not re.fullmatch(_SHA256, sha256) or not store.scrub(sha256):
        return None
    artefact = store.verified(sha256)
    entry = zipfile.ZipInfo(f"files/{sha256}")  # one moment for all of them; videos do not get any smaller
    with archive.open(entry, "w", force_zip64=True) as target:
        for piece in artefact.pieces():
            target.write(piece)
    return artefact.stat.byte_count


def _not_left_out(table: Table) -> Sequence[ColumnElement[bool]]:
    if table.name == Participant.__tablename__:
        return [table.c.is_preview.is_(False)]
    return [table.c.kind.not_in(REMADE)] if table.name == Run.__tablename__ else []
