"""The experimenter's part of a rehearsal, through the pages: lock the study, unblind it, fetch what came out."""

import time
from dataclasses import dataclass
from typing import Any

from app.db import Database
from app.domain.models import Report
from app.domain.studies import Study
from app.services.runs import reports
from worker.jobs.publishing import report_files
from worker.rehearsal.browser import FormBrowser
from worker.rehearsal.server import PATIENCE_S, wait_until

FINAL_FIGURE = "ratings"
"""The paper's figure: mean ratings of the methods, with stars."""
TABLES = ("participants", "labels", "ratings", "evaluations")


@dataclass(frozen=True)
class Conclusion:
    """What an experimenter has in hand at the end of a study."""

    contents: dict[str, Any]
    """of the last report: statistics, tests, answers"""
    files: dict[str, bytes]
    """figures and tables by file name, as downloaded"""
    seconds: float
    """from unblinding to the final figure"""


def lock(experimenter: FormBrowser, study: Study) -> None:
    """Lock the study before anybody comes."""
    experimenter.fill_in(f"/studies/{study.slug}/lock", typed=study.slug)


def conclude(experimenter: FormBrowser, database: Database, study: Study) -> Conclusion:
    """Unblind, wait for the report that knows everything, and download its figures and the tables."""
    started = time.monotonic()
    if study.settings.evaluation is not None:
        experimenter.fill_in(f"/studies/{study.slug}/unblind", typed=study.slug)
    report = wait_until(PATIENCE_S, "no final report", lambda: _final_report(database, study.id))
    experimenter.download(f"/studies/{study.slug}/results")
    figures = [f"{name}.{kind}" for name, formats in report.figures.items() for kind in formats]
    files = {name: experimenter.download(f"/studies/{study.slug}/results/figures/{name}") for name in figures}
    seconds = time.monotonic() - started
    for table in TABLES:
        files[f"{table}.csv"] = experimenter.download(f"/studies/{study.slug}/export/{table}.csv")
    return Conclusion(report.contents, files, seconds)


def _final_report(database: Database, study_id: int) -> Report | None:
    """The report that was made from everything there is; None while it is being made."""
    with database.reading() as session:
        study = session.get_one(Study, study_id)
        newest = reports.newest(session, study)
        return newest if newest is not None and newest.basis == report_files.basis_of(session, study) else None
