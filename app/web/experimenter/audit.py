"""The audit log, for administrators: who did what when, its head, receipts of what was erased, the key that signs."""

from collections.abc import Iterator
from dataclasses import asdict
from datetime import date
from typing import Annotated, Any, Literal
from urllib.parse import urlencode

from fastapi import APIRouter, Depends, Query, Request
from fastapi.responses import JSONResponse, Response, StreamingResponse
from sqlalchemy.orm import Session

from app import signing
from app.db import now
from app.domain.people import Experimenter
from app.services import audit
from app.services.auditing import lookup, receipts
from app.services.auditing.lookup import Wanted
from app.services.exports.csv_cells import csv_line
from app.web.http.authorized_route import AuthorizedRoute
from app.web.http.deps import CurrentAdministrator, ReadingSession, RowId, Studio, StudioDep
from app.web.http.spooling import spooled
from app.web.texts.templating import page

router = APIRouter(prefix="/audit", route_class=AuthorizedRoute)

HEAD_FORMAT = "pbarl-studio-audit-head"
MEDIA_TYPES = {"csv": "text/csv; charset=utf-8", "jsonl": "application/x-ndjson"}
MOST_RECEIPTS = 200
_Day = Annotated[date | Literal[""], Query()]
_Row = Annotated[int | None, Query(ge=0, le=2**31 - 1)]


def _wanted(
    actor: Annotated[str, Query(max_length=80)] = "",
    action: Annotated[str, Query(max_length=80)] = "",
    study: Annotated[str, Query(pattern=r"^[a-z0-9-]{0,80}$")] = "",
    since: _Day = "",
    until: _Day = "",
    below: _Row = None,
    above: _Row = None,
) -> Wanted:
    """What the form above the log asks for; what is empty does not matter."""
    return Wanted(actor or None, action or None, study or None, since or None, until or None, below, above)


@router.get("", name="show_audit")
def show_audit(
    request: Request,
    wanted: Annotated[Wanted, Depends(_wanted)],
    admin: CurrentAdministrator,
    session: ReadingSession,
    studio: StudioDep,
) -> Response:
    """The newest rows, or those that are looked for."""
    _note(studio, session, admin, "audit log viewed")
    context = {
        "experimenter": admin,
        "wanted": wanted,
        "found": lookup.find(session, wanted),
        "actors": lookup.actors(session),
        "actions": lookup.actions(session),
        "slugs": lookup.slugs(session),
        "address": _address,
        "on_page": lookup.on_page,
    }
    return page(request, "experimenter/audit.html", context)


@router.get("/log.{kind}", name="download_audit")
def download_audit(
    kind: Literal["csv", "jsonl"], admin: CurrentAdministrator, session: ReadingSession, studio: StudioDep
) -> Response:
    """The whole log; as JSONL with what checks it elsewhere."""
    _note(studio, session, admin, "audit log exported")

    def lines(later: Session) -> Iterator[str]:
        """The request's own session is over by the time anything is sent."""
        return map(csv_line, lookup.csv_rows(later)) if kind == "csv" else lookup.json_lines(later)

    headers = {"content-disposition": f'attachment; filename="audit-log-{now():%Y%m%dT%H%M%S}.{kind}"'}
    return StreamingResponse(spooled(studio.session_queue, lines), media_type=MEDIA_TYPES[kind], headers=headers)


@router.get("/head.json", name="download_head")
def download_head(admin: CurrentAdministrator, session: ReadingSession, studio: StudioDep) -> Response:
    """The newest row's hash, signed: to be kept where nobody of this studio can change it."""
    _note(studio, session, admin, "head of the audit log downloaded")
    head = audit.head(session)
    document = {"format": HEAD_FORMAT, "written_at": now().isoformat(), "row": head.row, "hash": head.hash}
    return _file(signing.load(studio.settings).signed(document), f"audit-head-{head.row}.json")


@router.get("/proof", name="show_proof")
def show_proof(request: Request, admin: CurrentAdministrator, session: ReadingSession, studio: StudioDep) -> Response:
    """The head of the log, the key that signs, and what was erased, the newest first."""
    context = {
        "experimenter": admin,
        "head": audit.head(session),
        "key": signing.load(studio.settings),
        "erasures": receipts.erasures(session, MOST_RECEIPTS),
        "most": MOST_RECEIPTS,
        "slugs": lookup.slugs(session),
    }
    return page(request, "experimenter/proof.html", context)


@router.get("/receipts/{number}.json", name="download_receipt")
def download_receipt(
    number: RowId, admin: CurrentAdministrator, session: ReadingSession, studio: StudioDep
) -> Response:
    """One erasure with all its steps, signed; it says nothing of whom."""
    document = receipts.document(session, receipts.find(session, number))
    _note(studio, session, admin, "receipt downloaded", f"receipt {number}")
    return _file(signing.load(studio.settings).signed(document), f"erasure-receipt-{number}.json")


def _note(studio: Studio, session: Session, admin: Experimenter, action: str, subject: str = "all of it") -> None:
    audit.note_reading(studio.database, session, admin.name, action, subject)


def _file(document: dict[str, Any], name: str) -> Response:
    return JSONResponse(document, headers={"content-disposition": f'attachment; filename="{name}"'})


def _address(wanted: Wanted) -> str:
    """The part of an address that asks for these rows, with its question mark."""
    asked = {name: str(value) for name, value in asdict(wanted).items() if value is not None}
    return f"?{urlencode(asked)}" if asked else ""
