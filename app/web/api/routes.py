"""The API: the same data as the pages and exports, for programs. An application of its own below /api/v1.

Who asks is told by a bearer token, never by a cookie, so no other website can ask in somebody's name.
"""

from http import HTTPStatus
from itertools import islice
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Depends, FastAPI, Path, Query, Request
from fastapi.responses import FileResponse, Response
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer
from sqlalchemy import ColumnElement, and_, select, true
from sqlalchemy.orm import Session

from app.domain.models import Bundle, Export, Model
from app.domain.people import ApiToken, Experimenter, Role, StudyMember, StudyRole, TokenScope
from app.domain.studies import Participant, Study
from app.errors import AppError
from app.services import audit
from app.services.accounts import api_tokens, failed_logins
from app.services.accounts.api_tokens import ScopeTooNarrow, TokenInvalid
from app.services.evaluation import unblinding
from app.services.exports import export_formats, export_requests, export_tables, paging
from app.services.exports.export_requests import ExportKind
from app.services.participants import enrolment
from app.services.runs import publishing, reports
from app.services.studies import membership, studies
from app.web.api import schemas as answers
from app.web.api.problems import add_problems, document_problems, only_known_parameters
from app.web.http import stored_file
from app.web.http.deps import (
    Code,
    ReadingSession,
    RowId,
    SecondFactorNeeded,
    Slug,
    Studio,
    StudioDep,
    WritingSession,
    lacks_second_factor,
)
from app.web.http.security import SAFE_METHODS

PREFIX = "/api/v1"
LARGEST_PAGE = 1000
DESCRIPTION = """\
Everything that the pages show and the exports hold, for programs.

Make a token on the page of API tokens and send it with every request: `Authorization: Bearer pbarl_...`. A token has
the rights of the account that made it in the studies this is a member of: a *viewer* may look at participants and
reports; an *editor* may also read tables, download bundles, add participants and ask for files; an *owner* also decides
who is a member. Other studies are not there at all. A token can be for reading or for one study only, and expires.

Times are UTC (ISO 8601), unknown is null. Errors are problem details (RFC 9457) whose `detail` says in words what
happened and what to do. Too many wrong tokens from one address are answered with 429 for a minute. Until a study is
unblinded, methods of the evaluation are letters here as everywhere.

Tables come in pages: follow `next`, whose `cursor` says where to go on. Together the pages are the table as it was when
the first one was asked for. There is no `offset` any more (what people answer between two pages would shift it), and a
parameter that an address does not know is refused with 422 instead of being ignored.
"""

bearer = HTTPBearer(auto_error=False, description="A token from the page of API tokens.")


class TokenMissing(AppError):
    """Send a token: the header Authorization: Bearer pbarl_... Tokens are made on the page of API tokens."""

    status = HTTPStatus.UNAUTHORIZED


class TooManyWrongTokens(AppError):
    """Too many wrong tokens from your address. Please wait a minute, then try again with a right one."""

    status = HTTPStatus.TOO_MANY_REQUESTS


class NoReportYet(AppError):
    """There is no report yet. The worker makes the first one after the first answer."""

    status = HTTPStatus.NOT_FOUND


class TableUnknown(AppError):
    """There is no table of this name. The list of tables shows what there is."""

    status = HTTPStatus.NOT_FOUND


def _whoever(
    request: Request,
    studio: StudioDep,
    session: ReadingSession,
    credentials: Annotated[HTTPAuthorizationCredentials | None, Depends(bearer)],
) -> Experimenter:
    """Whose token was sent, and it may be used so.

    Raises TokenMissing, TokenInvalid, TooManyWrongTokens, ScopeTooNarrow and SecondFactorNeeded.
    """
    if credentials is None:
        raise TokenMissing
    try:
        token, experimenter = api_tokens.find(session, credentials.credentials)
    except TokenInvalid:
        count = studio.failed_logins.count(failed_logins.WRONG_TOKEN)
        if count is not None:
            with studio.database.writing() as writing:
                subject = failed_logins.in_words(failed_logins.WRONG_TOKEN, count)
                audit.record(writing, audit.STRANGER, "login failed", subject)
        address = request.client.host if request.client else "unknown"
        if not studio.token_attempts.allow(address):
            raise TooManyWrongTokens from None
        raise
    if lacks_second_factor(studio.settings, experimenter):
        raise SecondFactorNeeded
    if token.scope == TokenScope.READ and request.method not in SAFE_METHODS:
        raise ScopeTooNarrow
    request.state.token = token
    if api_tokens.use_is_worth_noting(token):
        with studio.database.writing() as writing:
            api_tokens.note_use(writing, token.id)
    return experimenter


_Whoever = Annotated[Experimenter, Depends(_whoever, scope="function")]


def _caller(request: Request, session: ReadingSession, experimenter: _Whoever) -> Experimenter:
    return _entering(request, session, experimenter, StudyRole.VIEWER)


def _acting_caller(request: Request, session: ReadingSession, experimenter: _Whoever) -> Experimenter:
    return _entering(request, session, experimenter, StudyRole.EDITOR)


def _owning_caller(request: Request, session: ReadingSession, experimenter: _Whoever) -> Experimenter:
    return _entering(request, session, experimenter, StudyRole.OWNER)


def _entering(request: Request, session: Session, experimenter: Experimenter, needed: StudyRole) -> Experimenter:
    """Whose the study of this address is, if it has one. Raises StudyNotFound, RoleTooLow and StudyRoleTooLow."""
    slug = request.path_params.get("slug")
    if slug is not None:
        membership.enter(session, experimenter, slug, needed)
        if request.state.token.study_id not in (None, studies.find_study(session, slug).id):
            raise studies.StudyNotFound
    return experimenter


def _theirs(request: Request, caller: Experimenter) -> ColumnElement[bool]:
    only = request.state.token.study_id
    return and_(membership.visible_to(caller), true() if only is None else Study.id == only)


Caller = Annotated[Experimenter, Depends(_caller, scope="function")]
"""A member of the study that the address names: for looking."""
ActingCaller = Annotated[Experimenter, Depends(_acting_caller, scope="function")]
"""An editor of it: for whatever changes something or leaves the studio."""
OwningCaller = Annotated[Experimenter, Depends(_owning_caller, scope="function")]

_PROBLEMS: dict[int | str, dict[str, Any]] = {
    code: {"model": answers.Problem, "description": words}
    for code, words in (
        (400, "Not understood, or not possible"),
        (401, "No valid token"),
        (403, "Not with this role"),
        (404, "Nothing here"),
        (409, "Not any longer, or not as things are"),
        (413, "Too much at once"),
        (422, "Not valid"),
        (429, "Too many wrong tokens"),
        (503, "The database or a stored file cannot be reached"),
    )
}
_ZIP: dict[int | str, dict[str, Any]] = {200: {"content": {"application/zip": {}}, "description": "The file"}}
router = APIRouter(responses=_PROBLEMS, dependencies=[Depends(only_known_parameters)])


@router.get("/me", tags=["account"])
def show_account(request: Request, caller: Caller, session: ReadingSession) -> answers.Account:
    """Whose token this is, and what it may do."""
    token: ApiToken = request.state.token
    return answers.Account(
        name=caller.name,
        role=Role(caller.role).value,
        scope=TokenScope(token.scope).value,
        study=None if token.study_id is None else session.get_one(Study, token.study_id).slug,
        expires_at=token.expires_at,
        software_version=export_formats.software_version(),
    )


@router.get("/studies", tags=["studies"])
def list_studies(request: Request, caller: Caller, session: ReadingSession) -> list[answers.StudyLine]:
    """Every study that the token opens, the newest first."""
    theirs = select(Study).where(Study.deleted_at.is_(None), _theirs(request, caller))
    found = session.scalars(theirs.order_by(Study.id.desc()))
    return [answers.StudyLine(**_study_line(study)) for study in found]


@router.get("/studies/{slug}", tags=["studies"])
def show_study(slug: Slug, _caller: Caller, session: ReadingSession) -> answers.StudyAnswer:
    """One study with its settings."""
    study = studies.find_study(session, slug)
    return answers.StudyAnswer(
        **_study_line(study),
        seed=study.seed,
        lock_hash=study.lock_hash,
        deviations=export_formats.provenance_of(session, study).deviations,
        unblinded_at=study.unblinded_at,
        settings=study.settings,
    )


def _study_line(study: Study) -> dict[str, Any]:
    return {
        "slug": study.slug,
        "name": study.name,
        "task": study.task,
        "created_at": study.created_at,
        "locked": study.lock_hash is not None,
        "blinded": unblinding.is_blinded(study),
    }


@router.get("/studies/{slug}/participants", tags=["participants"])
def list_participants(
    slug: Slug, caller: Caller, session: ReadingSession, studio: StudioDep
) -> list[answers.ParticipantAnswer]:
    """Everybody in the study, tombstones included."""
    study = studies.find_study(session, slug)
    _note_reading(studio, session, caller, "participants", study, slug)
    provenance = export_formats.provenance_of(session, study)
    rows = export_formats.records(export_tables.BY_NAME["participants"], session, study, provenance)
    return [answers.ParticipantAnswer.model_validate(row) for row in rows]


@router.get("/studies/{slug}/members", tags=["members"])
def list_members(slug: Slug, _caller: Caller, session: ReadingSession) -> list[answers.MemberAnswer]:
    """Whose study this is."""
    found = membership.members(session, studies.find_study(session, slug))
    return [_member(member, account) for member, account in found]


@router.post("/studies/{slug}/members", tags=["members"])
def admit_member(
    slug: Slug, wanted: answers.NewMember, caller: OwningCaller, session: WritingSession
) -> list[answers.MemberAnswer]:
    """Make an account a member, or give a member another role. Answers with all members."""
    study = studies.find_study(session, slug)
    membership.admit(session, study, wanted.name, StudyRole(wanted.role), caller.name)
    return [_member(member, account) for member, account in membership.members(session, study)]


@router.delete("/studies/{slug}/members/{account_id}", tags=["members"], status_code=HTTPStatus.NO_CONTENT)
def remove_member(slug: Slug, account_id: RowId, caller: OwningCaller, session: WritingSession) -> None:
    """Shut a member out of the study at once."""
    membership.remove(session, studies.find_study(session, slug), account_id, caller.name)


def _member(member: StudyMember, account: Experimenter) -> answers.MemberAnswer:
    role = StudyRole(member.role).value
    return answers.MemberAnswer(account_id=account.id, name=account.name, role=role, added_at=member.added_at)


@router.post("/studies/{slug}/participants", tags=["participants"], status_code=HTTPStatus.CREATED)
def add_participants(
    request: Request, slug: Slug, wanted: answers.NewParticipants, caller: ActingCaller, session: WritingSession
) -> list[answers.Invitation]:
    """Add people to the study. Their links are in this answer and nowhere else."""
    study = studies.find_study(session, slug)
    added = [enrolment.add_participant(session, study, caller.name) for _ in range(wanted.count)]
    return [answers.Invitation(participant=person.code, link=_personal_link(request, token)) for person, token in added]


def _personal_link(request: Request, token: str) -> str:
    studio: Studio = request.app.state.studio
    base = studio.settings.public_url or str(request.base_url).removesuffix("/").removesuffix(PREFIX)
    return f"{base.rstrip('/')}{request.app.state.path_for('open_link', token=token)}"


@router.delete("/studies/{slug}/participants/{code}/link", tags=["participants"], status_code=HTTPStatus.NO_CONTENT)
def revoke_link(slug: Slug, code: Code, caller: ActingCaller, session: WritingSession) -> None:
    """Switch a personal link off at once, with every browser that used it; a new link brings the participant back."""
    study = studies.find_study(session, slug)
    enrolment.revoke_link(session, study, enrolment.find_by_code(session, study, code), caller.name)


@router.get("/studies/{slug}/participants/{code}/bundles", tags=["bundles"])
def list_bundles(
    slug: Slug, code: Code, caller: Caller, session: ReadingSession, studio: StudioDep
) -> list[answers.BundleAnswer]:
    """Every published filter of a participant, the newest first."""
    study = studies.find_study(session, slug)
    person = enrolment.find_by_code(session, study, code)
    _note_reading(studio, session, caller, "bundles", study, f"{slug}/{code}", person)
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
    _note_reading(studio, session, caller, "report", study, slug)
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
    _note_reading(studio, session, caller, "report", study, slug)
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
    however much is answered meanwhile. A page takes as long at the end of a table as at its beginning."""
    study = studies.find_study(session, slug)
    if table not in export_tables.BY_NAME:
        raise TableUnknown
    wanted, whose = export_tables.BY_NAME[table], f"{study.id}/{table}"
    made_of = wanted.made_of
    window = paging.window_of(cursor, whose, made_of) if cursor else paging.first_window(session, made_of)
    provenance = export_formats.provenance_of(session, study)
    rows = export_formats.keyed_records(wanted, session, study, provenance, window)
    found = list(islice(rows, limit + 1))
    _note_reading(studio, session, caller, "table", study, f"{slug}/{table}")
    following = None
    if len(found) > limit:
        place = paging.cursor_of(whose, window, found[limit - 1][0])
        following = f"{PREFIX}/studies/{slug}/tables/{table}?limit={limit}&cursor={place}"
    return answers.Page(table=table, rows=[row for _, row in found[:limit]], next=following)


def _note_reading(
    studio: Studio,
    session: Session,
    caller: Experimenter,
    what: str,
    study: Study,
    subject: str,
    person: Participant | None = None,
) -> None:
    """Kept before anything is given away."""
    action = f"{what} read by the API"
    audit.note_reading(studio.database, session, caller.name, action, subject, study=study, participant=person)


@router.get("/studies/{slug}/exports", tags=["exports"])
def list_exports(slug: Slug, _caller: Caller, session: ReadingSession) -> list[answers.ExportAnswer]:
    """Files that were asked for, the newest first."""
    study = studies.find_study(session, slug)
    return [_export(session, study, each) for each in export_requests.of_study(session, study)]


@router.post("/studies/{slug}/exports", tags=["exports"], status_code=HTTPStatus.ACCEPTED)
def request_export(
    slug: Slug, wanted: answers.NewExport, caller: ActingCaller, session: WritingSession
) -> answers.ExportAnswer:
    """Ask for the whole data of a study as one zip file, or for an archive that another installation imports."""
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


def create_api(path_for: Any, max_body_bytes: int) -> FastAPI:
    """The application to mount at PREFIX. ``path_for``: gives paths of the web's own routes."""
    api = FastAPI(
        title="PbARL Studio API",
        version=export_formats.software_version(),
        description=DESCRIPTION,
        openapi_url="/openapi.json",
        docs_url=None,  # the usual pages load their scripts from other servers; ours is /api/docs
        redoc_url=None,
        servers=[{"url": PREFIX}],
        root_path_in_servers=False,
        max_body_size=max_body_bytes,
        redirect_slashes=False,
    )
    api.state.path_for = path_for
    add_problems(api)
    api.include_router(router)
    document_problems(api)
    return api
