"""Whole tables as files, for programs that ask again and again: who has the newest one gets nothing but that word."""

import hashlib
from datetime import UTC, datetime
from http import HTTPStatus
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Header, Path
from fastapi.responses import Response
from sqlalchemy.orm import Session

from app.domain.studies import Study
from app.services.exports import export_formats, export_tables, parquet_file
from app.services.exports.export_formats import Table
from app.services.studies import studies
from app.web.api.callers import ActingCaller, AuthorizedCall, note_reading
from app.web.api.data_routes import TableUnknown
from app.web.http.deps import ReadingSession, Slug, StudioDep

CSV = "text/csv; charset=utf-8"
_ETAG = {"ETag": {"description": "Send it back as If-None-Match.", "schema": {"type": "string"}}}
_FILE: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "The file",
        "headers": _ETAG,
        "content": {
            CSV: {"schema": {"type": "string"}},
            parquet_file.MEDIA_TYPE: {"schema": {"type": "string", "format": "binary"}},
        },
    },
    304: {"description": "Nothing has changed since the file whose ETag was sent", "headers": _ETAG},
}
_NO_MOMENT = datetime.fromtimestamp(0, UTC)
router = APIRouter(route_class=AuthorizedCall)


@router.get("/studies/{slug}/tables/{table}.{kind}", tags=["tables"], response_class=Response, responses=_FILE)
def download_table(
    slug: Slug,
    table: Annotated[str, Path(pattern=r"^[a-z]{1,40}$", examples=["ratings"])],
    kind: Literal["csv", "parquet"],
    caller: ActingCaller,
    session: ReadingSession,
    studio: StudioDep,
    if_none_match: Annotated[str, Header(max_length=1000)] = "",
) -> Response:
    """A whole table as one file, as in the exported data. Only `exported_at` differs between files of one ETag."""
    study = studies.find_study(session, slug)
    if table not in export_tables.BY_NAME:
        raise TableUnknown
    wanted = export_tables.BY_NAME[table]
    note_reading(studio, session, caller, "table", study, f"{slug}/{table}.{kind}")
    tag = f'W/"{_fingerprint(wanted, session, study)}-{kind}"'
    headers = {"etag": tag, "cache-control": "private, no-cache"}
    if tag in (each.strip() for each in if_none_match.split(",")):
        return Response(status_code=HTTPStatus.NOT_MODIFIED, headers=headers)
    provenance = export_formats.provenance_of(session, study)
    if kind == "parquet":
        content: bytes | str = parquet_file.content(wanted, session, study, provenance)
    else:
        content = "".join(export_formats.csv_lines(wanted, session, study, provenance))
    return Response(content, headers=headers, media_type=CSV if kind == "csv" else parquet_file.MEDIA_TYPE)


def _fingerprint(table: Table, session: Session, study: Study) -> str:
    """Of everything in the file but when it was written."""
    provenance = export_formats.provenance_of(session, study, _NO_MOMENT)
    digest = hashlib.sha256()
    for line in export_formats.json_lines(table, session, study, provenance):
        digest.update(line.encode())
    return digest.hexdigest()[:32]
