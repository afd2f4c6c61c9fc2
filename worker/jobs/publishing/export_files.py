"""Files that somebody has asked for: the whole data of a study as one zip, or an archive for another installation."""

import json
import tempfile
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session

from app.db import now
from app.domain.models import Export
from app.domain.studies import Deviation, Study
from app.paths import ANALYSIS, DOCS
from app.services.archives import archive, archive_reading, sealing
from app.services.evaluation import evaluation_plan, unblinding
from app.services.exports import (
    codebook,
    export_formats,
    export_requests,
    export_tables,
    parquet_file,
    whose_rows,
)
from app.services.exports.export_formats import RowProvenance, Table
from app.services.exports.export_requests import ExportKind
from app.services.paper import osf, text
from app.services.runs import reports
from app.services.studies import preregistration
from app.storage import ArtefactMissing
from worker.jobs.publishing import lerobot_files, preference_arrays
from worker.jobs.publishing.scripted_words import scripted_in_words
from worker.jobs.runtime import records
from worker.jobs.runtime.context import Step, WorkerContext
from worker.jobs.runtime.records import Job

Missing = Mapping[str, Sequence[str]]
"""Hashes of stored files that could not be had, by what they are."""


def due(session: Session, study: Study) -> list[Job]:
    """Files that were asked for and are not there."""
    waiting = select(Export).where(Export.study_id == study.id, Export.finished_at.is_(None)).order_by(Export.id)
    return [Job(export_requests.key_of(each), study.id) for each in session.scalars(waiting)]


def make(context: WorkerContext, job: Job, run_id: int, step: Step) -> None:
    """Make the file that the export asks for."""
    step("make", _make, context, job.number, run_id)


def _make(context: WorkerContext, export_id: int, run_id: int) -> str:
    """The artefact's hash. When somebody withdraws meanwhile, the file is thrown away and made again without them."""
    while (sha256 := _made(context, export_id, run_id)) is None:
        context.report(run_id, "writing the file again, because somebody has withdrawn", 0.1)
    return sha256


def _made(context: WorkerContext, export_id: int, run_id: int) -> str | None:
    """The artefact's hash; None when somebody withdrew while it was made."""
    with context.database.reading() as session:
        export = session.get_one(Export, export_id)
        study_id, kind = export.study_id, ExportKind(export.kind)
        gone = records.withdrawn_ids(session, study_id)
    with _workspace(context) as folder:
        path = folder / "export.zip"
        context.report(run_id, "writing the file", 0.1)
        with context.database.reading() as session:
            missing = _write(kind, session, context, session.get_one(Study, study_id), path)
        byte_count, sha256 = path.stat().st_size, context.store.take(path)
    with context.database.writing() as session:
        if records.withdrawn_ids(session, study_id) != gone:
            context.store.delete(sha256)
            return None
        export = session.get_one(Export, export_id)
        export.artefact_sha256, export.byte_count, export.finished_at = sha256, byte_count, now()
        export.missing = dict(missing) or None
    return sha256


def _write(kind: ExportKind, session: Session, context: WorkerContext, study: Study, path: Path) -> Missing:
    if kind is ExportKind.LEROBOT:
        return lerobot_files.write(session, context, study, path)
    return (write_data if kind is ExportKind.DATA else _write_archive)(session, context, study, path)


def _write_archive(session: Session, context: WorkerContext, study: Study, path: Path) -> Missing:
    """Written, and read back as another installation would: nobody is to find out when it is needed."""
    missing = archive.write(session, context.store, study, path, context.key)
    archive_reading.verify(path, path.parent, sealing.key_of(study))
    return missing


@contextmanager
def _workspace(context: WorkerContext) -> Iterator[Path]:
    """A folder on the disk of the store, gone afterwards whatever happens."""
    base = context.store.unfinished.root
    base.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=base, prefix="export-") as folder:
        yield Path(folder)


def write_data(session: Session, context: WorkerContext, study: Study, path: Path) -> Missing:
    """Tables in three formats, their dictionary, the report, text and scripts for a paper, and pairs as arrays.

    A stored file that is missing or damaged is left out, and said to be.
    """
    provenance, missing = export_formats.provenance_of(session, study), dict[str, list[str]]()
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as target:
        for table in export_tables.TABLES:
            _write_table(target, session, study, table, provenance)
        target.writestr("dictionary.csv", export_formats.dictionary_csv(export_tables.TABLES))
        target.writestr("dictionary.md", export_formats.dictionary_markdown(export_tables.TABLES))
        target.writestr("questionnaires.json", _json(codebook.entries(study.settings)))
        target.writestr("questionnaires.md", codebook.markdown(study.settings))
        _write_analysis(target, session, study)
        pictures = _write_report(target, session, context, study, missing)
        people = _write_pairs(target, session, context, study, missing)
        about = _provenance(session, study, provenance) | {"missing": missing}
        target.writestr("provenance.json", _json(about))
        target.writestr("README.md", _readme(study, provenance, about, pictures, people))
    return missing


def _write_table(
    target: zipfile.ZipFile, session: Session, study: Study, table: Table, provenance: RowProvenance
) -> None:
    for kind, write in (("csv", export_formats.csv_lines), ("jsonl", export_formats.json_lines)):
        with target.open(f"{kind}/{table.name}.{kind}", "w") as stream:
            for line in write(table, session, study, provenance):
                stream.write(line.encode())
    target.writestr(f"parquet/{table.name}.parquet", parquet_file.content(table, session, study, provenance))


def _write_analysis(target: zipfile.ZipFile, session: Session, study: Study) -> None:
    """The paper's text, and the scripts that compute the report, with what they need beside the tables."""
    target.writestr(text.FILE_NAME, text.methods_and_results(session, study))
    target.writestr(osf.FILE_NAME, osf.registration(session, study))
    for script in ("analysis.py", "analysis.R"):
        target.writestr(script, (ANALYSIS / script).read_text())
    evaluation = evaluation_plan.settings_of(study)
    methods = [each.value for each in evaluation.methods] if evaluation else []
    bound = study.settings.equivalence_bound
    lines = ["method,equivalence_bound", *(f"{method},{bound}" for method in methods), ""]
    target.writestr("csv/methods.csv", "\n".join(lines))
    target.writestr("csv/scoring_key.csv", codebook.scoring_key_csv())


def _write_report(
    target: zipfile.ZipFile, session: Session, context: WorkerContext, study: Study, missing: dict[str, list[str]]
) -> list[str]:
    report = reports.newest(session, study)
    if report is None:
        return []
    target.writestr("report/report.json", _json({"made_at": report.created_at.isoformat(), **report.contents}))
    for name, formats in sorted(report.figures.items()):
        for kind, sha256 in formats.items():
            try:
                target.writestr(f"report/{name}.{kind}", context.store.read(sha256))
            except ArtefactMissing:
                missing.setdefault("figures of the report", []).append(sha256)
    return sorted(report.figures)


def _write_pairs(
    target: zipfile.ZipFile, session: Session, context: WorkerContext, study: Study, missing: dict[str, list[str]]
) -> list[str]:
    written = []
    for person in whose_rows.everybody(session, study):
        lost = set[str]()
        arrays = preference_arrays.arrays_of(session, context.store, study, person, lost)
        if lost:
            missing[f"recordings: pairs of {person.code} that show them are not in its arrays"] = sorted(lost)
        if arrays is not None:
            target.writestr(f"pairs/{person.code}.npz", arrays)
            written.append(person.code)
    if (DOCS / "arrays.md").exists():
        target.writestr("pairs/README.md", (DOCS / "arrays.md").read_text())
    return written


def _provenance(session: Session, study: Study, provenance: RowProvenance) -> dict[str, Any]:
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
        "scripted": {each.code: each.scripted_as for each in whose_rows.everybody(session, study) if each.scripted_as},
        "plan_in_words": preregistration.plan_of(session, study).in_words,
        "blinded": unblinding.is_blinded(study),
        "unblinded_at": study.unblinded_at.isoformat() if study.unblinded_at else None,
        "evaluation_key": study.key_secret if study.unblinded_at else None,
        "software_version": provenance.software_version,
        "exported_at": provenance.exported_at.isoformat(),
    }


def _readme(
    study: Study, provenance: RowProvenance, about: dict[str, Any], pictures: Sequence[str], people: Sequence[str]
) -> str:
    listed = [f"* {each['at']}, {each['actor']}: {' '.join(each['reason'].split())}" for each in about["deviations"]]
    lost = [f"* {what}: {', '.join(hashes)}" for what, hashes in about["missing"].items()]
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
        scripted=scripted_in_words(about["scripted"]),
        plan=about["plan_in_words"],
        deviations="\n".join(listed) or "None.",
        missing="\n".join(lost) or "Nothing.",
        figures=", ".join(pictures) or "none yet",
        people=", ".join(people) or "nobody yet",
    )


_README = """\
# {name} ({slug})

Exported {moment} by PbARL Studio {version}. Lock hash of settings and plan: {lock}. {blinded}
{scripted}
| what | where |
|---|---|
| tables | `csv/`, `jsonl/`, `parquet/`: the same rows three times |
| what every column means | `dictionary.csv`, `dictionary.md` |
| standard questionnaires: words, scoring keys, sources | `questionnaires.md`, `questionnaires.json` |
| settings, seed, lock, deviations | `provenance.json` |
| text for a paper, and what a preregistration at OSF asks for | `methods_and_results.md`, `preregistration.md` |
| scripts that compute all tables and figures of the report from `csv/` | `analysis.py`, `analysis.R` |
| statistics and figures ({figures}) | `report/` |
| preference pairs as arrays ({people}) | `pairs/`, explained in `pairs/README.md` |

Open the tables with `pandas.read_parquet("parquet/ratings.parquet")` or, in R, `arrow::read_parquet` or `read.csv`.
Participants who withdrew are tombstones in `participants`, and nothing of them is anywhere else.

## What was planned
{plan}

## Deviations from the locked plan
{deviations}

## Missing
Stored files that were missing or damaged when this was made, by their hashes; a backup of the data directory has them.

{missing}
"""


def _json(value: object) -> str:
    return json.dumps(value, indent=2, ensure_ascii=False) + "\n"
