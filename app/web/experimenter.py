"""The experimenter's pages: studies, one study, one participant. Each is whole without script."""

from collections.abc import AsyncIterator, Mapping
from http import HTTPStatus
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Request
from fastapi.responses import FileResponse, RedirectResponse, Response
from fastapi.sse import EventSourceResponse, ServerSentEvent
from jinja2 import Environment
from sqlalchemy.orm import Session

from app.services import audit, dashboard, debrief, enrolment, publishing, studies
from app.web import charts, live, task_words
from app.web.deps import (
    ActingExperimenter,
    Code,
    CurrentExperimenter,
    ReadingSession,
    RowId,
    Slug,
    Studio,
    StudioDep,
    WritingSession,
    experimenter_asking,
)
from app.web.templating import page

router = APIRouter(prefix="/studies")

LIST_PARTS = ("machine", "study_list")
STUDY_PARTS = ("machine", "jobs", "pool", "participants")
PARTICIPANT_PARTS = ("machine", "participant_summary", "trust", "accuracy", "weights", "liked", "filters", "runs")


def _may_stream(request: Request, studio: StudioDep) -> None:
    """Checks the login before a stream begins, and holds no session while it lasts."""
    with studio.database.reading() as session:
        experimenter_asking(request, session)


MayStream = Annotated[None, Depends(_may_stream)]


@router.get("", name="show_studies")
def show_studies(
    request: Request, experimenter: CurrentExperimenter, session: ReadingSession, studio: StudioDep
) -> Response:
    """Every study."""
    context = _list_context(session, studio) | {"experimenter": experimenter, "parts": LIST_PARTS}
    return page(request, "experimenter/studies.html", context)


@router.get("/live", name="stream_studies", response_class=EventSourceResponse)
async def stream_studies(request: Request, studio: StudioDep, _allowed: MayStream) -> AsyncIterator[ServerSentEvent]:
    """The list of studies as it changes."""
    templates = request.app.state.templates  # and nothing else of the request: what is drawn is for all who look

    def draw(session: Session) -> Mapping[str, str]:
        return _draw(templates, LIST_PARTS, _list_context(session, studio))

    async for event in live.redrawn_parts(request, studio, draw):
        yield event


@router.get("/{slug}", name="show_study")
def show_study(
    request: Request, slug: Slug, experimenter: CurrentExperimenter, session: ReadingSession, studio: StudioDep
) -> Response:
    """One study: its pool and everybody in it."""
    context = _study_context(session, studio, slug) | {"experimenter": experimenter, "parts": STUDY_PARTS}
    return page(request, "experimenter/study.html", context)


@router.get("/{slug}/live", name="stream_study", response_class=EventSourceResponse)
async def stream_study(
    request: Request, slug: Slug, studio: StudioDep, _allowed: MayStream
) -> AsyncIterator[ServerSentEvent]:
    """One study as it changes."""
    templates = request.app.state.templates  # and nothing else of the request: what is drawn is for all who look

    def draw(session: Session) -> Mapping[str, str]:
        return _draw(templates, STUDY_PARTS, _study_context(session, studio, slug))

    async for event in live.redrawn_parts(request, studio, draw):
        yield event


@router.post("/{slug}/runs/{run_id}/retry", name="retry_run")
def retry_run(
    request: Request, slug: Slug, run_id: RowId, experimenter: ActingExperimenter, session: WritingSession
) -> Response:
    """Ask for another attempt at a failed run."""
    study = studies.find_study(session, slug)
    publishing.retry_run(session, study, run_id, experimenter.name)
    return _see(request, "show_study", slug=slug)


@router.get("/{slug}/participants/{code}", name="show_participant")
def show_participant(
    request: Request,
    slug: Slug,
    code: Code,
    experimenter: CurrentExperimenter,
    session: ReadingSession,
    studio: StudioDep,
) -> Response:
    """One participant: what they said, what was learned, and what it changes."""
    context = _participant_context(session, studio, slug, code)
    context |= {"experimenter": experimenter, "parts": PARTICIPANT_PARTS}
    return page(request, "experimenter/participant.html", context)


@router.get("/{slug}/participants/{code}/live", name="stream_participant", response_class=EventSourceResponse)
async def stream_participant(
    request: Request, slug: Slug, code: Code, studio: StudioDep, _allowed: MayStream
) -> AsyncIterator[ServerSentEvent]:
    """One participant as it changes."""
    templates = request.app.state.templates  # and nothing else of the request: what is drawn is for all who look

    def draw(session: Session) -> Mapping[str, str]:
        return _draw(templates, PARTICIPANT_PARTS, _participant_context(session, studio, slug, code))

    async for event in live.redrawn_parts(request, studio, draw):
        yield event


@router.get("/{slug}/participants/{code}/bundles/{version}.zip", name="download_bundle")
def download_bundle(
    slug: Slug,
    code: Code,
    version: RowId,
    experimenter: ActingExperimenter,
    session: WritingSession,
    studio: StudioDep,
) -> Response:
    """The participant's filter as a zip file that runs without this project."""
    study = studies.find_study(session, slug)
    participant = enrolment.find_by_code(session, study, code)
    bundle = publishing.find_bundle(session, studio.store, participant, version)
    audit.record(session, experimenter.name, "bundle downloaded", f"{slug}/{code}/{version}")
    filename = f"{slug}-{code}-v{version}.zip"
    return FileResponse(studio.store.path(bundle.artefact_sha256), media_type="application/zip", filename=filename)


def _list_context(session: Session, studio: Studio) -> dict[str, Any]:
    return {
        "machine": dashboard.machine(session, studio.settings.data_dir),
        "lines": dashboard.study_lines(session),
    }


def _study_context(session: Session, studio: Studio, slug: str) -> dict[str, Any]:
    study = studies.find_study(session, slug)
    return {
        "study": study,
        "settings": study.settings,
        "overview": dashboard.study_overview(session, study, studio.tallies),
        "machine": dashboard.machine(session, studio.settings.data_dir),
        "sparkline": charts.sparkline,
    }


def _participant_context(session: Session, studio: Studio, slug: str, code: str) -> dict[str, Any]:
    study = studies.find_study(session, slug)
    participant = enrolment.find_by_code(session, study, code)
    detail = dashboard.participant_detail(session, study, participant, studio.tallies)
    return {
        "study": study,
        "settings": study.settings,
        "detail": detail,
        "films": debrief.before_and_after(session, participant),
        "machine": dashboard.machine(session, studio.settings.data_dir),
        "chart": charts.accuracy_chart(detail.row.curve, study.settings.labels_per_participant),
        "interval": charts.interval,
        "words": task_words.words_of(study.task),
    }


def _draw(templates: Environment, parts: tuple[str, ...], context: Mapping[str, Any]) -> Mapping[str, str]:
    return {name: templates.get_template(f"experimenter/_{name}.html").render(context) for name in parts}


def _see(request: Request, name: str, **parameters: str) -> RedirectResponse:
    return RedirectResponse(request.app.url_path_for(name, **parameters), HTTPStatus.SEE_OTHER)
