"""Files that somebody has asked for: the whole data of a study as one zip, or an archive for another installation."""

import json
import tempfile
import zipfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as parquet
from sqlalchemy import select
from sqlalchemy.orm import Session

from app.db import now
from app.domain.models import Export, RunKind
from app.domain.studies import Deviation, Participant, Study
from app.errors import AppError
from app.services import (
    archive,
    export_requests,
    export_rows,
    export_tables,
    exporting,
    planning,
    reports,
    unblinding,
)
from app.services.export_requests import ExportKind
from app.services.exporting import Kind, Provenance, Table
from worker import preference_arrays
from worker.records import Job
from worker.workplace import Step, Workplace

DOCS = Path(__file__).resolve().parents[1] / "docs"
_ARROW = {
    Kind.TEXT: pa.string(),
    Kind.INTEGER: pa.int64(),
    Kind.NUMBER: pa.float64(),
    Kind.BOOLEAN: pa.bool_(),
    Kind.TIME: pa.timestamp("ms", "UTC"),
    Kind.JSON: pa.string(),
}


class SomebodyWithdrew(AppError):
    """Somebody withdrew while the file was made, so it was thrown away. Please ask for it again."""


def due(session: Session, study: Study) -> list[Job]:
    """Files that were asked for and are not there."""
    waiting = select(Export).where(Export.study_id == study.id, Export.finished_at.is_(None)).order_by(Export.id)
    return [Job(export_requests.finding(each), RunKind.EXPORT, study.id) for each in session.scalars(waiting)]


def make(place: Workplace, job: Job, run_id: int, step: Step) -> None:
    """Make the file that the finding names."""
    step("make", _make, place, int(job.finding.rpartition("-")[2]), run_id)


def _make(place: Workplace, export_id: int, run_id: int) -> str:
    """The artefact's hash."""
    with place.database.reading() as session:
        export = session.get_one(Export, export_id)
        study_id, kind = export.study_id, ExportKind(export.kind)
        gone = _gone(session, study_id)
    with _workspace(place) as folder:
        path = folder / "export.zip"
        place.report(run_id, "writing the file", 0.1)
        with place.database.reading() as session:
            study = session.get_one(Study, study_id)
            if kind is ExportKind.DATA:
                write_data(session, place, study, path)
            else:
                archive.write(session, place.store, study, path)
        byte_count, sha256 = path.stat().st_size, place.store.take(path)
    with place.database.writing() as session:
        if _gone(session, study_id) != gone:
            place.store.delete(sha256)
            raise SomebodyWithdrew
        export = session.get_one(Export, export_id)
        export.artefact_sha256, export.byte_count, export.finished_at = sha256, byte_count, now()
    return sha256


@contextmanager
def _workspace(place: Workplace) -> Iterator[Path]:
    """A folder on the disk of the store, gone afterwards whatever happens."""
    base = place.store.unfinished(0).parent
    base.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=base, prefix="export-") as folder:
        yield Path(folder)


def _gone(session: Session, study_id: int) -> Sequence[int]:
    people = select(Participant.id).where(Participant.study_id == study_id, Participant.withdrawn_at.is_not(None))
    return session.scalars(people.order_by(Participant.id)).all()


def write_data(session: Session, place: Workplace, study: Study, path: Path) -> None:
    """Tables in three formats, their dictionary, the report with its figures, and preference pairs as arrays."""
    provenance = exporting.provenance_of(session, study)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as target:
        for table in export_tables.TABLES:
            _write_table(target, session, study, table, provenance)
        target.writestr("dictionary.csv", exporting.dictionary_csv(export_tables.TABLES))
        target.writestr("dictionary.md", exporting.dictionary_markdown(export_tables.TABLES))
        target.writestr("provenance.json", _json(_provenance(session, study, provenance)))
        pictures = _write_report(target, session, place, study)
        people = _write_pairs(target, session, place, study)
        target.writestr("README.md", _readme(session, study, provenance, pictures, people))


def _write_table(target: zipfile.ZipFile, session: Session, study: Study, table: Table, provenance: Provenance) -> None:
    for kind, write in (("csv", exporting.csv_lines), ("jsonl", exporting.json_lines)):
        with target.open(f"{kind}/{table.name}.{kind}", "w") as stream:
            for line in write(table, session, study, provenance):
                stream.write(line.encode())
    with target.open(f"parquet/{table.name}.parquet", "w") as stream:
        parquet.write_table(arrow_table(table, session, study, provenance), stream)


def arrow_table(table: Table, session: Session, study: Study, provenance: Provenance) -> pa.Table:
    """The table with typed columns; json columns are text, and meanings are kept with the columns."""
    columns = table.all_columns
    rows = [(*values, *provenance.values) for values in table.rows(session, study)]
    arrays = [
        pa.array([_arrow_value(column.kind, row[place]) for row in rows], _ARROW[column.kind])
        for place, column in enumerate(columns)
    ]
    fields = [
        pa.field(column.name, _ARROW[column.kind], metadata={"meaning": column.meaning, "unit": column.unit})
        for column in columns
    ]
    return pa.Table.from_arrays(arrays, schema=pa.schema(fields))


def _arrow_value(kind: Kind, value: Any) -> Any:
    return json.dumps(value, ensure_ascii=False) if kind is Kind.JSON and value is not None else value


def _write_report(target: zipfile.ZipFile, session: Session, place: Workplace, study: Study) -> list[str]:
    report = reports.newest(session, study)
    if report is None:
        return []
    target.writestr("report/report.json", _json({"made_at": report.created_at.isoformat(), **report.contents}))
    for name, formats in sorted(report.figures.items()):
        for kind, sha256 in formats.items():
            target.writestr(f"report/{name}.{kind}", place.store.read(sha256))
    return sorted(report.figures)


def _write_pairs(target: zipfile.ZipFile, session: Session, place: Workplace, study: Study) -> list[str]:
    written = []
    for person in export_rows.everybody(session, study):
        arrays = preference_arrays.arrays_of(session, place.store, study, person)
        if arrays is not None:
            target.writestr(f"pairs/{person.code}.npz", arrays)
            written.append(person.code)
    if (DOCS / "arrays.md").exists():
        target.writestr("pairs/README.md", (DOCS / "arrays.md").read_text())
    return written


def _provenance(session: Session, study: Study, provenance: Provenance) -> dict[str, Any]:
    """Everything that says what this study was and what these files are."""
    deviations = session.scalars(select(Deviation).where(Deviation.study_id == study.id).order_by(Deviation.id))
    return {
        "study": study.slug,
        "name": study.name,
        "task": study.task,
        "seed": study.seed,
        "settings": study.stored_settings,
        "lock_hash": provenance.lock_hash,
        "locked_at": study.locked_at.isoformat() if study.locked_at else None,
        "lock_document": study.lock_document,
        "deviations": [
            {"at": each.at.isoformat(), "actor": each.actor, "reason": each.reason}
            | {"before": each.before, "after": each.after}
            for each in deviations
        ],
        "blinded": unblinding.is_blinded(study),
        "unblinded_at": study.unblinded_at.isoformat() if study.unblinded_at else None,
        "software_version": provenance.software_version,
        "exported_at": provenance.exported_at.isoformat(),
    }


def _readme(
    session: Session, study: Study, provenance: Provenance, pictures: Sequence[str], people: Sequence[str]
) -> str:
    deviations = _provenance(session, study, provenance)["deviations"]
    listed = "\n".join(f"* {each['at']}, {each['actor']}: {each['reason']}" for each in deviations) or "None."
    blinded = (
        "The study is blinded: letters stand for methods, and no file here says which is which."
        if unblinding.is_blinded(study)
        else "The study is not blinded (any more)."
    )
    return _README.format(
        name=study.name,
        slug=study.slug,
        lock=provenance.lock_hash,
        version=provenance.software_version,
        moment=provenance.exported_at.isoformat(timespec="seconds"),
        blinded=blinded,
        plan=planning.plan_of(session, study).in_words,
        deviations=listed,
        figures=", ".join(pictures) or "none yet",
        people=", ".join(people) or "nobody yet",
    )


_README = """\
# {name} ({slug})

Exported {moment} by PbARL Studio {version}. Lock hash of settings and plan: {lock}. {blinded}

| what | where |
|---|---|
| tables | `csv/`, `jsonl/`, `parquet/`: the same rows three times |
| what every column means | `dictionary.csv`, `dictionary.md` |
| settings, seed, lock, deviations | `provenance.json` |
| statistics and figures ({figures}) | `report/` |
| preference pairs as arrays ({people}) | `pairs/`, explained in `pairs/README.md` |

Open the tables with `pandas.read_parquet("parquet/ratings.parquet")` or, in R, `arrow::read_parquet` or `read.csv`.
Participants who withdrew are tombstones in `participants`, and nothing of them is anywhere else.

## What was planned
{plan}

## Deviations from the locked plan
{deviations}
"""


def _json(value: Any) -> str:
    return json.dumps(value, indent=2, ensure_ascii=False) + "\n"
