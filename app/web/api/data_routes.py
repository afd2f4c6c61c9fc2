"""What was collected and learned in a study, for programs: bundles, reports, tables, exports."""

from http import HTTPStatus
from itertools import islice
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Path, Query
from fastapi.responses import FileResponse, Response
from sqlalchemy import select
from sqlalchemy.orm import Session

from app.domain.models import Bundle, Export, Model
from app.domain.studies import Study
from app.errors import AppError
from app.services import audit
from app.services.exports import export_formats, export_requests, export_tables, paging
from app.services.exports.export_requests import ExportKind
from app.services.participants import enrolment
from app.services.runs import publishing, reports
from app.services.studies import studies
from app.web.api import schemas as answers
from app.web.api.callers import PREFIX, ActingCaller, AuthorizedCall, Caller, note_reading
from app.web.http import stored_file
from app.web.http.deps import (
    Code,
    ReadingSession,
    RowId,
    Slug,
    StudioDep,
    WritingSession,
)

LARGEST_PAGE = 1000
_ZIP: dict[int | str, dict[str, Any]] = {200: {"content": {"application/zip": {}}, "description": "The file"}}
router = APIRouter(route_class=AuthorizedCall)


class NoReportYet(AppError):
    """There is no report yet. The worker makes the first one after the first answer."""

    status = HTTPStatus.NOT_FOUND


class TableUnknown(AppError):
    """There is no table of this name. The list of tables shows what there is."""

    status = HTTPStatus.NOT_FOUND


@router.get("/studies/{slug}/participants/{code}/bundles", tags=["bundles"])
def list_bundles(
    slug: Slug, code: Code, caller: Caller, session: ReadingSession, studio: StudioDep
) -> list[answers.BundleAnswer]:
    """Every published filter of a participant, the newest first."""
    study = studies.find_study(session, slug)
    person = enrolment.find_by_code(session, study, code)
    note_reading(studio, session, caller, "bundles", study, f"{slug}/{code}", person)
    rows = session.execute(
        select(Bundle, Model.label_count)
        .join(Model, Model.id == Bundle.model_id)
        .where(Bundle.participant_id == person.id)
        .order_by(Bundle.version.desc())
    )
    return [
        answers.BundleAnswer(
            version=bundle.version,
            label_count=labels,
            created_at=bundle.created_at,
            byte_count=bundle.byte_count,
            sha256=bundle.artefact_sha256,
            download=f"{PREFIX}/studies/{slug}/participants/{code}/bundles/{bundle.version}.zip",
        )
        for bundle, labels in rows
    ]


@router.get(
    "/studies/{slug}/participants/{code}/bundles/{version}.zip",
    tags=["bundles"],
    response_class=FileResponse,
    responses=_ZIP,
)
def download_bundle(
    slug: Slug, code: Code, version: RowId, caller: ActingCaller, session: WritingSession, studio: StudioDep
) -> Response:
    """A filter that runs without this project."""
    person = enrolment.find_by_code(session, studies.find_study(session, slug), code)
    bundle = publishing.find_bundle(session, studio.store, person, version)
    audit.record(session, caller.name, "bundle downloaded", f"{slug}/{code}/{version}", participant=person)
    return stored_file.send(studio.store, bundle.artefact_sha256, "application/zip")


@router.get("/studies/{slug}/report", tags=["reports"])
def show_report(slug: Slug, caller: Caller, session: ReadingSession, studio: StudioDep) -> answers.ReportAnswer:
    """Statistics of the newest report, and where its figures are."""
    study = studies.find_study(session, slug)
    report = reports.newest(session, study)
    if report is None:
        raise NoReportYet
    note_reading(studio, session, caller, "report", study, slug)
    figures = {
        name: {kind: f"{PREFIX}/studies/{slug}/report/figures/{name}.{kind}" for kind in formats}
        for name, formats in report.figures.items()
    }
    provenance = export_formats.provenance_of(session, study)
    return answers.ReportAnswer(
        made_at=report.created_at,
        lock_hash=provenance.lock_hash,
        deviations=provenance.deviations,
        blinded=bool(report.contents.get("blinded")),
        contents=report.contents,
        figures=figures,
    )


@router.get(
    "/studies/{slug}/report/figures/{name}.{kind}",
    tags=["reports"],
    response_class=Response,
    responses={200: {"content": {each: {} for each in reports.FORMATS.values()}, "description": "The figure"}},
)
def show_figure(
    slug: Slug,
    name: Annotated[str, Path(pattern=r"^[a-z_]{1,60}$")],
    kind: Literal["svg", "png"],
    caller: Caller,
    session: ReadingSession,
    studio: StudioDep,
) -> Response:
    """One figure of the newest report."""
    study = studies.find_study(session, slug)
    note_reading(studio, session, caller, "report", study, slug)
    return Response(reports.figure(session, studio.store, study, name, kind), media_type=reports.FORMATS[kind])


@router.get("/studies/{slug}/tables", tags=["tables"])
def list_tables(slug: Slug, _caller: Caller, session: ReadingSession) -> list[answers.TableAnswer]:
    """The data dictionary: every table and column, the same for all studies."""
    studies.find_study(session, slug)
    return [
        answers.TableAnswer(
            name=table.name,
            meaning=table.meaning,
            columns=[
                answers.ColumnAnswer(
                    name=column.name,
                    type=column.kind.value,
                    unit=column.unit,
                    allowed=column.allowed,
                    meaning=column.meaning,
                )
                for column in table.all_columns
            ],
        )
        for table in export_tables.TABLES
    ]


@router.get("/studies/{slug}/tables/{table}", tags=["tables"])
def read_table(
    slug: Slug,
    table: Annotated[str, Path(pattern=r"^[a-z]{1,40}$", examples=["ratings"])],
    caller: ActingCaller,
    session: ReadingSession,
    studio: StudioDep,
    cursor: Annotated[str, Query(pattern=r"^[A-Za-z0-9_-]*$", max_length=paging.LONGEST_CURSOR)] = "",
    limit: Annotated[int, Query(ge=1, le=LARGEST_PAGE)] = 100,
) -> answers.Page:
    """Rows of a table, as in the exported files. Follow `next` until it is null: no row comes twice and none is lost,
    however much is answered meanwhile. A page takes as long at the end of a table as at its beginning.

    Of labels, forms, consent, events, ratings, models and deviations, rows are only ever added: the last page's `later`
    leads to those that come after this reading. (What `superseded`, `counts` and `excluded` say of earlier rows may
    have changed meanwhile.) With PostgreSQL, where a row can appear before one with a lower id, `later` is null."""
    study = studies.find_study(session, slug)
    if table not in export_tables.BY_NAME:
        raise TableUnknown
    wanted, whose = export_tables.BY_NAME[table], f"{study.id}/{table}"
    made_of = wanted.made_of
    window = paging.window_of(session, cursor, whose, made_of) if cursor else paging.first_window(session, made_of)
    provenance = export_formats.provenance_of(session, study)
    rows = export_formats.keyed_records(wanted, session, study, provenance, window)
    found = list(islice(rows, limit + 1))
    note_reading(studio, session, caller, "table", study, f"{slug}/{table}")
    address = f"{PREFIX}/studies/{slug}/tables/{table}?limit={limit}&cursor="
    following = later = None
    if len(found) > limit:
        following = address + paging.cursor_of(whose, window, found[limit - 1][0])
    elif wanted.grows_by is not None and studio.database.is_sqlite:
        later = address + paging.later_cursor(whose, window, wanted.grows_by)
    return answers.Page(table=table, rows=[row for _, row in found[:limit]], next=following, later=later)


@router.get("/studies/{slug}/exports", tags=["exports"])
def list_exports(slug: Slug, _caller: Caller, session: ReadingSession) -> list[answers.ExportAnswer]:
    """Files that were asked for, the newest first."""
    study = studies.find_study(session, slug)
    return [_export(session, study, each) for each in export_requests.of_study(session, study)]


@router.post("/studies/{slug}/exports", tags=["exports"], status_code=HTTPStatus.ACCEPTED)
def request_export(
    slug: Slug, wanted: answers.NewExport, caller: ActingCaller, session: WritingSession
) -> answers.ExportAnswer:
    """Ask for a zip file: the whole data of a study, its clips and preferences as a LeRobotDataset, or an archive that
    another installation imports."""
    study = studies.find_study(session, slug)
    return _export(session, study, export_requests.request(session, study, ExportKind(wanted.kind), caller.name))


@router.get("/studies/{slug}/exports/{export_id}.zip", tags=["exports"], response_class=FileResponse, responses=_ZIP)
def download_export(
    slug: Slug, export_id: RowId, caller: ActingCaller, session: WritingSession, studio: StudioDep
) -> Response:
    """A finished file."""
    study = studies.find_study(session, slug)
    export = export_requests.find(session, studio.store, study, export_id)
    audit.record(session, caller.name, f"{export.kind} export downloaded", f"{slug}/{export_id}", study=study)
    return stored_file.send(studio.store, export.artefact_sha256 or "", "application/zip")


def _export(session: Session, study: Study, export: Export) -> answers.ExportAnswer:
    run = export_requests.run_of(session, export)
    address = f"{PREFIX}/studies/{study.slug}/exports/{export.id}.zip"
    return answers.ExportAnswer(
        id=export.id,
        kind=export.kind,
        requested_at=export.requested_at,
        finished_at=export.finished_at,
        byte_count=export.byte_count,
        error=run.error if run else None,
        download=address if export.artefact_sha256 else None,
    )
