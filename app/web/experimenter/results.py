"""Results: what the newest report says, its figures, and the data as files."""

from collections.abc import Iterator, Mapping
from http import HTTPStatus
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Path, Request
from fastapi.responses import RedirectResponse, Response, StreamingResponse
from sqlalchemy.orm import Session

from app import signing
from app.domain.evaluation import DonorRule
from app.domain.people import Experimenter
from app.domain.studies import Study
from app.errors import AppError
from app.paths import ANALYSIS
from app.services import audit
from app.services.answers import exclusions
from app.services.archives import sealing, study_import
from app.services.evaluation import donors, evaluation_plan, unblinding
from app.services.exports import export_formats, export_requests, export_tables
from app.services.exports.export_requests import ExportKind
from app.services.monitoring import form_summaries
from app.services.paper import text
from app.services.participants import enrolment
from app.services.runs import reports
from app.services.studies import locking, preregistration, studies
from app.web.experimenter.dashboard import form_words
from app.web.http import stored_file
from app.web.http.authorized_route import AuthorizedRoute
from app.web.http.deps import (
    ActingExperimenter,
    CurrentExperimenter,
    ReadingSession,
    RowId,
    Slug,
    Studio,
    StudioDep,
    WritingSession,
)
from app.web.http.spooling import spooled
from app.web.texts import task_words
from app.web.texts.templating import page

router = APIRouter(prefix="/studies/{slug}", route_class=AuthorizedRoute)

TableName = Annotated[str, Path(pattern=r"^[a-z]{1,40}$")]
FileKind = Literal["csv", "jsonl"]
MEDIA_TYPES = {"csv": "text/csv; charset=utf-8", "jsonl": "application/x-ndjson"}
LINES_AT_ONCE = 200
METHOD_NAMES = {method.value: name[:1].upper() + name[1:] for method, name in unblinding.NAMES.items()}
DONOR_WORDS = {
    DonorRule.BY_LOT: "another participant\N{RIGHT SINGLE QUOTATION MARK}s",
    DonorRule.MEAN_OF_PEOPLE: "the mean of other participants",
    DonorRule.TYPE_OF_USER: "of a type of user",
    DonorRule.MEAN_OF_TYPES: "the mean of the types of users",
    DonorRule.WITHDREW: "of somebody who has withdrawn since",
}
FIGURES = {
    "ratings": ("Mean ratings, as in the paper", ""),
    "ratings_of_each_person": (
        "The same ratings, person by person",
        "Each line is one person: their mean rating of each robot. Diamonds: mean over people, 95 % interval.",
    ),
    "head_to_heads": (
        "Strengths",
        "Where 0 is the average robot; lines: 95 % intervals that count people, not answers.",
    ),
    "learning_curves": (
        "How well the models predicted the answers",
        "Every answer was predicted by a model that had not seen it; pairs drawn at random only.",
    ),
    "success_against_preference": (
        "What the filters change",
        "One point per person with 95 % intervals: right is more preferred, up is more often successful. Hollow: the "
        "model that says so has not been shown to be better than guessing.",
    ),
    "cost_changes": (
        "The paper\N{RIGHT SINGLE QUOTATION MARK}s costs",
        "One circle per person; costs that the reference does not have are left out.",
    ),
}


class TableNotFound(AppError):
    """There is no table of this name. The page of exports lists them all."""

    status = HTTPStatus.NOT_FOUND


@router.get("/results", name="show_results")
def show_results(
    request: Request, slug: Slug, experimenter: CurrentExperimenter, session: ReadingSession, studio: StudioDep
) -> Response:
    """Tables, tests and figures of the newest report."""
    study = studies.find_study(session, slug)
    audit.note_reading(studio.database, session, experimenter.name, "results viewed", slug, study=study)
    context = results_context(session, study) | {"experimenter": experimenter}
    return page(request, "experimenter/results.html", context)


def results_context(session: Session, study: Study) -> dict[str, Any]:
    """What the page shows."""
    report = reports.newest(session, study)
    return {
        "study": study,
        "settings": study.settings,
        "report": report,
        "contents": report.contents if report else None,
        "outdated": report is None and reports.is_outdated(session, study),
        "awaited": reports.is_awaited(session, study),
        "run": reports.run_in_hand(session, study),
        "blinded": unblinding.is_blinded(study),
        "evaluated": evaluation_plan.settings_of(study) is not None,
        "words": task_words.words_of(study.task),
        "lent": _lent(session, study),
        "name_of": _name_of,
        "p_value": _p_value,
        "two_decimals": _two_decimals,
        "statistic": _statistic,
        "tests": preregistration.TEST_NAMES,
        "plan": preregistration.plan_of(session, study),
        "forms": form_words.summaries(study, form_summaries.summaries_of(session, study)),
        "excluded": exclusions.count(session, study),
        "scripted": enrolment.count_scripted(session, study),
        "figures": {name: FIGURES[name] for name in FIGURES if report is not None and name in report.figures},
    }


@router.get("/results/figures/{name}.{kind}", name="show_figure")
def show_figure(
    slug: Slug,
    name: Annotated[str, Path(pattern=r"^[a-z_]{1,60}$")],
    kind: Literal["svg", "png"],
    experimenter: CurrentExperimenter,
    session: ReadingSession,
    studio: StudioDep,
) -> Response:
    """One figure of the newest report."""
    study = studies.find_study(session, slug)
    audit.note_reading(studio.database, session, experimenter.name, "results viewed", slug, study=study)
    content = reports.figure(session, studio.store, study, name, kind)
    # An SVG file styles itself; opened by itself it must not be able to do anything else.
    policy = "default-src 'none'; style-src 'unsafe-inline'; sandbox"
    headers = {"content-security-policy": policy, "content-disposition": f'inline; filename="{slug}-{name}.{kind}"'}
    return Response(content, media_type=reports.FORMATS[kind], headers=headers)


@router.get("/results/methods_and_results.md", name="download_methods_text")
def download_methods_text(
    slug: Slug, experimenter: CurrentExperimenter, session: ReadingSession, studio: StudioDep
) -> Response:
    """Methods and results for a paper; while the study is blinded the methods alone."""
    study = studies.find_study(session, slug)
    audit.note_reading(studio.database, session, experimenter.name, "results viewed", slug, study=study)
    return _attached(text.methods_and_results(session, study), f"{slug}-{text.FILE_NAME}", "text/markdown")


@router.get("/results/scripts/{script}", name="download_analysis")
def download_analysis(
    slug: Slug, script: Literal["analysis.py", "analysis.R"], _: CurrentExperimenter, session: ReadingSession
) -> Response:
    """The script that computes the report from the exported tables; the same for every study."""
    studies.find_study(session, slug)
    return _attached((ANALYSIS / script).read_text(), script, "text/plain")


@router.get("/export", name="show_exports")
def show_exports(
    request: Request, slug: Slug, experimenter: CurrentExperimenter, session: ReadingSession, studio: StudioDep
) -> Response:
    """Every table, the whole as one file, and the archive."""
    return _exports_page(request, studies.find_study(session, slug), experimenter, session)


@router.get("/export/seal-key", include_in_schema=False)
def forget_seal_key(request: Request, slug: Slug) -> Response:
    """The page of exports, for whoever loads the page with the key again."""
    return RedirectResponse(request.app.url_path_for("show_exports", slug=slug), HTTPStatus.SEE_OTHER)


@router.post("/export/seal-key", name="show_seal_key")
def show_seal_key(request: Request, slug: Slug, experimenter: ActingExperimenter, session: WritingSession) -> Response:
    """The key of this study's sealed archives; who has asked for it is kept."""
    study = studies.find_study(session, slug)
    audit.record(session, experimenter.name, "seal key shown", slug, study=study)
    return _exports_page(request, study, experimenter, session, sealing.key_of(study))


def _exports_page(
    request: Request, study: Study, experimenter: Experimenter, session: Session, seal_key: str | None = None
) -> Response:
    exports = [(export, export_requests.run_of(session, export)) for export in export_requests.of_study(session, study)]
    studio: Studio = request.app.state.studio
    imported, signer = study_import.signer_of(session, study)
    context = {
        "study": study,
        "experimenter": experimenter,
        "fingerprint": signing.load(studio.settings).fingerprint,
        "signature": signing.in_words(signer, studio.settings) if imported else None,
        "deviations": len(locking.deviations(session, study)),
        "waiting": any(export.finished_at is None for export, _ in exports),
        "exports": exports,
        "blinded": unblinding.is_blinded(study),
        "tables": export_tables.TABLES,
        "provenance": export_formats.provenance_of(session, study),
        "scripted": enrolment.count_scripted(session, study),
        "seal_key": seal_key,
    }
    return page(request, "experimenter/export.html", context)


@router.post("/export/files/{kind}", name="request_export")
def request_export(
    request: Request, slug: Slug, kind: ExportKind, experimenter: ActingExperimenter, session: WritingSession
) -> Response:
    """Ask the worker for a file."""
    export_requests.request(session, studies.find_study(session, slug), kind, experimenter.name)
    return RedirectResponse(request.app.url_path_for("show_exports", slug=slug), HTTPStatus.SEE_OTHER)


@router.get("/export/files/{export_id}.zip", name="download_export")
def download_export(
    slug: Slug, export_id: RowId, experimenter: ActingExperimenter, session: WritingSession, studio: StudioDep
) -> Response:
    """A finished file."""
    study = studies.find_study(session, slug)
    export = export_requests.find(session, studio.store, study, export_id)
    audit.record(session, experimenter.name, f"{export.kind} export downloaded", f"{slug}/{export_id}", study=study)
    filename = f"{slug}-{export.kind}-{export.requested_at:%Y%m%dT%H%M}.zip"
    return stored_file.send(studio.store, export.artefact_sha256 or "", "application/zip", filename=filename)


@router.get("/export/{table}.{kind}", name="download_table")
def download_table(
    slug: Slug,
    table: TableName,
    kind: FileKind,
    experimenter: ActingExperimenter,
    session: WritingSession,
    studio: StudioDep,
) -> Response:
    """One table, as the database is now."""
    study = studies.find_study(session, slug)
    if table not in export_tables.BY_NAME:
        raise TableNotFound
    audit.record(session, experimenter.name, "table exported", f"{slug}/{table}.{kind}", study=study)
    provenance = export_formats.provenance_of(session, study)
    lock = "not-locked" if study.lock_hash is None else study.lock_hash[:8]
    name = f"{slug}-{table}-{lock}-{provenance.exported_at:%Y%m%dT%H%M%S}.{kind}"
    headers = {"content-disposition": f'attachment; filename="{name}"'}
    write = export_formats.csv_lines if kind == "csv" else export_formats.json_lines

    def lines(later: Session) -> Iterator[str]:
        """The request's own session is over by the time anything is sent."""
        found = studies.find_study(later, slug)
        return _handfuls(write(export_tables.BY_NAME[table], later, found, provenance))

    return StreamingResponse(spooled(studio.session_queue, lines), media_type=MEDIA_TYPES[kind], headers=headers)


def _handfuls(lines: Iterator[str]) -> Iterator[str]:
    """The first line at once, so that whoever asked sees that it comes; then many together, which is cheaper."""
    yield next(lines, "")
    waiting: list[str] = []
    for line in lines:
        waiting.append(line)
        if len(waiting) == LINES_AT_ONCE:
            yield "".join(waiting)
            waiting = []
    yield "".join(waiting)


def _attached(content: str, filename: str, media_type: str) -> Response:
    headers = {"content-disposition": f'attachment; filename="{filename}"'}
    return Response(content, media_type=f"{media_type}; charset=utf-8", headers=headers)


def _lent(session: Session, study: Study) -> dict[str, str]:
    """Whose filters were shown as methods that are not the person's own, in words, by what the method is called."""
    return {
        _name_of(method): ", ".join(f"{DONOR_WORDS[DonorRule(rule)]}: {count}" for rule, count in found.items())
        for method, found in sorted(donors.counts(session, study).items())
    }


def _name_of(group: str) -> str:
    """What a method, or a letter, is called."""
    return METHOD_NAMES.get(group, f"Robot {group}")


def _p_value(result: Mapping[str, Any], key: str = "p") -> str:
    """A p value as papers print it."""
    value = result.get(key)
    if value is None:
        return "\N{EN DASH}"
    return "< .001" if value < 0.001 else f"{value:.3f}".removeprefix("0")


def _two_decimals(value: float) -> str:
    """A difference or an effect size as papers print it."""
    return _plain(value, sign="+") if round(value, 2) else "0.00"


def _statistic(value: float) -> str:
    """A test statistic as papers print it."""
    return _plain(value, sign="-") if round(value, 2) else "0.00"


def _plain(value: float, sign: str) -> str:
    return f"{value:{sign}.2f}".replace("-", "\N{MINUS SIGN}")
